"""Wrapped loaders: pairs in place of pictures, all else as it was."""

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
from torch.utils.data import DataLoader, TensorDataset

from rawaug.isp.model import DictionaryISP
from rawaug.plugin.augment import RawAugment
from rawaug.plugin.params import RawPair
from rawaug.plugin.wrapped import wrap


@pytest.fixture
def srgb() -> Tensor:
    return torch.randint(256, (6, 3, 16, 20), generator=torch.Generator().manual_seed(0), dtype=torch.uint8)


def different_sizes() -> list[Tensor]:
    return [torch.full((3, 17 + i, 30 - i), 20 * i, dtype=torch.uint8) for i in range(4)]


def batches_of(pictures: Any, size: int, **settings: Any) -> DataLoader[Any]:
    return DataLoader(pictures, batch_size=size, **settings)


def noisy(loader: Any) -> Tensor:
    return torch.cat([pair.noisy for pair in loader])


def test_wrapping_a_loader_is_one_line(augment: RawAugment, srgb: Tensor) -> None:
    loader = DataLoader(TensorDataset(srgb, torch.arange(6)), batch_size=4)
    wrapped = wrap(loader, augment)
    batches = list(wrapped)
    assert len(wrapped) == len(batches) == 2 and wrapped.batch_size == 4 and wrapped.dataset is loader.dataset
    pair, labels = batches[0]
    assert pair.noisy.shape == (4, 4, 8, 10) and labels.tolist() == [0, 1, 2, 3]


def test_each_pass_is_another_epoch_that_can_be_had_again(augment: RawAugment, srgb: Tensor) -> None:
    wrapped = wrap(batches_of(srgb, 2), augment)
    first, second = noisy(wrapped), noisy(wrapped)
    same = noisy(wrap([srgb[:1], srgb[:1]], augment))
    assert not torch.equal(same[0], same[1])
    assert not torch.equal(first, second)
    wrapped.set_epoch(1)
    assert torch.equal(noisy(wrapped), second)
    resumed = wrap(batches_of(srgb[2:], 2), augment)
    resumed.set_epoch(1, start=1)
    assert torch.equal(noisy(resumed), second[2:])


@pytest.mark.parametrize("form", ["list", "numpy", "tuples", "dict"])
def test_pictures_of_different_sizes_with_a_crop(augment: RawAugment, form: str) -> None:
    pictures = different_sizes()
    batches: dict[str, Any] = {
        "list": pictures,
        "numpy": [picture.permute(1, 2, 0).numpy() for picture in pictures],
        "tuples": (tuple(pictures), (0, 1, 2, 3)),
        "dict": {"image": pictures, "id": [0, 1, 2, 3]},
    }
    loader = batches_of(range(4), 4, collate_fn=lambda _: batches[form])
    (batch,) = wrap(loader, augment, key="image" if form == "dict" else None, crop=16)
    if form in ("tuples", "dict"):
        pair, ids = batch if form == "tuples" else (batch["image"], batch["id"])
        assert list(ids) == [0, 1, 2, 3]
    else:
        pair = batch
    assert isinstance(pair, RawPair) and pair.noisy.shape == (4, 4, 8, 8)
    assert pair.params.crop[:, 2:4].tolist() == [[16, 30], [18, 28], [18, 28], [20, 26]]


def test_crops_are_where_the_parameters_say(augment: RawAugment) -> None:
    ramp = torch.arange(40 * 50).reshape(1, 40, 50).expand(3, -1, -1) % 256
    picture = ramp.to(torch.uint8)
    (pair,) = wrap([[picture, picture]], augment, crop=16)
    places = pair.params.crop.tolist()
    assert places[0] != places[1]
    patches = torch.stack([picture[:, t : t + 16, left : left + 16] for t, left, *_ in places])
    assert torch.equal(augment.apply(patches, pair.params).noisy, pair.noisy)


def test_what_makes_no_batch_is_refused(augment: RawAugment) -> None:
    with pytest.raises(ValueError, match=r"wrap\(..., crop=256\)"):
        next(iter(wrap([different_sizes()], augment)))
    with pytest.raises(ValueError, match="crop"):
        next(iter(wrap([different_sizes()], augment, crop=20)))
    with pytest.raises(ValueError, match="even"):
        wrap([], augment, crop=15)


def test_a_wrapped_loader_can_be_copied_and_pickled(augment: RawAugment, srgb: Tensor) -> None:
    wrapped = wrap([srgb], augment)
    for again in (copy.copy(wrapped), pickle.loads(pickle.dumps(wrapped))):
        again.set_epoch(0)
        wrapped.set_epoch(0)
        assert torch.equal(noisy(again), noisy(wrapped))
    with pytest.raises(AttributeError, match="nothing"):
        wrapped.nothing  # noqa: B018 (raises)


@pytest.mark.usefixtures("no_gpu")
@pytest.mark.parametrize(("device", "said"), [("cuda", "cpu or auto"), ("cdua", "nearest: cuda")])
def test_a_device_that_is_not_there_is_said_at_once(augment: RawAugment, device: str, said: str) -> None:
    with pytest.raises(ValueError, match=rf"device '{device}'.*{said}"):
        wrap([], augment, device=device)
    assert wrap([], augment, device="auto").device.type == "cpu"


