"""The augmentation: pairs that replay, from files too, and batches in the forms that people have."""

from __future__ import annotations

import copy
import math
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image
from safetensors.torch import save_file
from torch import Tensor, nn
from torch.utils.data import DataLoader, Dataset, default_collate

from rawaug.isp.config import ISPConfig, ISPParams
from rawaug.isp.model import DictionaryISP
from rawaug.noise import CalibratedNoise
from rawaug.plugin.augment import RawAugment
from rawaug.plugin.dataset import RawPairs
from rawaug.plugin.draw import Draw
from rawaug.plugin.params import AugmentParams, RawPair, load_params, save_params
from rawaug.plugin.targets import Srgb


@pytest.fixture
def srgb() -> Tensor:
    return torch.randint(256, (3, 3, 16, 20), generator=torch.Generator().manual_seed(0), dtype=torch.uint8)


def assert_same(a: Any, b: Any) -> None:
    if isinstance(a, RawPair):
        assert all(torch.equal(x, y) for x, y in zip(a[:3], b[:3], strict=True))
        assert_same(a.params, b.params)
    else:
        assert isinstance(a, AugmentParams)
        first, second = a.tensors(), b.tensors()
        assert first.keys() == second.keys()
        assert all(torch.equal(first[name], second[name]) for name in first)


@pytest.mark.parametrize("sampling", ["convex", "independent", "perturb", "chosen"])
def test_parameters_replay_the_pair(isp: DictionaryISP, srgb: Tensor, sampling: Any) -> None:
    augment = RawAugment(isp, draw=Draw(sampling=sampling))
    pair = augment(srgb)
    assert pair.noisy.shape == pair.clean.shape == pair.variance.shape == (3, 4, 8, 10)
    assert_same(augment.apply(srgb, pair.params), pair)


def test_noise_keeps_its_sign_at_black_and_is_cut_at_white(augment: RawAugment) -> None:
    black = augment(torch.zeros(4, 3, 64, 64)).noisy
    white = augment(torch.ones(4, 3, 64, 64)).noisy
    assert (black < 0).float().mean() > 0.4
    assert white.max() <= 1.0


def test_draws_differ_but_a_seed_repeats_them(isp: DictionaryISP, srgb: Tensor) -> None:
    a, b = RawAugment(isp, seed=1), RawAugment(isp, seed=1)
    first, second = a(srgb), a(srgb)
    assert not torch.equal(first.clean, second.clean)
    assert_same(b(srgb), first)


def test_a_picture_does_not_depend_on_its_batch(augment: RawAugment, srgb: Tensor) -> None:
    pair = augment(srgb)
    alone = pair.params.map(lambda t: t[1:2])
    torch.testing.assert_close(augment.apply(srgb[1:2], alone).noisy, pair.noisy[1:2])


def test_exposure_darkens_by_its_stops_and_replays(isp: DictionaryISP) -> None:
    dim = torch.full((500, 3, 4, 4), 0.2)  # far from the highlights that the gains spare
    as_is, draws = RawAugment(isp, noise=(0.0, 0.0)), torch.Generator()
    clean = as_is(dim, draws.manual_seed(1)).clean
    for low, high in ((-1.0, -1.0), (-2.0, 1.0)):
        augment = RawAugment(isp, noise=(0.0, 0.0), draw=Draw(exposure=(low, high)))
        pair = augment(dim, draws.manual_seed(1))
        stops = (pair.clean / clean).log2().mean((1, 2, 3))
        assert low - 1e-4 <= stops.min() <= low + 0.02 and high - 0.02 <= stops.max() <= high + 1e-4
        assert stops.mean().item() == pytest.approx((low + high) / 2, abs=0.15)
        assert torch.equal(augment.apply(dim, pair.params).clean, pair.clean)


def test_wrong_settings_are_refused(isp: DictionaryISP) -> None:
    with pytest.raises(ValueError, match="order"):
        RawAugment(DictionaryISP(ISPConfig(stages=("gamma", "gains", "colour"))))
    with pytest.raises(ValueError, match="convex, independent, perturb, chosen"):
        Draw(sampling="random")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"stops"):
        Draw(exposure=(1.0, -1.0))
    for exposure in (math.nan, (0.0, math.inf), "1", (1, 2, 3)):
        with pytest.raises(ValueError, match="exposure must be"):
            Draw(exposure=exposure)  # type: ignore[arg-type]
    for noise in (5, 0.01, math.nan, True, [[1, 2], [3, 4]], [math.nan, 1]):
        with pytest.raises(ValueError, match=r"pair|finite"):
            RawAugment.from_pretrained("universal", noise=noise)  # type: ignore[arg-type]


