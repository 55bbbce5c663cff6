"""Samplers, wrappers, workers and processes: a training goes on exactly or is refused, and no draw comes twice."""

from __future__ import annotations

import math
import pickle
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from PIL import Image
from torch import Tensor
from torch.utils.data import (
    ConcatDataset,
    DataLoader,
    Dataset,
    DistributedSampler,
    IterableDataset,
    RandomSampler,
    Sampler,
    Subset,
    WeightedRandomSampler,
    random_split,
)

import rawaug
from rawaug.data.folders import PictureFolder
from rawaug.plugin.augment import RawAugment
from rawaug.plugin.dataset import RawPairs
from rawaug.plugin.stream import RawPairStream

COUNT, BATCH, RATIO = 6, 2, 2


class Enlarged(Sampler[int]):
    """BasicSR's EnlargedSampler: every picture several times an epoch, divided between the processes."""

    def __init__(self, dataset: Any, processes: int, rank: int) -> None:
        self.processes, self.rank, self.epoch = processes, rank, 0
        self.length, self.number = len(dataset), math.ceil(len(dataset) * RATIO / processes)

    def __len__(self) -> int:
        return self.number

    def __iter__(self) -> Iterator[int]:
        generator = torch.Generator().manual_seed(self.epoch)
        order = torch.randperm(self.number * self.processes, generator=generator) % self.length
        return iter(order[self.rank :: self.processes].tolist())


class Wrapper(Dataset[Any]):
    """A Dataset of one's own, as of KAIR."""

    def __init__(self, pairs: Any) -> None:
        self.hidden = {"pairs": pairs}  # where nobody looks

    def __len__(self) -> int:
        return len(self.hidden["pairs"])

    def __getitem__(self, index: int) -> Any:
        return self.hidden["pairs"][index]


WRAPPERS: dict[str, Callable[[RawPairs[Any]], Any]] = {
    "none": lambda pairs: pairs,
    "subset": lambda pairs: Subset(pairs, [5, 3, 1, 0, 3]),
    "split": lambda pairs: random_split(pairs, [5, 1], torch.Generator().manual_seed(0))[0],
    "concat": lambda pairs: ConcatDataset([pairs, Subset(pairs, range(4))]),
    "own": Wrapper,
}


def random(dataset: Any, processes: int, rank: int) -> Any:
    return RandomSampler(dataset, generator=torch.Generator().manual_seed(rank))


def weighted(dataset: Any, processes: int, rank: int) -> Any:
    generator = torch.Generator().manual_seed(rank)
    return WeightedRandomSampler([1.0] * len(dataset), 2 * len(dataset), generator=generator)


def distributed(dataset: Any, processes: int, rank: int) -> Any:
    return DistributedSampler(dataset, processes, rank)


SAMPLERS = {"shuffle": None, "random": random, "weighted": weighted, "enlarged": Enlarged, "distributed": distributed}


@pytest.fixture(scope="module")
def pictures() -> list[Tensor]:
    return list(torch.randint(256, (COUNT, 3, 8, 8), generator=torch.Generator().manual_seed(0), dtype=torch.uint8))


@pytest.fixture
def make(
    augment: RawAugment, pictures: list[Tensor], as_rank: Callable[[int, int], None]
) -> Callable[..., rawaug.ResumableLoader[Any]]:
    """A resumable loader of one of several processes."""

    def loader(
        sampler: str, wrapper: str = "none", workers: int = 0, rank: int = 0, processes: int = 1, **settings: Any
    ) -> rawaug.ResumableLoader[Any]:
        as_rank(rank, processes)
        dataset = WRAPPERS[wrapper](RawPairs(pictures, augment, crop=8, seed=settings.pop("seed", 0)))
        torch.manual_seed(0)
        make_sampler = SAMPLERS[sampler]
        if make_sampler is None:
            settings["shuffle"] = True
        else:
            settings["sampler"] = make_sampler(dataset, processes, rank)
        return rawaug.resumable(DataLoader(dataset, **{"batch_size": BATCH, "num_workers": workers, **settings}))

    return loader


def noises(batches: Any) -> list[Tensor]:
    return [noisy for pair in batches for noisy in pair.noisy]


def differ(samples: list[Tensor]) -> bool:
    return len({float(sample.double().sum()) for sample in samples}) == len(samples)


def same(first: list[Tensor], second: list[Tensor]) -> bool:
    return len(first) == len(second) and all(map(torch.equal, first, second))


