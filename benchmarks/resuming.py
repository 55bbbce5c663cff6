"""Resuming in the middle of the second epoch: is what follows what an uninterrupted training would have seen?

``python -m benchmarks.resuming [--quick]`` prints a table: a row for each way of loading, a column for each number of
workers and start method. A cell says ``exact``, ``refused`` or ``WRONG``, for a new pool of workers in each pass and
for a persistent one, for a sequential and for a shuffled loader. The rest of the second epoch and all of the third are
compared, as pairs and as the order of the pictures.
"""

from __future__ import annotations

import argparse
import itertools
import multiprocessing
import pickle
import tempfile
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, distributed
from torch.utils.data import DataLoader

import rawaug
from rawaug.isp.config import ISPConfig
from rawaug.isp.model import DictionaryISP

PICTURES, BATCH = 28, 2  # more than four workers fetch ahead
EPOCHS, DONE = 3, 2
"""Epochs of a training, and the batches of the second one that are done when it is broken off."""

Run = list[Tensor]


@dataclass(frozen=True)
class Case:
    """A way of loading pairs."""

    workers: int
    method: str | None
    persistent: bool
    shuffle: str


def pictures() -> list[Tensor]:
    """Small pictures whose pairs differ."""
    generator = torch.Generator().manual_seed(0)
    return list(torch.randint(256, (PICTURES, 3, 16, 16), generator=generator, dtype=torch.uint8))


def make_augment() -> rawaug.RawAugment:
    """A small camera."""
    return rawaug.RawAugment(DictionaryISP(ISPConfig(colour_atoms=3, gain_atoms=3)), "cycleisp_sidd")


def loader_of(dataset: Any, case: Case, kind: Any = DataLoader) -> Any:
    """A loader of torch's, or torchdata's."""
    generator = torch.Generator().manual_seed(1) if case.shuffle == "generator" else None
    workers: dict[str, Any] = {}
    if case.workers:
        workers = {"multiprocessing_context": case.method, "persistent_workers": case.persistent}
    return kind(
        dataset,
        batch_size=BATCH,
        shuffle=case.shuffle != "no",
        num_workers=case.workers,
        generator=generator,
        **workers,
    )


def wrapped(case: Case, kind: Any = DataLoader) -> Any:
    """``rawaug.wrap`` of a loader of pictures."""
    return rawaug.wrap(loader_of(pictures(), case, kind), make_augment())


def resumable(case: Case, kind: Any = DataLoader) -> Any:
    """``rawaug.resumable`` of a loader of RawPairs."""
    return rawaug.resumable(loader_of(rawaug.RawPairs(pictures(), make_augment(), crop=16), case, kind))


