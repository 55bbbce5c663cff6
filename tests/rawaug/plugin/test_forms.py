"""How pairs are handed over: names, tuples, the order of planes; folders in place of datasets."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from torch import Tensor
from torch.utils.data import Dataset

import rawaug
from rawaug.bayer import CFA, unpack
from rawaug.data.demo import demo_photographs
from rawaug.io import write_picture
from rawaug.isp.model import DictionaryISP
from rawaug.plugin.augment import RawAugment
from rawaug.plugin.dataset import RawPairs
from rawaug.plugin.draw import Draw
from rawaug.plugin.params import PairForm, pair_form
from rawaug.plugin.stream import RawPairStream
from rawaug.plugin.wrapped import wrap


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("photographs")
    for number, picture in enumerate([*demo_photographs("train").values()] * 2):
        write_picture(path / f"{number}.png", picture[:, : 64 + 2 * number, :80])
    return path


@pytest.fixture(scope="module")
def srgb() -> Tensor:
    return torch.randint(256, (2, 3, 16, 20), generator=torch.Generator().manual_seed(0), dtype=torch.uint8)


def test_a_path_is_a_folder_of_pictures(augment: RawAugment, folder: Path) -> None:
    pairs = RawPairs(folder, augment, crop=32)
    assert len(pairs) == 4 and pairs[2].noisy.shape == (4, 16, 16)
    assert torch.equal(RawPairs(str(folder), augment, crop=32)[2].noisy, RawPairs(folder, augment, crop=32)[2].noisy)
    stream = RawPairStream(folder, augment, crop=32)
    assert len(list(stream)) == 4
    batches = list(wrap(folder, augment, crop=32, batch_size=3, shuffle=True))
    assert [len(pair.noisy) for pair in batches] == [3, 1]
    assert len(RawPairs("shapes:5", augment, crop=32)) == 5

    with pytest.raises(FileNotFoundError):
        RawPairs("no such folder", augment)
    with pytest.raises(ValueError, match="folder"):
        RawPairs([str(folder / "0.png")], augment, crop=32)[0]
    with pytest.raises(ValueError, match="loader"):
        wrap([torch.rand(1, 3, 8, 8)], augment, batch_size=3)


def test_names_of_pictures_and_levels(folder: Path) -> None:
    augment = RawAugment.from_pretrained("universal", target="srgb")
    keys = {"L": "noisy", "H": "clean", "L_path": "name", "sigma": "level"}
    sample = RawPairs(folder, augment, crop=32, keys=keys)[1]
    assert list(sample) == list(keys) and sample["L_path"] == str(folder / "1.png")
    assert torch.isclose(sample["sigma"], (sample["L"] - sample["H"]).square().mean().sqrt())

    own = [{"image": torch.rand(3, 32, 32), "name": "cat"}]
    with pytest.raises(ValueError, match="name already"):
        RawPairs(own, augment, crop=32, key="image", keys={"lq": "noisy", "name": "name"})[0]
    (batch,) = wrap([torch.rand(2, 3, 16, 16)], augment, keys={"x": "clean", "level": "level"})
    assert batch["level"].shape == (2,)
    with pytest.raises(ValueError, match="no names"):
        next(iter(wrap([torch.rand(2, 3, 16, 16)], augment, keys={"path": "name"})))


def test_a_tuple_in_any_order(augment: RawAugment, srgb: Tensor) -> None:
    pictures = list(srgb)
    clean, noisy = RawPairs(pictures, augment, crop=16, fields=("clean", "noisy"))[0]
    pair = RawPairs(pictures, augment, crop=16)[0]
    assert torch.equal(clean, pair.clean) and torch.equal(noisy, pair.noisy)
    (sample,) = wrap([(srgb, ["a", "b"])], augment, fields=("noisy",))
    assert sample[0][0].shape == (2, 4, 8, 10) and sample[1] == ["a", "b"]


@pytest.mark.parametrize("cfa", [str(cfa) for cfa in CFA])
def test_a_cfa_orders_planes_as_pixel_unshuffle_does(augment: RawAugment, srgb: Tensor, cfa: str) -> None:
    packed = RawPairs(list(srgb), augment, crop=16)[0].noisy
    ordered = RawPairs(list(srgb), augment, crop=16, order=cfa)[0].noisy
    assert torch.equal(ordered, F.pixel_unshuffle(unpack(packed[None], cfa), 2)[0])


def test_other_orders_of_planes(augment: RawAugment, srgb: Tensor) -> None:
    packed = RawPairs(list(srgb), augment, crop=16)[0]
    for order, planes in (("RGBG", [0, 1, 3, 2]), (("Gb", "B", "Gr", "R"), [2, 3, 1, 0])):
        ordered = RawPairs(list(srgb), augment, crop=16, order=order)[0]
        assert torch.equal(ordered.noisy, packed.noisy[planes]) and torch.equal(
            ordered.variance, packed.variance[planes]
        )
    (batch,) = wrap([srgb], augment, order="RGBG")
    assert torch.equal(batch.clean, next(iter(wrap([srgb], augment))).clean[:, [0, 1, 3, 2]])
    assert pair_form() == PairForm()


def test_what_opencv_reads_is_bgr(augment: RawAugment, srgb: Tensor) -> None:
    arrays = [picture.permute(1, 2, 0).numpy()[..., ::-1] for picture in srgb]  # as cv2.imread
    expected = RawPairs(list(srgb), augment, crop=16)[1].noisy
    assert torch.equal(RawPairs(arrays, augment, crop=16, bgr=True)[1].noisy, expected)
    assert not torch.equal(RawPairs(arrays, augment, crop=16)[1].noisy, expected)
    (batch,) = wrap([np.stack(arrays)], augment, bgr=True)
    assert torch.equal(batch.noisy, next(iter(wrap([srgb], augment))).noisy)


class Labelled(Dataset[tuple[Tensor, int]]):
    """Pictures with labels, as torchvision's ImageFolder."""

    classes = ("cat", "dog")

    def __len__(self) -> int:
        return 2

    def __getitem__(self, index: int) -> tuple[Tensor, int]:
        return torch.rand(3, 16, 16), index


