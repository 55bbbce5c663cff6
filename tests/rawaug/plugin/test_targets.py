"""Targets beside RAW: linear camera RGB, and sRGB developed by the setting that made the RAW."""

from __future__ import annotations

from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from torch import Tensor
from torch.utils.data import DataLoader

from rawaug import (
    AugmentParams,
    DictionaryISP,
    Draw,
    ISPModel,
    RawAugment,
    RawPair,
    RawPairs,
    Srgb,
    load_params,
    save_params,
    wrap,
)
from rawaug.bayer import METHODS, pack_rgb
from rawaug.isp.config import ISPConfig
from rawaug.metrics import psnr


def smooth(batch: int = 2, height: int = 48, width: int = 64) -> Tensor:
    """Pictures without detail, which demosaicing leaves as they are."""
    coarse = torch.rand(batch, 3, 3, 4, generator=torch.Generator().manual_seed(0))
    return F.interpolate(coarse, size=(height, width), mode="bicubic").clamp(0.02, 0.9)


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def test_linear_rgb_is_what_the_mosaic_was_taken_from(universal: DictionaryISP) -> None:
    srgb = smooth()
    raw = RawAugment(universal)(srgb, seeded())
    pair = RawAugment(universal, target="rgb")(srgb, seeded())
    assert pair.clean.shape == (2, 3, 48, 64)
    assert torch.equal(pack_rgb(pair.clean, universal.cfa), raw.clean)
    assert torch.equal(pair.noisy, raw.noisy) and torch.equal(pair.variance, raw.variance)
    xtrans = RawAugment(universal, target="rgb", cfa="XTRANS")(srgb, seeded())
    assert xtrans.noisy.shape == (2, 1, 48, 64) and torch.equal(xtrans.clean, pair.clean)


@pytest.mark.parametrize("demosaicing", METHODS)
@pytest.mark.parametrize("isp", ["universal", "canon-powershot"])
def test_without_noise_the_setting_develops_to_the_picture(isp: str, demosaicing: str) -> None:
    srgb = smooth(1, 192, 256)
    augment = RawAugment.from_pretrained(
        isp, (0.0, 0.0), draw=Draw(sampling="chosen", exposure=0), target=Srgb(demosaicing=demosaicing)
    )
    pair = augment(srgb, seeded())
    assert pair.variance.shape == (1, 0) and torch.equal(pair.noisy, pair.clean)
    assert psnr(pair.clean, srgb).min() > (45 if isp == "universal" else 25)  # a fitted camera inverts its own JPEGs


def test_noise_of_a_plain_camera_is_the_raw_law() -> None:
    """Unit gains, identity matrix, no tone curve; at a site of its own colour demosaicing changes nothing."""
    isp = DictionaryISP(ISPConfig(stages=("curve", "colour", "gains"), tone_atoms=1, colour_atoms=1, gain_atoms=1))
    assert isp.tone is not None
    isp.tone.curves.copy_(torch.linspace(0.0, 1.0, isp.tone.curves.shape[1]))
    augment, grey = (
        RawAugment(isp, noise=(1e-3, 1e-5), target="srgb", draw=Draw(exposure=0)),
        torch.full((1, 3, 512, 512), 0.3),
    )
    params = augment.sample(grey, seeded())
    plain = params.isp._replace(matrix=torch.eye(3)[None], gains=torch.ones(1, 3))
    pair = augment.apply(grey, params._replace(isp=plain))
    assert pair.clean.mean().item() == pytest.approx(0.3, abs=1e-3)
    own = pack_rgb(pair.noisy - pair.clean, isp.cfa)
    assert own.var().item() == pytest.approx(1e-3 * 0.3 + 1e-5, rel=0.02)
    demosaiced = (pair.noisy - pair.clean)[0]
    neighbours = (demosaiced[:, :, 1:] * demosaiced[:, :, :-1]).mean() / demosaiced.square().mean()
    assert neighbours > 0.2  # demosaicing correlates what was white in RAW


@pytest.mark.parametrize("stops", [-0.5, 0.0, 1.0])
def test_saturated_highlights_are_white_at_any_exposure(universal: DictionaryISP, stops: float) -> None:
    white = torch.ones(4, 3, 16, 16)
    pair = RawAugment(universal, noise=(1e-6, 1e-8), target="srgb", draw=Draw(exposure=stops))(white, seeded())
    assert pair.clean.min() > 0.98