class Counted:
    """RawPairs in a plain loader or torchdata's, as a script uses them; its state is theirs.

    Args:
        case: how it is loaded.
        kind: of the loader.
        pinned: whether the script numbers the epochs.
    """

    def __init__(self, case: Case, kind: Any = DataLoader, pinned: bool = False) -> None:
        self.case, self.kind, self.pinned = case, kind, pinned
        self.pairs = rawaug.RawPairs(pictures(), make_augment(), crop=16)
        self.loader = loader_of(self.pairs, case, kind)
        self.epoch, self.batch = 0, 0

    def __iter__(self) -> Iterator[Any]:
        if self.pinned:
            self.pairs.set_epoch(self.epoch)
        loader = self.loader
        if self.batch and self.kind is DataLoader:  # the script goes on with the rest of the order
            rest = Case(self.case.workers, self.case.method, False, "no")
            loader = loader_of(_Rest(self.pairs, self.batch * BATCH), rest)
        for number, pair in enumerate(loader, self.batch):
            self.batch = number + 1
            yield pair
        self.epoch, self.batch = self.epoch + 1, 0

    def state_dict(self) -> dict[str, Any]:
        state = {"epoch": self.epoch, "batch": self.batch}
        if self.kind is DataLoader:
            return state | {"pairs": self.pairs.state_dict()}
        return state | {"loader": self.loader.state_dict()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.epoch, self.batch = state["epoch"], state["batch"]
        if self.kind is DataLoader:
            if self.case.shuffle != "no":
                raise ValueError("a plain loader cannot say the rest of a shuffled order")
            self.pairs.load_state_dict(state["pairs"])
        else:
            self.loader.load_state_dict(state["loader"])


class _Rest(torch.utils.data.Dataset[Any]):
    """The rest of a pass."""

    def __init__(self, pairs: Any, first: int) -> None:
        self.pairs, self.first = pairs, first

    def __len__(self) -> int:
        return len(self.pairs) - self.first

    def __getitem__(self, index: int) -> Any:
        return self.pairs[index + self.first]


def outcome(make: Callable[[], Any]) -> str:
    """Save the state of a training in the middle of its second epoch, resume from it, and compare."""
    torch.manual_seed(0)
    straight, whole = make(), list[Run]()
    state, global_states = b"", []
    for epoch in range(EPOCHS):
        global_states.append(torch.get_rng_state())
        pairs: Run = []
        for pair in straight:
            pairs.append(pair.noisy)
            if epoch == 1 and len(pairs) == DONE:
                state = pickle.dumps(straight.state_dict())
        whole.append(pairs)
    del straight

    torch.manual_seed(99)
    resumed = make()
    try:
        resumed.load_state_dict(pickle.loads(state))
        rest = [pair.noisy for pair in resumed]
        torch.set_rng_state(global_states[2])  # which a script restores where it shuffles from the global state
        last = [pair.noisy for pair in resumed]
    except ValueError:
        return "refused"
    expected = whole[1][DONE:] + whole[2]
    exact = len(rest + last) == len(expected) and all(map(torch.equal, rest + last, expected))
    return "exact" if exact else "WRONG"


def ways() -> dict[str, Callable[[Case], Any]]:
    """The ways of loading by the name of their row."""
    rows: dict[str, Callable[[Case], Any]] = {
        "wrap(DataLoader)": wrapped,
        "resumable(DataLoader(RawPairs))": resumable,
        "DataLoader(RawPairs), epochs numbered": lambda case: Counted(case, pinned=True),
        "DataLoader(RawPairs), epochs counted": Counted,
    }
    try:
        from torchdata.stateful_dataloader import StatefulDataLoader
    except ImportError:
        return rows
    rows["wrap(StatefulDataLoader)"] = lambda case: wrapped(case, StatefulDataLoader)
    rows["resumable(StatefulDataLoader(RawPairs))"] = lambda case: resumable(case, StatefulDataLoader)
    rows["StatefulDataLoader(RawPairs), epochs numbered"] = lambda case: Counted(case, StatefulDataLoader, True)
    rows["StatefulDataLoader(RawPairs), epochs counted"] = lambda case: Counted(case, StatefulDataLoader)
    return rows


def cases(quick: bool) -> list[Case]:
    """Workers 0, 2 and 4, new and persistent; sequential, shuffled by a generator and globally.

    A server that has imported everything forks workers that unpickle the dataset, as spawned ones do; those import it
    all anew, 2 s each, so there is one such pool.
    """
    loaders: list[tuple[int, str | None, bool]] = [(0, None, False), (2, "fork", False), (2, "fork", True)]
    if not quick:
        for workers, persistent in itertools.product((2, 4), (False, True)):
            loaders.append((workers, "forkserver", persistent))
        loaders += [(4, "fork", False), (4, "fork", True), (2, "spawn", True)]
    return [Case(*loader, shuffle) for loader in loaders for shuffle in ("no", "generator", "global")]


def in_two_processes(shuffle: str, workers: int) -> str:
    """The same under a process group of two, each of which has its share of a wrapped loader."""
    with tempfile.TemporaryDirectory() as folder:

        def run(rank: int) -> None:
            torch.set_num_threads(1)
            where = f"file://{folder}/group"
            distributed.init_process_group("gloo", init_method=where, rank=rank, world_size=2)
            case = Case(workers, "fork" if workers else None, bool(workers), shuffle)
            global DONE
            DONE = 1  # a share has half of the batches
            (Path(folder) / str(rank)).write_text(
                f"{outcome(lambda: wrapped(case))} {outcome(lambda: resumable(case))}"
            )
            distributed.destroy_process_group()

        context = multiprocessing.get_context("fork")
        processes = [context.Process(target=run, args=(rank,)) for rank in range(2)]
        for process in processes:
            process.start()
        for process in processes:
            process.join()
        said = {(Path(folder) / str(rank)).read_text() for rank in range(2)}
    return " / ".join(sorted(said))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--quick", action="store_true", help="2 workers by fork")
    quick = parser.parse_args().quick
    warnings.simplefilter("ignore")
    torch.set_num_threads(1)
    multiprocessing.set_forkserver_preload(["rawaug.plugin.loader"])

    for name, make in ways().items():
        print(f"{name}:", flush=True)
        by_loader: dict[str, list[str]] = {}
        for case in cases(quick):
            pool = "persistent" if case.persistent else "new"
            column = f"{case.workers} {case.method}, {pool}" if case.workers else "0"
            said = outcome(lambda make=make, case=case: make(case))  # type: ignore[misc]
            by_loader.setdefault(column, []).append(said)
        for column, cells in by_loader.items():
            print(f"  {column:24} sequential {cells[0]:8} generator {cells[1]:8} global {cells[2]:8}", flush=True)

    print("two processes, each of which has its share (wrap and resumable):")
    for workers, shuffle in itertools.product((0,) if quick else (0, 2), ("no", "generator", "global")):
        print(f"  workers {workers}, {shuffle:9} {in_two_processes(shuffle, workers)}", flush=True)


if __name__ == "__main__":
    main()