def test_raw_is_developed_by_the_setting_that_made_it(isp: DictionaryISP) -> None:
    """As the target sRGB has it, of a batch and of one sample; and near the picture, which demosaicing alone blurs."""
    smooth = torch.nn.functional.interpolate(torch.rand(2, 3, 4, 5), (32, 40), mode="bicubic").clamp(0.1, 0.9)
    augment = RawAugment(isp, noise=(0.0, 0.0))
    developed = RawAugment(isp, noise=(0.0, 0.0), target=Srgb(demosaicing="malvar"))
    pair, draws = augment(smooth, torch.Generator().manual_seed(1)), torch.Generator().manual_seed(1)
    srgb = augment.develop(pair.clean, pair.params)
    assert torch.equal(srgb, developed(smooth, draws).clean) and srgb.shape == smooth.shape
    assert (srgb - smooth).abs().mean() < 0.02
    sample = RawPairs(list(smooth), augment, crop=16)[1]
    alone = augment.develop(sample.noisy, sample.params)
    together = augment.develop(sample.noisy[None], sample.params.map(lambda t: t[None]))
    assert alone.shape == (3, 16, 16) and torch.equal(alone, together[0])
    assert not set(augment.state_dict()), "the tables of the development are no weights"


def test_what_is_no_packed_raw_is_not_developed(augment: RawAugment, srgb: Tensor) -> None:
    pair = augment(srgb)
    with pytest.raises(ValueError, match="RGGB"):
        augment.develop(srgb / 255.0, pair.params)
    with pytest.raises(ValueError, match="batch"):
        augment.develop(pair.noisy[:2], pair.params)
    with pytest.raises(ValueError, match="of XTRANS"):
        RawAugment(augment.isp, cfa="XTRANS").develop(pair.noisy, pair.params)


def test_printed_it_says_what_is_drawn(isp: DictionaryISP) -> None:
    assert repr(RawAugment(isp, noise="upi", burst=3)).splitlines() == [
        "RawAugment, camera: the fitted one, convex, exposure 0 to 0 stops",
        "  noise: upi",
        "  target: raw, RGGB, bursts of 3 frames",
    ]
    any_of_them = RawAugment.from_pretrained(
        "universal", noise=("upi", "rawir"), draw=Draw(light=5500.0), target="srgb"
    )
    assert re.fullmatch(
        r"RawAugment, camera: mixtures of 630 published, convex, light 5500.0, exposure -0.5 to 1 stops\n"
        r"  noise: \('upi', 'rawir'\)\n  target: srgb, RGGB",
        repr(any_of_them),
    )


def test_the_iso_is_that_of_the_camera_s_noise(srgb: Tensor) -> None:
    drawn = {}
    for iso in (800, 3200):
        augment = RawAugment.from_pretrained("universal", camera="Sony ILCE-7M3", iso=iso)
        drawn[iso] = augment(srgb).params.noise["shot_var"]
        assert drawn[iso].unique().numel() == 1 and f"ILCE-7M3 iso={iso}" in repr(augment)
    assert 3 < drawn[3200][0] / drawn[800][0] < 5
    other = RawAugment.from_pretrained("universal", camera="Sony ILCE-7M3", noise="Nikon D750", iso=(100, 200))
    assert "noise: Nikon D750 iso=(100, 200)" in repr(other)
    for settings, message in (
        ({"iso": 800}, "does not depend on ISO; omit iso, or use one of"),
        ({"camera": "Sony ILCE-7M3", "iso": 10**7}, "outside the measured range of Sony ILCE-7M3"),
        ({"noise": "upi", "iso": 800}, "does not depend on ISO"),
    ):
        with pytest.raises(ValueError, match=message):
            RawAugment.from_pretrained("universal", **settings)


def test_parameters_of_another_batch_are_refused(augment: RawAugment, srgb: Tensor) -> None:
    with pytest.raises(ValueError, match="batch"):
        augment.apply(srgb[:2], augment.sample(srgb))


