"""Training goes on in the middle of an epoch exactly, or is refused; the whole table is `benchmarks/resuming.py`."""

from __future__ import annotations

import copy
import itertools
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.utils.data import DataLoader, Dataset, RandomSampler, Sampler, WeightedRandomSampler

import rawaug
from benchmarks import resuming
from benchmarks.resuming import Case, Counted, loader_of, outcome, resumable, wrapped
from rawaug.plugin.augment import RawAugment
from rawaug.plugin.dataset import RawPairs
from rawaug.plugin.epochs import Visits
from rawaug.plugin.wrapped import wrap

POOLS = [(0, False), (2, True)]
"""Workers, and whether they are persistent; `fork` is fast."""


@pytest.fixture(scope="module")
def camera() -> RawAugment:
    return resuming.make_augment()


@pytest.fixture(autouse=True)
def short_epochs(camera: RawAugment, monkeypatch: pytest.MonkeyPatch) -> None:
    """Seven batches: when a training is broken off, two are used, and two workers have fetched four ahead."""
    monkeypatch.setattr(resuming, "PICTURES", 14)
    monkeypatch.setattr(resuming, "make_augment", lambda: copy.deepcopy(camera))


@pytest.fixture
def srgb() -> Tensor:
    return torch.randint(256, (8, 3, 16, 16), generator=torch.Generator().manual_seed(0), dtype=torch.uint8)


@pytest.mark.parametrize("make", [wrapped, resumable])
@pytest.mark.parametrize("shuffle", ["no", "generator", "global"])
@pytest.mark.parametrize(("workers", "persistent"), POOLS)
def test_a_wrapped_training_goes_on_exactly(
    make: Callable[[Case], Any], shuffle: str, workers: int, persistent: bool
) -> None:
    case = Case(workers, "fork" if workers else None, persistent, shuffle)
    assert outcome(lambda: make(case)) == "exact"


@pytest.mark.parametrize(
    ("workers", "pinned", "expected"), [(0, False, "exact"), (2, False, "refused"), (2, True, "exact")]
)
def test_pairs_in_a_plain_loader_go_on_or_are_refused(workers: int, pinned: bool, expected: str) -> None:
    case = Case(workers, "fork" if workers else None, False, "no")
    assert outcome(lambda: Counted(case, pinned=pinned)) == expected


@pytest.mark.filterwarnings("ignore::UserWarning")
@pytest.mark.parametrize(("pinned", "expected"), [(True, "exact"), (False, "refused")])
def test_torchdata_goes_on_with_pairs(pinned: bool, expected: str) -> None:
    torchdata = pytest.importorskip("torchdata.stateful_dataloader", reason="pip install rawaug[test]")
    case = Case(2, "fork", True, "generator")
    assert outcome(lambda: Counted(case, torchdata.StatefulDataLoader, pinned)) == expected
    if pinned:
        for workers in (0, 2):
            case = Case(workers, "fork" if workers else None, False, "generator")
            assert outcome(lambda case=case: wrapped(case, torchdata.StatefulDataLoader)) == "exact"  # type: ignore[misc]


@pytest.mark.filterwarnings("ignore::UserWarning")
@pytest.mark.parametrize("shuffle", ["no", "generator", "global"])
def test_torchdata_without_workers_is_exact_where_it_is_made_resumable(shuffle: str) -> None:
    """By itself it leaves out a draw from its generator, whatever the dataset is."""
    torchdata = pytest.importorskip("torchdata.stateful_dataloader", reason="pip install rawaug[test]")
    case = Case(0, None, False, shuffle)
    assert outcome(lambda: resumable(case, torchdata.StatefulDataLoader)) == "exact"


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_torchdata_at_the_last_batch_begins_the_next_epoch(augment: RawAugment, srgb: Tensor) -> None:
    torchdata = pytest.importorskip("torchdata.stateful_dataloader", reason="pip install rawaug[test]")

    def make() -> Any:
        return wrap(torchdata.StatefulDataLoader(srgb, batch_size=4), augment)

    loader = make()
    expected = [pair.noisy for _ in range(2) for pair in loader]
    loader = make()
    for number, _ in enumerate(loader):
        if number == 1:
            state = copy.deepcopy(loader.state_dict())
            break
    resumed = make()
    resumed.load_state_dict(state)
    assert all(map(torch.equal, [pair.noisy for pair in resumed], expected[2:]))


class Loaded(Dataset[Tensor]):
    """Pictures that say when they are read."""

    def __init__(self, pictures: Tensor) -> None:
        self.pictures, self.read = pictures, list[int]()

    def __len__(self) -> int:
        return len(self.pictures)

    def __getitem__(self, index: int) -> Tensor:
        self.read.append(index)
        return self.pictures[index]


def test_what_was_seen_is_not_read_again(augment: RawAugment, srgb: Tensor) -> None:
    first = wrap(DataLoader(Loaded(srgb), batch_size=2, shuffle=True), augment)
    next(iter(first))
    dataset = Loaded(srgb)
    resumed = wrap(DataLoader(dataset, batch_size=2, shuffle=True), augment)
    resumed.load_state_dict(first.state_dict())
    again = resumed.state_dict()
    assert (again["batch"], again["order"].keys()) == (1, first.state_dict()["order"].keys())
    assert len(list(resumed)) == 3 and len(dataset.read) == 6
    assert len(list(resumed)) == 4, "the next pass is whole"