def broken_off(loader: Any, batches: int = 1) -> tuple[Any, list[Tensor], list[Tensor]]:
    """The state after some batches of the second pass, what came before it, and the rest of the pass."""
    seen = noises(loader)
    running = iter(loader)
    for _ in range(batches):
        seen += noises([next(running)])
    state = pickle.loads(pickle.dumps(loader.state_dict()))
    return state, seen, noises(running)


IN_ONE_PROCESS = [(sampler, wrapper, 0) for sampler in SAMPLERS for wrapper in WRAPPERS]
WITH_WORKERS = [(sampler, wrapper, 2) for sampler, wrapper in zip(SAMPLERS, WRAPPERS, strict=True)]
"""Samplers run in the main process and wrappers in the workers, so that each of them is once enough."""


@pytest.mark.parametrize(("sampler", "wrapper", "workers"), [*IN_ONE_PROCESS, *WITH_WORKERS])
def test_every_sampler_over_every_wrapper_goes_on_exactly_and_repeats_no_draw(
    make: Callable[..., Any], sampler: str, wrapper: str, workers: int
) -> None:
    settings = {"persistent_workers": workers > 0}
    loader = make(sampler, wrapper, workers, **settings)
    state, seen, rest = broken_off(loader)
    assert differ(seen + rest), "within and between epochs"

    resumed = make(sampler, wrapper, workers, **settings)
    resumed.load_state_dict(state)
    assert same(noises(resumed), rest)
    if sampler != "shuffle":  # its order comes from the global state, which is the script's
        assert same(noises(resumed), noises(loader))


@pytest.mark.parametrize("sampler", ["shuffle", "random", "distributed"])
@pytest.mark.parametrize("wrapper", WRAPPERS)
@pytest.mark.parametrize("processes", [1, 2, 3])
def test_a_shared_order_is_dealt_to_any_number_of_processes(
    make: Callable[..., Any], sampler: str, wrapper: str, processes: int
) -> None:
    """Two processes stop after a batch of one each; what is left, four of six pictures, goes to 1, 2 or 3."""
    seen, rest, states = list[Tensor](), list[Tensor](), list[Any]()
    for rank in range(2):
        state, before, after = broken_off(make(sampler, wrapper, 0, rank, 2, batch_size=1))
        states.append(state)
        seen, rest = seen + before, rest + after
    assert states[0].keys() == states[1].keys() and states[0]["samples"] == 2
    assert differ(seen + rest)

    again: list[Tensor] = []
    for rank in range(processes):
        resumed = make(sampler, wrapper, 0, rank, processes, batch_size=1)
        resumed.load_state_dict(states[0])
        again += noises(resumed)
    expected = {float(sample.double().sum()) for sample in rest}
    assert expected <= {float(sample.double().sum()) for sample in again}, "nothing is left out"
    assert differ(again) and len(again) == math.ceil(len(rest) / processes) * processes


@pytest.mark.parametrize("wrapper", WRAPPERS)
@pytest.mark.parametrize("sampler", ["weighted", "enlarged"])
def test_orders_of_two_processes_go_on_in_two_alone(make: Callable[..., Any], sampler: str, wrapper: str) -> None:
    states, seen = list[Any](), list[Tensor]()
    for rank in range(2):
        state, before, rest = broken_off(make(sampler, wrapper, 0, rank, 2))
        states.append(state)
        seen += before + rest
        resumed = make(sampler, wrapper, 0, rank, 2)
        resumed.load_state_dict(state)
        assert same(noises(resumed), rest)
    assert differ(seen), "in both processes"

    with pytest.raises(ValueError, match="another process"):
        make(sampler, wrapper, 0, 0, 2).load_state_dict(states[1])
    for processes in (1, 3):
        with pytest.raises(ValueError, match="processes"):
            make(sampler, wrapper, 0, 0, processes).load_state_dict(states[0])


def test_the_epoch_of_the_state_may_be_told_again(make: Callable[..., Any]) -> None:
    state, _, rest = broken_off(make("enlarged"))
    resumed = make("enlarged")
    resumed.load_state_dict(state)
    resumed.set_epoch(1)  # as Hugging Face's Trainer does before each pass
    assert same(noises(resumed), rest)

    resumed.load_state_dict(state)
    resumed.set_epoch(2)
    assert not same(noises(resumed), rest)
    resumed.load_state_dict(state)
    list(resumed)
    resumed.set_epoch(1)
    assert len(noises(resumed)) > len(rest), "later it is the whole pass"