def test_fields_pass_and_keys_name_the_pictures(augment: RawAugment, srgb: Tensor) -> None:
    pair, labels = augment([srgb, torch.arange(3)])
    assert isinstance(pair, RawPair) and labels.tolist() == [0, 1, 2]
    batch = augment({"image": srgb, "id": ["a", "b", "c"]}, key="image")
    assert isinstance(batch["image"], RawPair) and batch["id"] == ["a", "b", "c"]
    for key in (1, -1):
        labels, pair = augment((["a", "b"], srgb), key=key)
        assert labels == ["a", "b"] and pair.noisy.shape == (3, 4, 8, 10)


def test_a_single_picture_makes_a_single_pair_that_replays(augment: RawAugment) -> None:
    picture = Image.fromarray(np.random.default_rng(0).integers(256, size=(17, 21, 3), dtype=np.uint8))
    pair = augment(picture)
    assert pair.noisy.shape == (4, 8, 10) and pair.params.crop.tolist() == [0, 0, 16, 20, 0]
    assert_same(augment.apply(picture, pair.params), pair)
    assert augment.sample(picture).crop.shape == (5,)


def test_raw_stays_float32_in_mixed_precision(isp: DictionaryISP, srgb: Tensor) -> None:
    augment, generator = RawAugment(isp, draw=Draw(sampling="perturb")), torch.Generator()
    expected = augment(srgb, generator.manual_seed(0))
    with torch.autocast("cpu", dtype=torch.bfloat16):
        assert_same(augment(srgb, generator.manual_seed(0)), expected)


class Transformed(Dataset[Tensor]):
    """One picture over and over, augmented in the worker by the module's own generator."""

    def __init__(self, augment: RawAugment) -> None:
        self.augment = augment

    def __len__(self) -> int:
        return 8

    def __getitem__(self, index: int) -> Tensor:
        pair: RawPair = self.augment(torch.full((3, 4, 4), 0.5))
        return pair.noisy


def test_workers_do_not_repeat_each_other_nor_the_last_epoch(augment: RawAugment) -> None:
    loader = DataLoader(Transformed(augment), num_workers=2, generator=torch.Generator().manual_seed(0))
    drawn = [noisy.flatten().tolist() for _ in range(2) for noisy in loader]
    assert len({tuple(values) for values in drawn}) == 16


@pytest.mark.parametrize("place", ["before", "inside"])
def test_kornia_before_it_and_around_it(augment: RawAugment, srgb: Tensor, place: str) -> None:
    from kornia.augmentation import AugmentationSequential, RandomHorizontalFlip

    flip = RandomHorizontalFlip(p=1.0)
    before = nn.Sequential(AugmentationSequential(flip, data_keys=["input"]), augment)
    pipeline = before if place == "before" else AugmentationSequential(flip, augment, data_keys=["input"])
    pair = pipeline(srgb / 255.0)
    assert isinstance(pair, RawPair)
    assert_same(augment.apply((srgb / 255.0).flip(-1), pair.params), pair)


def test_camera_noise_is_that_of_the_file(isp: DictionaryISP) -> None:
    with pytest.raises(ValueError, match="noise"):
        RawAugment(isp, noise="camera")
    measured = DictionaryISP()
    levels = [{"shot_var": 2e-3, "read_var": 3e-5, "r2": 0.99}]
    measured.info["noise"] = {"name": "MeasuredNoise", "settings": {"levels": levels}}
    params = RawAugment(measured, noise="camera")(torch.rand(2, 3, 8, 8)).params
    torch.testing.assert_close(params.noise["shot_var"], torch.full((2,), 2e-3))
    torch.testing.assert_close(params.noise["read_var"], torch.full((2,), 3e-5))


def test_a_network_in_bfloat16_leaves_it_in_float32(isp: DictionaryISP, srgb: Tensor) -> None:
    augment = RawAugment(copy.deepcopy(isp), seed=3)
    whole = torch.nn.Sequential(augment, torch.nn.Conv2d(4, 4, 1)).to(torch.bfloat16)
    assert whole[1].weight.dtype == torch.bfloat16
    expected = RawAugment(isp, seed=3)(srgb)
    assert torch.equal(augment(srgb).noisy, expected.noisy)


