"""Datasets of pairs: keyed by seed, epoch and index, whatever the loader does; streams too."""

from __future__ import annotations

import inspect
import io
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from itertools import islice
from multiprocessing.reduction import ForkingPickler
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image
from torch import Tensor
from torch.utils.data import DataLoader, IterableDataset, get_worker_info

from rawaug import bayer
from rawaug.isp.config import ISPConfig
from rawaug.isp.model import DictionaryISP
from rawaug.plugin.augment import RawAugment
from rawaug.plugin.crops import draw_crop
from rawaug.plugin.dataset import RawPairs
from rawaug.plugin.params import RawPair
from rawaug.plugin.stream import RawPairStream
from rawaug.plugin.wrapped import wrap

COUNT = 12


@pytest.fixture(scope="module")
def pictures() -> list[Tensor]:
    """Pictures of different sizes, some sides odd."""
    generator = torch.Generator().manual_seed(0)
    return [torch.randint(256, (3, 21 + i, 34 - i), generator=generator, dtype=torch.uint8) for i in range(COUNT)]


@pytest.fixture(scope="module")
def expected(augment: RawAugment, pictures: list[Tensor]) -> Tensor:
    """The noisy pictures of epoch 2, one by one."""
    pairs = RawPairs(pictures, augment, crop=16, seed=7)
    pairs.set_epoch(2)
    return torch.stack([pairs[i].noisy for i in range(COUNT)])


@pytest.mark.parametrize(
    ("workers", "batch", "start_method", "start"),
    [
        (0, 1, None, 0),
        (0, 5, None, 5),
        (3, 2, "fork", 0),
        (1, 5, "forkserver", 7),
    ],
)
def test_pairs_are_the_same_however_they_are_loaded(
    augment: RawAugment,
    pictures: list[Tensor],
    expected: Tensor,
    workers: int,
    batch: int,
    start_method: str | None,
    start: int,
) -> None:
    pairs = RawPairs(pictures, augment, crop=16, seed=7)
    pairs.set_epoch(2)
    rest = range(start, COUNT)  # as a sampler that was resumed in the middle of the epoch
    loader = DataLoader(pairs, batch, sampler=rest, num_workers=workers, multiprocessing_context=start_method)
    assert torch.equal(torch.cat([pair.noisy for pair in loader]), expected[start:])