def test_a_replay_is_exact_and_goes_through_a_file(universal: DictionaryISP, tmp_path: Path) -> None:
    augment = RawAugment(universal, target=Srgb(jpeg=(40, 95)))
    srgb = (smooth() * 255).to(torch.uint8)
    pair = augment(srgb, seeded(3))
    assert pair.noisy.shape == pair.clean.shape == (2, 3, 48, 64)
    assert pair.noisy.min() >= 0 and pair.noisy.max() <= 1
    assert torch.allclose(pair.noisy * 255, (pair.noisy * 255).round(), atol=1e-4)
    save_params(pair.params, tmp_path / "a.safetensors")
    params = load_params(tmp_path / "a.safetensors")
    assert set(params.extras) == {"demosaicing", "quality"}
    again = augment.apply(srgb, params)
    assert torch.equal(again.noisy, pair.noisy) and torch.equal(again.clean, pair.clean)
    one = augment.apply(srgb[1], params.map(lambda t: t[1]))
    assert torch.equal(one.noisy, pair.noisy[1]) and one.variance.shape == (0,)


def test_every_demosaicing_and_quality_is_drawn_and_a_low_quality_costs_more(universal: DictionaryISP) -> None:
    srgb = smooth(64)
    drawn = RawAugment(universal, target=Srgb(jpeg=(10, 12))).sample(srgb, seeded()).extras
    assert set(drawn["demosaicing"].tolist()) == {0, 1, 2, 3} and set(drawn["quality"].tolist()) == {10, 11, 12}
    without, high, low = (
        RawAugment(universal, (1e-4, 0.0), target=Srgb(demosaicing="malvar", jpeg=jpeg))(srgb[:2], seeded())
        for jpeg in (None, (95, 95), (10, 10))
    )
    assert psnr(high.noisy, without.noisy).min() > psnr(low.noisy, without.noisy).max()


def test_the_target_of_a_jpeg_is_the_picture_before_it_was_compressed(universal: DictionaryISP) -> None:
    srgb = smooth()
    targets = (Srgb(demosaicing="malvar", jpeg=jpeg) for jpeg in (None, (10, 10)))
    without, low = (RawAugment(universal, (1e-3, 1e-5), target=target)(srgb, seeded()) for target in targets)
    assert torch.equal(low.clean, without.clean) and not torch.equal(low.noisy, without.noisy)


def test_datasets_and_loaders_collate_them(universal: DictionaryISP) -> None:
    augment = RawAugment(universal, target=Srgb(jpeg=(80, 90)))
    pictures = list((smooth(4) * 255).to(torch.uint8))
    pairs = RawPairs(pictures, augment, crop=32).freeze()
    batch: RawPair = next(iter(DataLoader(pairs, batch_size=4)))
    assert batch.noisy.shape == batch.clean.shape == (4, 3, 32, 32) and batch.variance.shape == (4, 0)
    assert isinstance(batch.params, AugmentParams) and batch.params.extras["quality"].shape == (4,)
    assert torch.equal(pairs.replay(2, pairs[2].params).noisy, batch.noisy[2])
    (wrapped,) = wrap(DataLoader(pictures, batch_size=4), RawAugment(universal, target="rgb"))  # type: ignore[arg-type]
    assert wrapped.noisy.shape == (4, 4, 24, 32) and wrapped.clean.shape == (4, 3, 48, 64)


def degradation(img: np.ndarray, hq: np.ndarray, isp_model: Any) -> tuple[np.ndarray, np.ndarray]:
    """The call of KAIR's ``utils_blindsr.degradation_bsrgan``."""
    with torch.no_grad():
        img, hq = isp_model.forward(img.copy(), hq)
    return img, hq


def test_kair_s_call_gets_camera_noise_on_the_picture_and_its_target_back(universal: DictionaryISP) -> None:
    augment = RawAugment(universal, noise=(1e-3, 1e-5), target=Srgb(jpeg=(60, 90)))
    srgb = smooth(1, 48, 64)[0].permute(1, 2, 0).numpy().astype(np.float64)[:47, :63]
    hq = np.zeros((94, 126, 3))
    first, same = degradation(srgb, hq, ISPModel(augment))
    second, _ = degradation(srgb, hq, ISPModel(augment))
    assert first.shape == srgb.shape and first.dtype == np.float32 and same is hq
    assert first.min() >= 0 and first.max() <= 1
    assert not np.array_equal(first, second)
    assert 20 < -10 * np.log10(np.mean((first - srgb) ** 2)) < 45
    with pytest.raises(ValueError, match="'srgb'"):
        ISPModel(RawAugment(universal))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda isp: RawAugment(isp, target=cast(Any, "jpg")), r"'jpg'.*raw, rgb, srgb"),
        (lambda isp: RawAugment(isp, target="srgb", cfa="XTRANS"), "XTRANS"),
        (lambda _: Srgb(jpeg=(0, 95)), "within 1 to 100"),
        (lambda _: Srgb(jpeg=(95, 40)), "within 1 to 100"),
        (lambda _: Srgb(demosaicing="lmmse"), r"'lmmse'.*malvar"),
    ],
)
def test_settings_without_meaning_are_refused(universal: DictionaryISP, make: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make(universal)