def test_the_caller_s_isp_stays_as_it_is() -> None:
    isp = DictionaryISP(ISPConfig(colour_atoms=3, gain_atoms=3)).train()
    augment = RawAugment(isp)
    assert isp.training and all(p.requires_grad for p in isp.parameters())
    assert not augment.isp.training and not any(t.requires_grad for t in [*augment.parameters(), *augment.buffers()])
    srgb = torch.full((1, 3, 8, 8), 0.5)
    before = augment(srgb, torch.Generator().manual_seed(0)).clean
    with torch.no_grad():
        isp.colour.matrices.mul_(torch.tensor([1.0, 2.0, 3.0]))
    assert torch.equal(augment(srgb, torch.Generator().manual_seed(0)).clean, before)


def test_an_augmentation_adds_nothing_to_the_state_of_a_network(augment: RawAugment) -> None:
    network = nn.ModuleDict({"augment": augment, "layer": nn.Linear(2, 2)})
    own = {"layer.weight", "layer.bias"}
    assert set(network.state_dict()) == own == {name for name, _ in network.named_parameters()}
    network.load_state_dict({f"layer.{key}": value for key, value in nn.Linear(2, 2).state_dict().items()}, strict=True)


def test_it_follows_the_network_to_a_device(isp: DictionaryISP) -> None:
    augment, seen = RawAugment(isp), list[nn.Module]()
    network = nn.Sequential(augment).to("meta")
    assert augment.device.type == "meta" and {t.device.type for t in augment.buffers()} == {"meta"}
    network.apply(seen.append)  # Module.apply, which an augmentation's own apply must not hide
    assert augment in seen and augment.isp in seen


@pytest.fixture(scope="module")
def pairs(augment: RawAugment) -> RawPairs:
    generator = torch.Generator().manual_seed(0)
    pictures = [torch.randint(256, (3, 20 + 2 * i, 26), generator=generator, dtype=torch.uint8) for i in range(4)]
    return RawPairs(pictures, augment, crop=16, seed=3)


def test_saved_with_a_batch_they_replay_every_pair(pairs: RawPairs, tmp_path: Path) -> None:
    batch = default_collate([pairs[i] for i in range(4)])
    save_params(batch.params, tmp_path / "deep" / "batch.safetensors")
    loaded = load_params(tmp_path / "deep" / "batch.safetensors")
    assert loaded.tensors().keys() == batch.params.tensors().keys()
    elsewhere = RawPairs(pairs.dataset, pairs.augment, crop=16, seed=99)
    for i in range(4):
        params = loaded.map(lambda t, i=i: t[i])  # type: ignore[misc]
        again = elsewhere.replay(i, params)
        for name in ("noisy", "clean", "variance"):
            assert torch.equal(getattr(again, name), getattr(batch, name)[i])


def test_replay_refuses_another_picture(pairs: RawPairs) -> None:
    with pytest.raises(ValueError, match="22 x 26"):
        pairs.replay(3, pairs[1].params)


def test_other_files_are_refused(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"none\.safetensors"):
        load_params(tmp_path / "none.safetensors")
    save_file({"a": torch.zeros(1)}, tmp_path / "other.safetensors")
    with pytest.raises(ValueError, match=r"other.*parameters"):
        load_params(tmp_path / "other.safetensors")
    save_file({"crop": torch.zeros(5)}, tmp_path / "part.safetensors", {"kind": "augment_params"})
    with pytest.raises(ValueError, match=r"part\.safetensors: .* missing"):
        load_params(tmp_path / "part.safetensors")
    (tmp_path / "text.safetensors").write_text("not this")
    with pytest.raises(ValueError, match=r"text.*not a readable"):
        load_params(tmp_path / "text.safetensors")
    with pytest.raises(ValueError, match="crop missing"):
        AugmentParams.from_tensors({f"isp.{name}": torch.zeros(1) for name in ISPParams._fields})


def test_noise_is_calibrated_to_the_pictures_and_the_isp_at_hand(augment: RawAugment) -> None:
    pictures = [torch.full((3, 64, 64), level) for level in (0.2, 0.5, 0.8)]
    law = (1e-3, 1e-6)
    noise = CalibratedNoise(38.0, augment.measure_signals(pictures, draws=16), law)
    calibrated = augment.with_draws(noise)
    found = []
    for picture in pictures:
        pair = calibrated(picture.expand(32, -1, -1, -1), torch.Generator().manual_seed(1))
        found.append(-10.0 * (pair.noisy - pair.clean).square().mean((1, 2, 3)).log10())
    assert float(torch.cat(found).mean()) == pytest.approx(38.0, abs=0.4)
