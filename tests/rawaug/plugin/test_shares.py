"""Distributed runs: two processes, each with its share, its own draws, and an augmentation inside DDP."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor, distributed, nn
from torch.utils.data import BatchSampler, DataLoader, DistributedSampler, RandomSampler, SequentialSampler

from rawaug.isp.model import DictionaryISP
from rawaug.plugin.augment import RawAugment
from rawaug.plugin.draw import Draw
from rawaug.plugin.params import RawPair
from rawaug.plugin.stream import RawPairStream
from rawaug.plugin.wrapped import wrap

LEVELS = range(0, 200, 25)
"""Grey levels of eight pictures, which show in what becomes of them."""


@pytest.fixture(scope="module")
def augment(isp: DictionaryISP) -> RawAugment:
    return RawAugment(isp, noise=(0.0, 0.0), draw=Draw(sampling="chosen"))


def pictures() -> list[Tensor]:
    return [torch.full((3, 4, 4), level, dtype=torch.uint8) for level in LEVELS]


def in_two_processes(task: Callable[[], Any], folder: Path) -> list[Any]:
    """What ``task`` returns in each process of a group."""

    def run(rank: int) -> None:
        torch.set_num_threads(1)
        distributed.init_process_group("gloo", init_method=f"file://{folder}/group", rank=rank, world_size=2)
        torch.save(task(), folder / f"{rank}.pt")
        distributed.destroy_process_group()

    processes = [multiprocessing.get_context("fork").Process(target=run, args=(rank,)) for rank in range(2)]
    for process in processes:
        process.start()
    for process in processes:
        process.join(120)
    assert [process.exitcode for process in processes] == [0, 0]
    return [torch.load(folder / f"{rank}.pt", weights_only=True) for rank in range(2)]


class Augmented(nn.Module):
    """A network with the augmentation as a part."""

    def __init__(self, augment: RawAugment) -> None:
        super().__init__()
        self.augment, self.network = augment, nn.Conv2d(4, 4, 1)

    def forward(self, srgb: Tensor) -> Tensor:
        pair: RawPair = self.augment(srgb)
        return (self.network(pair.noisy) - pair.clean).abs().mean()


def test_ddp_trains_with_the_augmentation_inside(augment: RawAugment, tmp_path: Path) -> None:
    def steps() -> int:
        network = nn.parallel.DistributedDataParallel(Augmented(augment))
        for _ in range(3):  # what has no gradient in the first step is found missing in the second
            network(torch.rand(2, 3, 8, 8)).backward()
        return sum(parameter.requires_grad for parameter in network.module.augment.parameters())

    assert in_two_processes(steps, tmp_path) == [0, 0]


def brightness(loader: Any) -> list[float]:
    return [float(clean.mean()) for pair in loader for clean in pair.clean]


@pytest.mark.parametrize("shuffle", [False, True])
def test_each_process_has_its_share_of_a_wrapped_loader(augment: RawAugment, tmp_path: Path, shuffle: bool) -> None:
    everything = brightness(wrap(DataLoader(pictures(), batch_size=8), augment))  # type: ignore[arg-type]

    def passes() -> list[list[float]]:
        torch.manual_seed(distributed.get_rank())  # no order may depend on it
        loader = wrap(DataLoader(pictures(), batch_size=2, shuffle=shuffle), augment)  # type: ignore[arg-type]
        assert len(loader) == 2 and isinstance(loader.sampler, DistributedSampler)
        return [brightness(loader), brightness(loader)]

    first, second = in_two_processes(passes, tmp_path)
    for one, other in zip(first, second, strict=True):
        assert sorted(one + other) == pytest.approx(sorted(everything))
    assert (first[0] != first[1]) == shuffle


def test_samples_with_an_identity_draw_alike_in_every_process(
    augment: RawAugment, as_rank: Callable[[int, int], None]
) -> None:
    noisy_camera = RawAugment(augment.isp, noise=(0.01, 0.01))

    def drawn(identity: str | None) -> Tensor:
        samples = iter([{"__key__": "a", "png": pictures()[3]}])
        (sample,) = RawPairStream(samples, noisy_camera, crop=4, key="png", identity=identity)
        noisy: Tensor = sample["png"].noisy
        return noisy

    alone, counted = drawn("__key__"), drawn(None)
    as_rank(1, 2)
    assert torch.equal(drawn("__key__"), alone) and not torch.equal(drawn(None), counted)


@pytest.mark.parametrize("drop_last", [False, True])
def test_an_odd_picture_is_dropped_or_given_twice(
    augment: RawAugment, as_rank: Callable[[int, int], None], drop_last: bool
) -> None:
    given = []
    for rank in range(2):
        as_rank(rank, 2)
        loader: Any = DataLoader(pictures()[:7], batch_size=1, drop_last=drop_last)  # type: ignore[arg-type]
        share = wrap(loader, augment).share
        given += [int(level) for batch in share for level in batch[:, 0, 0, 0]]
    assert sorted(given) == (list(LEVELS)[:6] if drop_last else sorted([*LEVELS[:7], LEVELS[0]]))


@pytest.mark.parametrize("chosen", ["sampler", "batch sampler", "replacement", "no loader"])
def test_a_chosen_order_is_left_alone(augment: RawAugment, as_rank: Callable[[int, int], None], chosen: str) -> None:
    shown: Any = pictures()
    loaders: dict[str, Any] = {
        "sampler": DataLoader(shown, sampler=DistributedSampler(shown, num_replicas=2, rank=0)),
        "batch sampler": DataLoader(shown, batch_sampler=BatchSampler(SequentialSampler(shown), 2, False)),
        "replacement": DataLoader(shown, sampler=RandomSampler(shown, replacement=True, num_samples=3)),
        "no loader": [torch.stack(shown)],
    }
    as_rank(0, 2)
    assert wrap(loaders[chosen], augment).share is loaders[chosen]
