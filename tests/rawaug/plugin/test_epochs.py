"""Epochs that nobody announces: every pass draws anew, and the same again where it is asked for."""

from __future__ import annotations

import copy
import pickle
from collections.abc import Callable, Iterator
from itertools import islice
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.utils.data import (
    DataLoader,
    DistributedSampler,
    IterableDataset,
    Subset,
    WeightedRandomSampler,
    get_worker_info,
)

from rawaug.plugin.augment import RawAugment
from rawaug.plugin.dataset import RawPairs
from rawaug.plugin.epochs import Passes, Visits
from rawaug.plugin.stream import RawPairStream

COUNT = 6


@pytest.fixture(scope="module")
def pictures() -> list[Tensor]:
    return list(torch.randint(256, (COUNT, 3, 12, 14), generator=torch.Generator().manual_seed(0), dtype=torch.uint8))


class Strided(IterableDataset[Tensor]):
    """Pictures in order, picture i to worker i mod W."""

    def __init__(self, pictures: list[Tensor]) -> None:
        self.pictures = pictures

    def __iter__(self) -> Iterator[Tensor]:
        info = get_worker_info()
        return islice(iter(self.pictures), *((info.id, None, info.num_workers) if info else (0, None, 1)))


def one_pass(loader: Any) -> Tensor:
    return torch.cat([pair.noisy for pair in loader])


@pytest.fixture(scope="module")
def epochs(augment: RawAugment, pictures: list[Tensor]) -> list[Tensor]:
    """Three epochs, each pinned."""
    pairs, passes = RawPairs(pictures, augment, crop=8, seed=3), []
    for epoch in range(3):
        pairs.set_epoch(epoch)
        passes.append(torch.stack([pairs[i].noisy for i in range(COUNT)]))
    return passes


LOADERS: list[dict[str, Any]] = [
    {"num_workers": 0, "batch_size": 2},
    {"num_workers": 2, "batch_size": 1, "multiprocessing_context": "fork"},
    {"num_workers": 2, "batch_size": 1, "multiprocessing_context": "fork", "persistent_workers": True},
    {"num_workers": 1, "batch_size": 3, "multiprocessing_context": "forkserver"},
    {"num_workers": 1, "batch_size": 3, "multiprocessing_context": "forkserver", "persistent_workers": True},
]


def named(settings: dict[str, Any]) -> str:
    return "-".join(str(value) for value in settings.values())


@pytest.mark.parametrize("settings", LOADERS, ids=named)
@pytest.mark.parametrize(("form", "kind"), [(list, RawPairs), (Strided, RawPairStream)], ids=["indexed", "stream"])
def test_every_pass_is_the_next_epoch(
    augment: RawAugment, pictures: list[Tensor], epochs: list[Tensor], settings: dict[str, Any], form: Any, kind: Any
) -> None:
    loader = DataLoader(kind(form(pictures), augment, crop=8, seed=3), **settings)
    for expected in epochs[:2]:
        assert torch.equal(one_pass(loader), expected)


def test_draws_with_replacement_never_repeat(augment: RawAugment, pictures: list[Tensor]) -> None:
    sampler = WeightedRandomSampler([1.0] * 2, 20, generator=torch.Generator().manual_seed(0))
    noisy = one_pass(DataLoader(RawPairs(pictures[:2], augment, crop=8), batch_size=5, sampler=sampler))
    assert len({float(patch.sum()) for patch in noisy}) == 20


def test_a_pinned_epoch_stays_until_the_next_call(
    augment: RawAugment, pictures: list[Tensor], epochs: list[Tensor]
) -> None:
    pairs = RawPairs(pictures, augment, crop=8, seed=3)
    loader = DataLoader(pairs, batch_size=2)
    one_pass(loader)
    pairs.set_epoch(2)
    again = RawPairs(pictures, augment, crop=8, seed=3)
    again.load_state_dict(pairs.state_dict())
    assert torch.equal(one_pass(loader), epochs[2]) and torch.equal(
        one_pass(DataLoader(again, batch_size=4)), epochs[2]
    )
    assert not torch.equal(one_pass(loader), epochs[2]), "what comes again is drawn anew"
    pairs.set_epoch(2)
    assert torch.equal(one_pass(loader), epochs[2])


@pytest.mark.parametrize("workers", [0, 2])
def test_a_state_goes_on_between_passes(
    augment: RawAugment, pictures: list[Tensor], epochs: list[Tensor], workers: int
) -> None:
    pairs = RawPairs(pictures, augment, crop=8, seed=3)
    one_pass(DataLoader(pairs, num_workers=workers))
    resumed = RawPairs(pictures, augment, crop=8, seed=3)
    resumed.load_state_dict(pickle.loads(pickle.dumps(pairs.state_dict())))
    assert torch.equal(one_pass(DataLoader(resumed, num_workers=workers)), epochs[1])