@pytest.mark.parametrize("batch_size", [1, 3, 4])
def test_batches_of_another_size_go_on_with_the_samples_that_are_left(
    make: Callable[..., Any], batch_size: int
) -> None:
    state, _, rest = broken_off(make("shuffle"))
    resumed = make("shuffle", batch_size=batch_size)
    resumed.load_state_dict(state)
    assert same(noises(resumed), rest)


def test_a_state_of_another_loader_is_refused_by_its_reason(make: Callable[..., Any], pictures: list[Tensor]) -> None:
    state, _, _ = broken_off(make("shuffle"))
    with pytest.raises(ValueError, match="length 6"):
        make("shuffle", "subset").load_state_dict(state)
    with pytest.raises(ValueError, match="seeds"):
        make("shuffle", seed=1).load_state_dict(state)
    with pytest.raises(ValueError, match="lacks batch"):
        make("shuffle").load_state_dict({"epoch": 1})

    whole = make("shuffle")
    list(whole)
    fewer = make("shuffle", "subset")
    fewer.load_state_dict(whole.state_dict())  # between passes pictures may come or go
    assert len(noises(fewer)) == 5


def test_a_repeated_index_is_drawn_anew_after_set_epoch_and_in_batches(
    augment: RawAugment, pictures: list[Tensor]
) -> None:
    pairs = RawPairs(pictures, augment, crop=8)
    loader = DataLoader(pairs, batch_size=4, sampler=[0, 0, 1, 0, 0, 1])
    seen: list[Tensor] = []
    for epoch in range(2):
        pairs.set_epoch(epoch)
        seen += noises(loader)
    assert differ(seen)
    pairs.set_epoch(1)
    assert same(noises(loader), seen[6:])


def test_a_pinned_state_with_repeats_is_exact_or_refused(augment: RawAugment, pictures: list[Tensor]) -> None:
    order = [0, 1, 0, 1, 0, 0]
    for workers in (0, 1):
        pairs = RawPairs(pictures, augment, crop=8)
        pairs.set_epoch(1)
        running = iter(DataLoader(pairs, batch_size=1, sampler=order, num_workers=workers))
        for _ in range(4):
            next(running)
        state = pairs.state_dict()
        resumed = RawPairs(pictures, augment, crop=8)
        if workers:
            with pytest.raises(ValueError, match="resumable"):
                resumed.load_state_dict(state)
        else:
            resumed.load_state_dict(state)
            assert same(noises(running), noises(DataLoader(resumed, batch_size=1, sampler=order[4:])))


def test_what_is_frozen_stays(augment: RawAugment, pictures: list[Tensor]) -> None:
    pairs = RawPairs(pictures, augment, crop=8).freeze()
    expected = noises(DataLoader(pairs))
    for epoch in (3, 4):
        pairs.set_epoch(epoch)  # as accelerate does before each pass
        assert same(noises(DataLoader(pairs)), expected)
    pairs.load_state_dict(RawPairs(pictures, augment, crop=8).state_dict())
    loader = rawaug.resumable(DataLoader(pairs, batch_size=2))
    assert same(noises(loader) + noises(loader), expected * 2)

    loader = rawaug.resumable(DataLoader(RawPairs(pictures, augment, crop=8))).freeze()
    loader.set_epoch(5)
    assert same(noises(loader) + noises(loader), expected * 2)


class Hidden(IterableDataset[Any]):
    """A stream in which nobody finds the pairs."""

    def __init__(self, pictures: list[Tensor], augment: RawAugment) -> None:
        self.parts = {"stream": RawPairStream(iter(pictures), augment, crop=8)}

    def __iter__(self) -> Iterator[Any]:
        return iter(self.parts["stream"])


def test_a_stream_that_cannot_be_told_its_epoch_is_refused(augment: RawAugment, pictures: list[Tensor]) -> None:
    loader = rawaug.resumable(DataLoader(Hidden(pictures, augment), batch_size=2))
    next(iter(loader))
    with pytest.raises(ValueError, match="set_epoch"):
        loader.load_state_dict(loader.state_dict())


