"""The softness of a camera: a point of light has the stated spread, on every pass and for every target."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from rawaug import bayer
from rawaug.camera.own import Camera
from rawaug.camera.softness import PUBLISHED, measure_blur
from rawaug.data import demo_pictures
from rawaug.io import decode_srgb
from rawaug.isp.config import ISPConfig
from rawaug.isp.model import DictionaryISP
from rawaug.kernels import runtime
from rawaug.kernels.reference import blur, blur_taps
from rawaug.plugin.augment import RawAugment
from rawaug.plugin.draw import Draw
from rawaug.plugin.params import AugmentParams
from rawaug.plugin.targets import Burst, Srgb
from rawaug.training.camera_fit import fit

SIGMAS = torch.tensor([0.0, 0.3, 0.6, 1.0])
POINTS = ((20, 40), (21, 511), (20, 512), (23, 33))
"""Pixels of each phase of a cell; 512 begins a tile of the loops."""


@pytest.fixture(params=["compiled", "pytorch"])
def either_way(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(runtime, "has_numba", lambda: request.param == "compiled")


def points(dtype: torch.dtype) -> Tensor:
    """Four pictures of a grey point on black."""
    srgb = torch.zeros(len(POINTS), 3, 44, 600, dtype=torch.uint8)
    for picture, (i, j) in zip(srgb, POINTS, strict=True):
        picture[:, i, j] = 128
    return srgb if dtype == torch.uint8 else srgb / 255.0


def with_blur(augment: RawAugment, srgb: Tensor, blur: Tensor) -> AugmentParams:
    params = augment.sample(srgb, torch.Generator().manual_seed(0))
    return params._replace(extras={**params.extras, "blur": blur})


def spread(image: Tensor) -> Tensor:
    """The variances of light ``(B, H, W)`` about its mean, down the columns and along the rows."""
    variances = []
    for axis in (1, 2):
        profile = image.double().sum(3 - axis)
        profile = profile / profile.sum(1, keepdim=True)
        place = torch.arange(profile.shape[1]).double()
        mean = (profile * place).sum(1, keepdim=True)
        variances.append((profile * (place - mean) ** 2).sum(1))
    return torch.stack(variances)


@pytest.mark.usefixtures("either_way")
@pytest.mark.parametrize("dtype", [torch.uint8, torch.float32])
@pytest.mark.parametrize("through", ["curves", "a table"])
def test_a_point_has_the_stated_spread(through: str, dtype: torch.dtype) -> None:
    isp = DictionaryISP(ISPConfig(stages=("tone", "gamma", "colour", "gains"), attention=False))
    if through == "curves":
        isp = DictionaryISP.from_pretrained("universal")
    augment = RawAugment(isp, draw=Draw(exposure=0.0), target="rgb")
    srgb = points(dtype)
    sharp = augment.apply(srgb, augment.sample(srgb, torch.Generator().manual_seed(0))).clean
    black = sharp.amin(dim=(1, 2, 3), keepdim=True)

    for sigma in SIGMAS:
        light = augment.apply(srgb, with_blur(augment, srgb, sigma.expand(len(srgb)))).clean
        for colour in range(3):
            expected = sigma.double().square().expand(2, len(srgb))
            torch.testing.assert_close(spread((light - black)[:, colour]), expected, atol=1e-3, rtol=0)
        torch.testing.assert_close((light - black).sum((2, 3)), (sharp - black).sum((2, 3)), atol=1e-3, rtol=1e-3)


@pytest.mark.usefixtures("either_way")
def test_raw_of_any_pattern_samples_the_same_light() -> None:
    srgb = torch.randint(256, (4, 3, 44, 600), generator=torch.Generator().manual_seed(1), dtype=torch.uint8)
    isp = DictionaryISP.from_pretrained("universal")
    params = with_blur(RawAugment(isp), srgb, SIGMAS)
    light = RawAugment(isp, target="rgb").apply(srgb, params).clean

    packed = RawAugment(isp).apply(srgb, params).clean
    torch.testing.assert_close(packed, bayer.pack_rgb(light, "RGGB"), atol=1e-6, rtol=0)
    trans = RawAugment(isp, cfa="XTRANS").apply(srgb, params).clean
    torch.testing.assert_close(trans, bayer.pattern("XTRANS").mosaic(light), atol=1e-6, rtol=0)

    burst = RawAugment(isp, burst=Burst(2))
    moving = burst.sample(srgb).extras["motion"]
    frames = burst.apply(
        srgb, params._replace(extras={**params.extras, "motion": moving, "frame_seed": moving[..., 0]})
    )
    torch.testing.assert_close(frames.clean, packed, atol=1e-6, rtol=0)


def test_developed_pictures_are_those_of_the_blurred_raw() -> None:
    srgb = torch.randint(256, (4, 3, 44, 60), generator=torch.Generator().manual_seed(1), dtype=torch.uint8)
    isp = DictionaryISP.from_pretrained("universal")
    developed = RawAugment(isp, target=Srgb(demosaicing="malvar"), draw=Draw(exposure=0.0))
    params = with_blur(developed, srgb, SIGMAS)
    raw = RawAugment(isp).apply(srgb, params)
    assert torch.equal(developed.apply(srgb, params).clean, developed.develop(raw.clean, params))


@pytest.mark.usefixtures("either_way")
def test_no_blur_changes_no_bit_and_a_flat_picture_stays_flat() -> None:
    srgb = torch.randint(256, (2, 3, 44, 600), generator=torch.Generator().manual_seed(1), dtype=torch.uint8)
    srgb[1] = torch.tensor([10, 200, 90], dtype=torch.uint8)[:, None, None]
    augment = RawAugment.from_pretrained("universal", draw=Draw(blur=0.0))
    params = augment.sample(srgb)
    sharp = augment.apply(srgb, params).clean

    alone = params.map(lambda tensor: tensor[:1])
    none = augment.apply(srgb[:1], alone._replace(extras={"blur": torch.zeros(1)})).clean
    torch.testing.assert_close(none, sharp[:1], atol=1e-6, rtol=0)
    soft = augment.apply(srgb, params._replace(extras={"blur": torch.tensor([0.0, 1.0])})).clean
    torch.testing.assert_close(soft, sharp, atol=2e-6, rtol=0)
    assert torch.equal(soft[:1], none), "a picture does not depend on the rest of its batch"


def test_the_blur_is_drawn_last_and_replays() -> None:
    srgb = points(torch.uint8)
    seed = torch.Generator().manual_seed
    sharp = RawAugment.from_pretrained("universal", draw=Draw(blur=0.0)).sample(srgb, seed(3))
    augment = RawAugment.from_pretrained("universal", draw=Draw(blur=(0.2, 0.8)))
    pair = augment(srgb, seed(3))

    assert "blur" not in sharp.extras and pair.params._replace(extras={}).tensors().keys() == sharp.tensors().keys()
    for name, tensor in sharp.tensors().items():
        assert torch.equal(tensor, pair.params.tensors()[name])
    assert augment.settings.blur == (0.2, 0.8)

    blur = augment.sample(srgb.repeat(64, 1, 1, 1)).extras["blur"]
    assert blur.min() >= 0.2 and blur.max() <= 0.8 and blur.std() > 0.1
    again = augment.apply(srgb, AugmentParams.from_tensors(pair.params.tensors()))
    assert torch.equal(again.noisy, pair.noisy)


def test_the_taps_are_nearly_those_of_a_gaussian() -> None:
    sigma = torch.linspace(0.2, 1.0, 41)
    a, b, c = blur_taps(sigma).double().unbind(1)
    torch.testing.assert_close(2 * b + 8 * c, sigma.double() ** 2, atol=1e-6, rtol=0)
    assert min(a.min(), b.min(), c.min()) >= 0.0

    frequency = torch.linspace(0.0, 0.5, 51, dtype=torch.float64)[:, None] * 2 * torch.pi
    response = a + 2 * b * frequency.cos() + 2 * c * (2 * frequency).cos()
    gaussian = (-0.5 * (sigma.double() * frequency) ** 2).exp()
    low = frequency[:, 0] <= torch.pi / 2
    assert (response - gaussian)[low].abs().max() < 0.05


@pytest.mark.parametrize("blur", [-0.1, 1.2, (0.5, 0.2), (0.1, 0.2, 0.3), float("nan"), "soft"])
def test_a_blur_out_of_range_is_refused(blur: object) -> None:
    with pytest.raises(ValueError, match="blur"):
        Draw(blur=blur)  # type: ignore[arg-type]


SHEET: dict[str, Any] = {
    "matrix": [[1.6, -0.5, -0.1], [-0.2, 1.5, -0.3], [0.0, -0.6, 1.6]],
    "matrix_is": "camera_to_srgb",
    "white_balance": (2.1, 1.0, 1.7),
}


def test_the_blur_is_that_of_the_camera() -> None:
    """That of a sheet, in pixels or as MTF50; what a fit has measured; else none."""
    universal = DictionaryISP.from_pretrained("universal")
    assert RawAugment(universal).settings.blur == (0.0, 0.0)
    assert RawAugment(universal, draw=Draw(blur=PUBLISHED)).settings.blur == PUBLISHED
    assert RawAugment(Camera("M1", blur=0.6, **SHEET)).settings.blur == (0.6, 0.6)
    assert RawAugment(Camera("M1", blur=(0.4, 0.7), **SHEET)).settings.blur == (0.4, 0.7)
    assert RawAugment(Camera("M1", mtf50=0.25, **SHEET)).settings.blur == pytest.approx((0.75, 0.75), abs=1e-3)
    assert RawAugment(Camera("M1", **SHEET)).settings.blur == (0.0, 0.0)
    assert Camera.from_json(Camera("M1", blur=(0.4, 0.7), **SHEET).to_json()).blur_range == (0.4, 0.7)

    fitted = DictionaryISP()
    assert RawAugment(fitted).settings.blur == (0.0, 0.0)
    fitted.info["blur"] = 0.7
    assert RawAugment(fitted).settings.blur == (0.7, 0.7)
    assert "blur" in RawAugment(fitted).sample(points(torch.uint8)).extras


@pytest.mark.parametrize("figures", [{"blur": 1.5}, {"blur": (0.5, 0.2)}, {"mtf50": 0.1}, {"blur": 0.5, "mtf50": 0.3}])
def test_a_sheet_with_an_impossible_blur_is_refused(figures: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=r"blur|mtf50"):
        Camera("M1", **figures, **SHEET)


def test_softness_is_measured_on_edges_of_any_contrast_and_pattern() -> None:
    """Photographs blurred by more measure softer, by about as much, at any exposure; without edges there is none."""
    light = [decode_srgb(picture.float() / 255.0)[None] for picture in demo_pictures(9)[:4]]
    measured = []
    for sigma in (0.5, 0.7, 0.9):
        taps = blur_taps(torch.tensor([sigma]))
        frames = [(0.5 * blur(picture, taps)[0, 1].numpy(), "GBRG") for picture in light]
        measured.append(measure_blur(frames) or 0.0)
    assert measured == pytest.approx([0.5, 0.7, 0.9], abs=0.2) and measured == sorted(measured)
    assert measure_blur([(np.full((64, 64), 0.2, np.float32), "RGGB")]) is None


def test_a_fit_measures_the_blur_of_its_frames_and_an_augmentation_draws_it() -> None:
    isp = fit("demo:train", steps=2, curve_steps=2, pixels=512, noise="off", progress=False)
    assert 0.0 < isp.info["blur"] <= 1.0
    assert RawAugment(isp).settings.blur == (isp.info["blur"], isp.info["blur"])