def test_any_sampler_is_kept(augment: RawAugment, srgb: Tensor) -> None:
    pictures: Any = srgb
    for sampler in (WeightedRandomSampler([1.0, 2.0] * 4, 8), RandomSampler(pictures, replacement=True, num_samples=8)):
        first = wrap(DataLoader(pictures, batch_size=2, sampler=sampler), augment)
        batches = iter(first)
        next(batches)
        state = first.state_dict()
        expected = [pair.noisy for pair in batches]
        resumed = wrap(DataLoader(pictures, batch_size=2, sampler=sampler), augment)
        resumed.load_state_dict(state)
        assert all(map(torch.equal, [pair.noisy for pair in resumed], expected))


class Endless(Sampler[int]):
    """Indices without an end."""

    def __iter__(self) -> Any:
        return itertools.cycle([0, 1])


def test_an_order_that_cannot_be_kept_is_refused(
    augment: RawAugment, srgb: Tensor, as_rank: Callable[[int, int], None]
) -> None:
    endless = wrap(DataLoader(srgb, batch_size=2, sampler=Endless()), augment)  # type: ignore[arg-type]
    next(iter(endless))
    with pytest.raises(ValueError, match="no length"):
        endless.load_state_dict(endless.state_dict())

    shuffled = wrap(DataLoader(srgb, batch_size=2, sampler=RandomSampler(range(8))), augment)  # type: ignore[arg-type]
    next(iter(shuffled))
    state = shuffled.state_dict()
    without = {key: value for key, value in state.items() if key != "order"}
    with pytest.raises(ValueError, match="order"):
        shuffled.load_state_dict(without)
    as_rank(1, 2)
    with pytest.raises(ValueError, match="processes 1"):
        shuffled.load_state_dict(state)


def test_a_broken_pass_can_begin_the_next_epoch(augment: RawAugment, srgb: Tensor) -> None:
    pictures = list(srgb)
    pairs = RawPairs(pictures, augment, crop=16)
    loader = DataLoader(pairs, batch_size=2, num_workers=1, prefetch_factor=1)
    next(iter(loader))
    state = pairs.state_dict()
    other = RawPairs(pictures, augment, crop=16)
    with pytest.raises(ValueError, match="resumable"):
        other.load_state_dict(state)
    other.load_state_dict(state, next_epoch=True)
    expected = RawPairs(pictures, augment, crop=16)
    expected.set_epoch(1)
    assert all(torch.equal(other[i].noisy, expected[i].noisy) for i in range(8))


def test_an_incomplete_last_batch_breaks_no_state(augment: RawAugment, srgb: Tensor) -> None:
    pairs = RawPairs(list(srgb), augment, crop=16)
    for _ in DataLoader(pairs, batch_size=3, num_workers=1, drop_last=True, shuffle=True):
        pass
    RawPairs(list(srgb), augment, crop=16).load_state_dict(pairs.state_dict())


def test_a_visit_in_this_process_is_no_worker_s() -> None:
    visits = Visits(4)
    visits.key(0)
    assert visits.state_dict()["exact"]


def test_a_transform_draws_apart_in_a_spawned_worker_of_every_process(
    augment: RawAugment, as_rank: Callable[[int, int], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    sent = []
    for rank in range(2):
        as_rank(rank, 2)
        sent.append(pickle.dumps((RawAugment(augment.isp), rawaug.RawNoise("upi"))))
    monkeypatch.undo()  # a spawned worker has no process group
    pictures, noisy = torch.rand(1, 3, 8, 8), []
    for content in sent:
        of_pictures, of_raw = pickle.loads(content)
        noisy.append((of_pictures(pictures).noisy, of_raw(torch.full((1, 4, 4, 4), 0.5)).noisy))
    assert not torch.equal(noisy[0][0], noisy[1][0]) and not torch.equal(noisy[0][1], noisy[1][1])


def test_lightning_goes_on_with_pairs_in_the_middle_of_an_epoch(
    augment: RawAugment, srgb: Tensor, tmp_path: Path, lightning_run: Callable[..., Any]
) -> None:
    def train(steps: int, checkpoint: Path | None = None) -> tuple[list[Tensor], Any]:
        pairs = RawPairs(list(srgb), augment, crop=16)
        loader = rawaug.resumable(DataLoader(pairs, batch_size=2, shuffle=True))
        seen: tuple[list[Tensor], Any] = lightning_run(loader, checkpoint, max_steps=steps)
        return seen

    torch.manual_seed(0)
    expected, _ = train(8)
    torch.manual_seed(0)
    begun, trainer = train(6)
    trainer.save_checkpoint(tmp_path / "at6.ckpt")
    rest, _ = train(8, tmp_path / "at6.ckpt")
    assert all(map(torch.equal, begun + rest, expected))


def test_a_loader_s_own_attributes_stay(augment: RawAugment, srgb: Tensor) -> None:
    pairs = RawPairs(list(srgb), augment, crop=16)
    loader = rawaug.resumable(loader_of(pairs, Case(0, None, False, "no")))
    assert loader.batch_size == 2 and loader.dataset is pairs and len(loader) == 4