def test_an_iterable_that_has_an_index_makes_pairs(augment: RawAugment, pictures: list[Tensor]) -> None:
    class Streaming(IterableDataset[Any]):  # as MosaicML's StreamingDataset
        def __len__(self) -> int:
            return len(pictures)

        def __iter__(self) -> Iterator[Tensor]:
            return iter(pictures)

        def __getitem__(self, index: int) -> Tensor:
            return pictures[index]

    assert len(noises(DataLoader(RawPairs(Streaming(), augment, crop=8)))) == COUNT


def test_a_pair_has_the_name_of_the_file_that_it_was_made_of(augment: RawAugment, tmp_path: Path) -> None:
    for name in ("a.png", "c.png"):
        Image.new("RGB", (8, 8), (90, 120, 40)).save(tmp_path / name)
    (tmp_path / "b.png").write_bytes(b"broken")
    pairs = RawPairs(PictureFolder(tmp_path, allowed_share=0.5), augment, crop=8, fields=("name",))
    assert [Path(name).name for (name,) in (pairs[0], pairs[1], pairs[2])] == ["a.png", "c.png", "c.png"]


SETTINGS: dict[str, dict[str, Any]] = {
    "cameras": {},
    "any camera": {"noise": "any camera"},
    "one's own": {"camera": ["Nikon D750", "Canon EOS 5D"], "target": "rgb"},
    "developed": {"target": rawaug.Srgb(jpeg=(40, 90), finish=True)},
    "burst": {"burst": rawaug.Burst(2)},
    "pattern": {"cfa": "XTRANS", "draw": rawaug.Draw(sampling="independent")},
}


@pytest.mark.parametrize("name", SETTINGS)
def test_a_batch_has_the_bits_of_each_sample_alone(name: str) -> None:
    generator = torch.Generator().manual_seed(0)
    pictures = list(torch.randint(256, (5, 3, 48, 64), generator=generator, dtype=torch.uint8))
    pictures.append(torch.rand(3, 48, 64, generator=generator))  # another type
    augment = rawaug.RawAugment.from_pretrained("universal", **SETTINGS[name])
    pairs = RawPairs(pictures, augment, crop=24, zoom=1.5).freeze()
    for numbers in (range(5), range(3, 6)):
        for number, pair in zip(numbers, pairs.__getitems__(list(numbers)), strict=True):
            alone = pairs[number]
            assert torch.equal(pair.noisy, alone.noisy) and torch.equal(pair.clean, alone.clean)
            assert torch.equal(pair.params.isp.gains, alone.params.isp.gains)


@pytest.mark.parametrize("sampling", ["convex", "chosen"])
def test_a_folder_is_read_no_further_than_a_crop_to_the_same_pairs(tmp_path: Path, sampling: Any) -> None:
    for number in range(4):
        array = torch.randint(256, (60 + number, 80, 3), generator=torch.Generator().manual_seed(number))
        image = Image.fromarray(array.to(torch.uint8).numpy())
        exif = Image.Exif()
        exif[274] = 6 if number == 3 else 1  # on its side
        image.save(tmp_path / f"{number}.jpg", quality=90, exif=exif)
    folder = PictureFolder(tmp_path)
    augment = rawaug.RawAugment.from_pretrained("phones", draw=rawaug.Draw(sampling=sampling))
    parts = RawPairs(folder, augment, crop=32, zoom=2.0).freeze()
    whole = RawPairs([folder[number] for number in range(4)], augment, crop=32, zoom=2.0).freeze()
    assert all(torch.equal(parts[number].noisy, whole[number].noisy) for number in range(4))
    assert torch.equal(parts.replay(1, parts[1].params).noisy, parts[1].noisy)


def test_a_truncated_picture_is_found_whichever_part_is_read(augment: RawAugment, tmp_path: Path) -> None:
    noise = torch.randint(256, (64, 64, 3), generator=torch.Generator().manual_seed(0)).to(torch.uint8)
    for name in ("a.jpg", "b.jpg"):
        Image.fromarray(noise.numpy()).save(tmp_path / name)
    content = (tmp_path / "b.jpg").read_bytes()
    (tmp_path / "b.jpg").write_bytes(content[: len(content) * 9 // 10])
    folder = PictureFolder(tmp_path, allowed_share=0.5)
    top = folder.read_part(1, lambda height, width: (0, 0, 2, 4))
    assert list(folder.skipped) == [tmp_path / "b.jpg"] and torch.equal(top, folder[0][:, :2, :4])
    with pytest.raises(ValueError, match="crop"):  # the crop's fault, not the files'
        RawPairs(folder, augment, crop=66)[0]
    assert len(folder.skipped) == 1