def test_a_state_goes_on_in_the_middle_of_a_pass(
    augment: RawAugment, pictures: list[Tensor], epochs: list[Tensor]
) -> None:
    order = [4, 2, 0, 5, 1, 3]
    pairs = RawPairs(pictures, augment, crop=8, seed=3)
    one_pass(DataLoader(pairs))
    list(islice(DataLoader(pairs, sampler=order), 2))
    resumed = RawPairs(pictures, augment, crop=8, seed=3)
    resumed.load_state_dict(pairs.state_dict())
    assert torch.equal(one_pass(DataLoader(resumed, sampler=order[2:])), epochs[1][order[2:]])
    assert torch.equal(one_pass(DataLoader(resumed, sampler=order)), epochs[2][order])


@pytest.mark.parametrize("workers", [0, 2])
def test_a_stream_goes_on_in_the_middle_of_a_pass(
    augment: RawAugment, pictures: list[Tensor], epochs: list[Tensor], workers: int
) -> None:
    stream = RawPairStream(Strided(pictures), augment, crop=8, seed=3)
    one_pass(DataLoader(stream))
    list(islice(DataLoader(stream), 2))
    resumed = RawPairStream(Strided(pictures), augment, crop=8, seed=3)
    resumed.load_state_dict(stream.state_dict())
    loader = DataLoader(resumed, num_workers=workers)
    assert torch.equal(one_pass(loader), epochs[1][2:])
    assert torch.equal(one_pass(loader), epochs[2])


def test_other_states_are_refused(augment: RawAugment, pictures: list[Tensor]) -> None:
    pairs = RawPairs(pictures, augment, crop=8)
    with pytest.raises(ValueError, match="dataset"):
        pairs.load_state_dict(RawPairs(pictures[:2], augment, crop=8).state_dict())
    growing = list(pictures)
    pairs = RawPairs(growing, augment, crop=8)
    growing.append(pictures[0])
    with pytest.raises(ValueError, match="grown from 6 pictures"):
        pairs[6]


def test_a_copy_counts_for_itself_and_its_workers(
    augment: RawAugment, pictures: list[Tensor], epochs: list[Tensor]
) -> None:
    pairs = RawPairs(pictures, augment, crop=8, seed=3)
    for other in (copy.deepcopy(pairs), pickle.loads(pickle.dumps(pairs))):
        loader = DataLoader(Subset(other, range(COUNT)), num_workers=1, batch_size=COUNT)
        assert torch.equal(one_pass(loader), epochs[0]) and torch.equal(one_pass(loader), epochs[1])
    assert torch.equal(one_pass(DataLoader(pairs)), epochs[0])


def test_processes_draw_apart(as_rank: Callable[[int, int], None], monkeypatch: pytest.MonkeyPatch) -> None:
    visits = Visits(2)
    as_rank(1, 2)
    assert visits.key(0) == (0, 0, 1)
    assert visits.state_dict()["visits"].tolist() == [1, 1]  # of two pictures in two processes, a pass each
    state = pickle.dumps(visits)
    monkeypatch.undo()
    in_a_spawned_worker = pickle.loads(state)
    assert in_a_spawned_worker.key(0) == (1, 0, 1)
    visits.pin(5)
    assert visits.key(1) == (5, 1)


@pytest.mark.parametrize("count", [3, 1001])
@pytest.mark.parametrize("drop_last", [False, True])
def test_a_state_of_two_processes_counts_passes(
    as_rank: Callable[[int, int], None], count: int, drop_last: bool
) -> None:
    as_rank(0, 2)
    visits, dataset = Visits(count), list(range(count))
    sampler: DistributedSampler[int] = DistributedSampler(dataset, 2, 0, shuffle=False, drop_last=drop_last)  # type: ignore[arg-type]
    for number in (1, 2):
        for picture in sampler:
            visits.key(picture)
            assert visits.state_dict()["visits"].tolist() == [number] * count, "a pass that has begun counts"


def test_another_number_of_workers_repeats_no_pass() -> None:
    passes = Passes()
    begun = [[passes.begin(workers, w)[0] for w in range(max(workers, 1))] for workers in (4, 2, 0, 4)]
    assert begun == [[0] * 4, [1] * 2, [2], [3] * 4]


@pytest.mark.filterwarnings("ignore:'pin_memory' argument is set as true but no accelerator")
@pytest.mark.filterwarnings("ignore:.*does not have many workers")
def test_lightning_resumes_without_a_warning(
    augment: RawAugment,
    pictures: list[Tensor],
    epochs: list[Tensor],
    tmp_path: Path,
    lightning_run: Callable[..., tuple[list[Tensor], Any]],
) -> None:
    lightning = pytest.importorskip("pytorch_lightning")

    class Pictures(lightning.LightningDataModule):  # type: ignore[name-defined]
        def __init__(self) -> None:
            super().__init__()
            self.pairs = RawPairs(pictures, augment, crop=8, seed=3)
            self.state_dict, self.load_state_dict = self.pairs.state_dict, self.pairs.load_state_dict

        def train_dataloader(self) -> DataLoader[Any]:
            return DataLoader(self.pairs, 3, num_workers=1, persistent_workers=True, pin_memory=True)

    begun, trainer = lightning_run(Pictures(), max_epochs=2)
    trainer.save_checkpoint(tmp_path / "two.ckpt")
    rest, _ = lightning_run(Pictures(), tmp_path / "two.ckpt", max_epochs=3)
    assert torch.equal(torch.cat(begun + rest), torch.cat(epochs))