def test_attributes_of_the_dataset_are_those_of_the_pairs(augment: RawAugment) -> None:
    pairs = RawPairs(Labelled(), augment, crop=16)
    assert pairs.classes == ("cat", "dog") and pairs[1][1] == 1
    with pytest.raises(AttributeError):
        pairs.nothing  # noqa: B018 (raises)


@pytest.mark.parametrize(
    "settings",
    [
        {"keys": "noisy"},
        {"keys": ("a", "a")},
        {"keys": {"a": "sharp"}},
        {"keys": {}},
        {"fields": ("sharp",)},
        {"fields": "noisy"},
        {"keys": ("a",), "fields": ("noisy",)},
        {"order": "RGGG"},
        {"order": "RGB"},
        {"order": ("R", "G1", "G2", "B")},
    ],
)
def test_other_forms_are_refused(augment: RawAugment, srgb: Tensor, settings: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=r"keys|fields|order"):
        rawaug.RawPairs(list(srgb), augment, crop=16, **settings)


def test_the_picture_comes_beside_its_raw_with_what_a_file_says(universal: DictionaryISP) -> None:
    pictures = list(torch.randint(256, (2, 3, 40, 48), generator=torch.Generator().manual_seed(0), dtype=torch.uint8))
    augment = RawAugment(universal, noise=(1e-9, 0.0), draw=Draw(exposure=-1.0))
    pairs = RawPairs(pictures, augment, crop=16, keys={"raw": "clean", "rgb": "picture", "params": "params"}).freeze()
    for number in range(2):
        sample = pairs[number]
        assert sample["rgb"].shape == (3, 16, 16) and sample["rgb"].dtype == torch.float32
        patch = (sample["rgb"] * 255).round().to(torch.uint8)
        assert torch.equal(augment.apply(patch, sample["params"]).clean, sample["raw"]), "the crop, as it was turned"

        camera = sample["params"].camera()
        grey = torch.tensor([[[0.2]]]).expand(3, 16, 16)
        red, green_r, green_b, blue = augment.apply(grey, sample["params"]).clean.mean((1, 2))
        neutral = torch.stack([red, green_r, blue]) / green_b
        assert torch.allclose(neutral, camera["AsShotNeutral"], rtol=1e-3)
        assert torch.allclose(camera["white_balance"] * neutral[[0, 1, 1, 2]], torch.ones(4), rtol=1e-3)
        assert camera["NoiseProfile"].tolist() == pytest.approx([1e-9, 0.0])
        assert torch.allclose(camera["camera_to_srgb"] @ sample["params"].isp.matrix, torch.eye(3), atol=1e-5)
    (batch,) = wrap([torch.stack(pictures)], augment, crop=16, keys={"rgb": "picture"})
    assert batch["rgb"].shape == (2, 3, 16, 16)