@pytest.mark.gpu
def test_pinned_pictures_become_pairs_on_the_gpu(srgb: Tensor) -> None:
    augment = RawAugment(DictionaryISP())
    loader = DataLoader(TensorDataset(srgb, torch.arange(6)), batch_size=3, pin_memory=True, num_workers=2)
    for pair, labels in wrap(loader, augment, device="cuda"):
        assert pair.noisy.is_cuda and pair.variance.is_cuda and labels.is_pinned()


def test_a_loader_of_single_pictures_makes_single_crops(augment: RawAugment) -> None:
    pictures = [torch.rand(3, 24, 30) for _ in range(3)]
    pairs = list(wrap(DataLoader(pictures, batch_size=None), augment, crop=16))  # type: ignore[arg-type]
    assert [pair.noisy.shape for pair in pairs] == [(1, 4, 8, 8)] * 3


@pytest.mark.parametrize("batch", [1, 3, 4, 5])
def test_a_batch_of_grey_pictures_is_no_colour_picture(augment: RawAugment, batch: int) -> None:
    grey = torch.rand(batch, 9, 11)  # odd sides lose a line
    (pair,) = wrap(DataLoader(grey, batch_size=batch), augment)  # type: ignore[arg-type]
    (expected,) = wrap([grey[:, None, :8, :10].expand(-1, 3, -1, -1)], augment)
    assert torch.equal(pair.noisy, expected.noisy) and len(pair.noisy) == batch


def test_processes_of_a_distributed_run_draw_apart(
    augment: RawAugment, srgb: Tensor, as_rank: Callable[[int, int], None]
) -> None:
    (alone,) = wrap([srgb], augment)
    drawn: list[RawPair] = []
    for rank in range(3):
        as_rank(rank, 3)
        drawn += wrap([srgb], augment)
        drawn.append(RawAugment(augment.isp, seed=1)(srgb))
    assert torch.equal(drawn[0].noisy, alone.noisy)
    assert len({tuple(pair.params.isp.gains.flatten().tolist()) for pair in drawn}) == 6


def shuffled(srgb: Tensor, workers: int = 0) -> DataLoader[Any]:
    generator = torch.Generator().manual_seed(1)
    return batches_of(srgb, 2, shuffle=True, generator=generator, num_workers=workers)


@pytest.mark.parametrize(("done", "workers"), [(0, 0), (1, 0), (2, 2), (3, 0), (4, 2)])
def test_a_state_goes_on_where_it_was_taken(augment: RawAugment, srgb: Tensor, done: int, workers: int) -> None:
    straight = wrap(shuffled(srgb), augment)
    expected = [pair.noisy for _ in range(3) for pair in straight]
    first = wrap(shuffled(srgb, workers), augment)
    for _ in range(done // 3):
        noisy(first)
    part = iter(first)
    for _ in range(done % 3):
        next(part)
    resumed = wrap(shuffled(srgb, workers), augment)
    resumed.load_state_dict(pickle.loads(pickle.dumps(first.state_dict())))
    rest = [pair.noisy for _ in range(3 - done // 3) for pair in resumed]
    assert len(rest) == 9 - done and all(map(torch.equal, rest, expected[done:]))


def test_a_loop_that_stops_at_the_last_batch_has_ended_the_pass(augment: RawAugment, srgb: Tensor) -> None:
    wrapped = wrap(batches_of(srgb, 2), augment)
    list(islice(wrapped, len(wrapped)))
    state = wrapped.state_dict()
    assert (state["epoch"], state["batch"], "order" in state) == (1, 0, False)


class Resumable(list[Tensor]):
    """A loader that goes on by itself, as torchdata's StatefulDataLoader."""

    seen = 0

    def __iter__(self) -> Iterator[Tensor]:
        while self.seen < len(self):
            self.seen += 1
            yield self[self.seen - 1]
        self.seen = 0

    def state_dict(self) -> dict[str, int]:
        return {"seen": self.seen}

    def load_state_dict(self, state: dict[str, int]) -> None:
        self.seen = state["seen"]


def test_a_loader_that_resumes_itself_passes_nothing_over(augment: RawAugment, srgb: Tensor) -> None:
    expected = noisy(wrap([*srgb.split(2)], augment))
    wrapped, resumed = (wrap(Resumable(srgb.split(2)), augment) for _ in range(2))
    next(iter(wrapped))
    resumed.load_state_dict(wrapped.state_dict())
    assert torch.equal(noisy(resumed), expected[2:])


def test_lightning_resumes_in_the_middle_of_an_epoch(
    augment: RawAugment, srgb: Tensor, tmp_path: Path, lightning_run: Callable[..., Any]
) -> None:
    def train(steps: int, checkpoint: Path | None = None) -> tuple[list[Tensor], Any]:
        seen: tuple[list[Tensor], Any] = lightning_run(wrap(shuffled(srgb), augment), checkpoint, max_steps=steps)
        return seen

    expected, _ = train(7)
    assert len({float(noisy.sum()) for noisy in expected}) == 7
    begun, trainer = train(4)
    trainer.save_checkpoint(tmp_path / "at4.ckpt")
    rest, _ = train(7, tmp_path / "at4.ckpt")
    assert all(map(torch.equal, begun + rest, expected))


@pytest.mark.parametrize("crop", [(4, 8), [4, 8]])
def test_flat_keys_and_oblong_crops(augment: RawAugment, srgb: Tensor, crop: Any) -> None:
    loader = [{"image": srgb, "id": 3}]
    (batch,) = wrap(loader, augment, key="image", crop=crop, keys=("lq", "gt"))
    assert list(batch) == ["id", "lq", "gt"] and batch["gt"].shape == (6, 4, 2, 4)