def test_patches_are_cropped_then_turned_as_the_parameters_say(augment: RawAugment, pictures: list[Tensor]) -> None:
    pairs = RawPairs(pictures, augment, crop=16).freeze()
    views = set()
    for i in range(COUNT):
        top, left, height, width, view = pairs[i].params.crop.tolist()
        assert (height, width) == tuple(side // 2 * 2 for side in pictures[i].shape[1:])
        patch = bayer.turn(pictures[i][:, top : top + 16, left : left + 16], view)
        assert torch.equal(augment.apply(patch, pairs[i].params).noisy, pairs[i].noisy)
        views.add(view)
    assert len(views) > 3
    upright = RawPairs(pictures, augment, crop=16, views=False)
    assert {int(upright[i].params.crop[4]) for i in range(COUNT)} == {0}


def test_another_epoch_or_seed_is_another_draw(augment: RawAugment, pictures: list[Tensor]) -> None:
    pairs = RawPairs(pictures, augment, crop=16, seed=7)
    first = pairs[0].clean
    pairs.freeze(1)
    assert torch.equal(pairs[0].clean, pairs[0].clean)
    assert not torch.equal(pairs[0].clean, first)
    pairs.freeze()
    assert torch.equal(pairs[0].clean, first)
    assert not torch.equal(RawPairs(pictures, augment, crop=16, seed=8)[0].clean, first)


def test_indices_are_those_of_a_sequence(augment: RawAugment, pictures: list[Tensor]) -> None:
    pairs = RawPairs(pictures, augment, crop=16).freeze()
    assert torch.equal(pairs[-1].noisy, pairs[COUNT - 1].noisy)
    assert torch.equal(pairs[torch.tensor(3)].noisy, pairs[3].noisy)  # type: ignore[index]
    with pytest.raises(IndexError):
        pairs[COUNT]


@pytest.mark.parametrize("kind", ["map-style", "stream"])
def test_persistent_workers_see_the_epoch(augment: RawAugment, pictures: list[Tensor], kind: str) -> None:
    dataset: RawPairs | RawPairStream = RawPairs(pictures, augment, crop=16)
    if kind == "stream":
        dataset = RawPairStream(Counted(pictures, strided=True), augment, crop=16)
    loader = DataLoader(dataset, num_workers=2, persistent_workers=True)
    first = next(iter(loader)).clean
    dataset.set_epoch(1)
    again = next(iter(loader)).clean
    assert not torch.equal(first, again)
    pairs = RawPairs(pictures, augment, crop=16)
    pairs.set_epoch(1)
    assert torch.equal(again[0], pairs[0].clean)


def test_labels_and_fields_pass_through(augment: RawAugment) -> None:
    picture = np.zeros((16, 20, 3), np.uint8)
    labelled = RawPairs([(Image.fromarray(picture), 3), (Image.fromarray(picture), 4)], augment, crop=16)
    pair, labels = next(iter(DataLoader(labelled, batch_size=2)))
    assert pair.noisy.shape == (2, 4, 8, 8) and labels.tolist() == [3, 4]
    sample = RawPairs([{"image": picture, "id": "x"}], augment, crop=16, key="image")[0]
    assert isinstance(sample["image"], RawPair) and sample["id"] == "x"


def test_small_pictures_and_odd_crops_are_refused(augment: RawAugment, pictures: list[Tensor]) -> None:
    with pytest.raises(ValueError, match="crop"):
        RawPairs(pictures, augment, crop=64)[0]
    with pytest.raises(ValueError, match="even"):
        RawPairs(pictures, augment, crop=15)
    with pytest.raises(ValueError, match="float"):
        RawPairs([torch.full((3, 8, 8), 255.0)], augment, crop=None)[0]


def test_oblong_crops_are_flipped_only(augment: RawAugment, pictures: list[Tensor]) -> None:
    pairs = RawPairs(pictures, augment, crop=(12, 20))
    assert pairs[0].noisy.shape == (4, 6, 10)
    assert {int(pairs[i].params.crop[4]) for i in range(COUNT)} <= {0, 1, 2, 3}
    pair = pairs[2]
    assert torch.equal(pairs.replay(2, pair.params).noisy, pair.noisy)
    for wrong in ((12, 21), (12,), "12", 12.0):
        with pytest.raises(ValueError, match="even"):
            RawPairs(pictures, augment, crop=wrong)  # type: ignore[arg-type]


def test_flat_keys_are_where_a_script_looks(augment: RawAugment) -> None:
    picture = np.zeros((16, 16, 3), np.uint8)

    def sample(of: Any, key: Any = None, keys: Any = ("noisy", "clean")) -> Any:
        pairs = RawPairs([of], augment, crop=16, key=key, keys=keys)
        pairs.set_epoch(0)
        return pairs[0]

    pair, flat = sample(picture, keys=None), sample(picture)
    assert list(flat) == ["noisy", "clean"]
    assert torch.equal(flat["noisy"], pair.noisy) and torch.equal(flat["clean"], pair.clean)
    named = sample({"image": picture, "id": 3}, "image", ("lq", "gt", "sigma2", "params"))
    assert list(named) == ["id", "lq", "gt", "sigma2", "params"] and torch.equal(named["sigma2"], pair.variance)
    assert list(sample({"image": picture}, "image", ("image", "clean"))) == ["image", "clean"]
    assert list(sample((picture, 3))[0]) == ["noisy", "clean"]
    with pytest.raises(ValueError, match="samples"):
        sample({"image": picture, "clean": 1}, "image")
    for wrong in ("noisy", (), ("a", "a"), ("a", "b", "c", "d", "e")):
        with pytest.raises(ValueError, match="variance"):
            sample(picture, keys=wrong)


def test_what_makes_pairs_may_be_a_name(pictures: list[Tensor]) -> None:
    assert RawPairs(pictures, "universal", crop=16)[0].noisy.shape == (4, 8, 8)
    assert next(iter(wrap([pictures[0][None]], "universal"))).noisy.shape == (1, 4, 10, 17)
    assert RawPairs(pictures, "universal", crop=None)[0].noisy.shape == (4, 10, 17), "whole, without the odd line"
    with pytest.raises(TypeError, match="path"):
        RawPairs(pictures, 3)  # type: ignore[call-overload]
    with pytest.raises(FileNotFoundError, match="nosuch"):
        RawPairs(pictures, Path("nosuch.safetensors"))


def test_a_spawned_worker_gets_kilobytes(pictures: list[Tensor]) -> None:
    stream = io.BytesIO()
    ForkingPickler(stream).dump(RawPairs(pictures, RawAugment.from_pretrained("universal")))  # as Process.start does
    assert len(stream.getvalue()) < 64_000  # the tables, of megabytes, are shared memory


class Counted(IterableDataset[Any]):
    """(number, picture) in order; ``strided`` divides them between workers, else each worker has all."""

    def __init__(self, pictures: list[Tensor], strided: bool) -> None:
        self.pictures, self.strided, self.epoch = pictures, strided, 0

    def set_epoch(self, epoch: int) -> None:
        self.epoch = epoch

    def __iter__(self) -> Iterator[Any]:
        info = get_worker_info()
        mine = (info.id, None, info.num_workers) if info and self.strided else (0, None, 1)
        return islice(iter(self.pictures), *mine)


class Shards(IterableDataset[Any]):
    """Dicts with a name, in four shards of three, whole shards to each worker."""

    def __init__(self, pictures: list[Tensor]) -> None:
        self.pictures = pictures

    def __iter__(self) -> Iterator[Any]:
        info = get_worker_info()
        worker, workers = (info.id, info.num_workers) if info else (0, 1)
        for shard in range(worker, 4, workers):
            for i in range(3 * shard, 3 * shard + 3):
                yield {"jpg": self.pictures[i], "__key__": f"{i:03d}"}


def values(pairs: Any) -> set[float]:
    return {float(pair.noisy.sum()) for pair in pairs}


@pytest.mark.parametrize("workers", [0, 1, 3])
@pytest.mark.parametrize("divided_by", ["dataset", "stream"])
def test_a_stream_in_turns_keeps_its_draws(
    augment: RawAugment, pictures: list[Tensor], expected: Tensor, workers: int, divided_by: str
) -> None:
    dataset = Counted(pictures, strided=divided_by == "dataset")
    stream = RawPairStream(dataset, augment, crop=16, seed=7, divide=divided_by == "stream")
    stream.set_epoch(2)
    got = [float(noisy.sum()) for pair in DataLoader(stream, num_workers=workers) for noisy in pair.noisy]
    assert got == [float(noisy.sum()) for noisy in expected], "one a batch, in the order of the stream"


@pytest.mark.parametrize("workers", [1, 2, 4])
def test_shards_keep_their_draws_by_identity(augment: RawAugment, pictures: list[Tensor], workers: int) -> None:
    stream = RawPairStream(Shards(pictures), augment, crop=16, key="jpg", identity="__key__")
    loaded = DataLoader(stream, batch_size=2, num_workers=workers)
    got = {key: noisy for s in loaded for key, noisy in zip(s["__key__"], s["jpg"].noisy, strict=True)}
    assert len(got) == COUNT
    again = RawPairStream(Shards(pictures), augment, crop=16, key="jpg", identity="__key__")
    assert all(torch.equal(got[sample["__key__"]], sample["jpg"].noisy) for sample in again)


def test_workers_of_a_stream_share_no_draw(augment: RawAugment) -> None:
    same = [torch.full((3, 16, 16), 128, dtype=torch.uint8)] * 6
    stream = RawPairStream(Counted(same, strided=False), augment, crop=16)
    assert len(values(DataLoader(stream, num_workers=2))) == 12  # as plain PyTorch: each worker has all


def test_an_iterable_needs_a_stream_which_forwards_the_epoch_to_it(augment: RawAugment, pictures: list[Tensor]) -> None:
    dataset = Counted(pictures, strided=True)
    for iterable in (dataset, iter(pictures)):
        with pytest.raises(TypeError, match="RawPairStream"):
            RawPairs(iterable, augment, crop=16)
    stream = RawPairStream(dataset, augment, crop=16)
    stream.set_epoch(4)
    assert dataset.epoch == 4
    with pytest.raises(TypeError, match=r"Counted.*length"):
        len(stream)
    with pytest.raises(ValueError, match="identity='name'"):
        next(iter(RawPairStream(Shards(pictures), augment, crop=16, key="jpg", identity="name")))


def test_a_dataset_and_a_stream_show_the_same_parameters_and_what_they_draw(
    augment: RawAugment, pictures: list[Tensor]
) -> None:
    of_dataset, of_stream, of_loader = (
        list(inspect.signature(made).parameters) for made in (RawPairs, RawPairStream, wrap)
    )
    assert of_dataset[:4] == ["dataset", "augment", "crop", "seed"]
    assert of_stream[: len(of_dataset)] == of_dataset
    of_batches = ["device", "batch_size", "shuffle"]
    assert of_loader[1:] == [name for name in of_dataset[1:] if name in of_loader] + of_batches
    pairs, stream = (
        RawPairs(pictures, augment, crop=(16, 12)),
        RawPairStream(iter(pictures), augment, crop=None, seed=3),
    )
    assert repr(pairs).splitlines()[0] == f"RawPairs of {COUNT} pictures, crops of 16 x 12, seed 0"
    assert repr(stream) == f"RawPairStream of list_iterator, uncropped, seed 3\n{augment!r}"


FORKED_AFTER_LIBRAW = """
import sys
import rawpy, torch
from torch.utils.data import DataLoader
from rawaug import DictionaryISP, RawAugment, RawPairs

pictures = []
for path in sys.argv[1:]:
    with rawpy.imread(path) as raw:
        pictures.append(torch.from_numpy(raw.postprocess().copy()))
pairs = RawPairs(pictures, RawAugment(DictionaryISP()), crop=128)
list(pairs)  # the parent's threads have worked too
for run in range(3):
    loader = DataLoader(pairs, num_workers=2, multiprocessing_context="fork")
    assert sum(pair.noisy.numel() for pair in loader) == len(pictures) * 4 * 64 * 64
print("done")
"""


@pytest.mark.long
def test_forked_workers_do_not_hang_after_libraw_has_developed(bayer_dng: Callable[..., Path], tmp_path: Path) -> None:
    numbers = np.random.default_rng(0).integers(4096, size=(2, 512, 768), dtype=np.uint16)
    files = [str(bayer_dng(tmp_path / f"{i}.dng", array)) for i, array in enumerate(numbers)]
    many_threads = {key: value for key, value in os.environ.items() if key != "OMP_NUM_THREADS"}
    command = [sys.executable, "-c", FORKED_AFTER_LIBRAW, *files]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, env=many_threads, check=False)
    assert done.stdout == "done\n", done.stderr


def test_half_of_the_crops_are_enlarged_and_replayed(augment: RawAugment, pictures: list[Tensor]) -> None:
    pairs = RawPairs(pictures * 8, augment, crop=16, zoom=2.0)
    rows = []
    for i in range(len(pairs)):
        pair = pairs[i]
        assert pair.noisy.shape == (4, 8, 8) and len(pair.params.crop) == 6
        assert torch.equal(pairs.replay(i, pair.params).noisy, pair.noisy)
        rows.append(int(pair.params.crop[5]))
    assert 8 <= min(rows) < 12 and max(rows) == 16
    for wrong in ({"zoom": 0.5}, {"zoom": 2.0, "crop": None}):
        with pytest.raises(ValueError, match="zoom"):
            RawPairs(pictures, augment, **wrong)


def test_half_of_the_crops_are_enlarged() -> None:
    generator = torch.Generator().manual_seed(0)
    rows = [int(draw_crop((64, 64), (32, 32), True, generator, zoom=2.0)[5]) for _ in range(1000)]
    assert 0.4 < sum(side < 32 for side in rows) / len(rows) < 0.6


def test_absurd_weights_end_in_a_line_that_names_the_picture(pictures: list[Tensor]) -> None:
    isp = DictionaryISP(ISPConfig(colour_atoms=3, gain_atoms=3))
    weights = isp.state_dict()
    weights["stages.tone.reverse_network.layers.6.bias"].fill_(3e38)  # finite, but nothing after it is
    pairs = RawPairs(pictures, RawAugment(isp), crop=16)
    with pytest.raises(ValueError, match=r"^picture 4: .*not finite.*weights"):
        pairs[4]


def test_an_enlarged_crop_keeps_its_place_in_the_frame() -> None:
    """Twice the size: its pixels lie half as far apart, and its first half a step nearer to the corner."""
    from rawaug.kernels.reference import mask_frame

    plain, large = (mask_frame([10, 20, 100, 200, 0, rows], 16, 16, (0.0, 0.0)) for rows in (16, 8))
    y, x, down, _, _, right = large
    assert (down, right) == pytest.approx((plain[2] / 2, plain[5] / 2))
    assert (y, x) == pytest.approx((plain[0] - plain[2] / 4, plain[1] - plain[5] / 4))


def test_compiled_code_is_loaded_where_pairs_are_made_not_in_every_worker() -> None:
    """A process without compiled code makes RawPairs, and then has what its forked workers take over."""
    script = (
        "import torch, rawaug\n"
        "from rawaug.kernels import cpu\n"
        "assert not cpu._raw_rows.signatures\n"
        "rawaug.RawPairs([torch.rand(3, 32, 32)], 'universal', crop=16)\n"
        "assert cpu._raw_rows.signatures\n"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
