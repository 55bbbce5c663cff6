"""The guard: it costs nothing where a denoiser is right, and gives back what is lost where it is not."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor
from torch.nn import functional as F

import rawaug
from denoisers.defects import mend_planes
from rawaug import RawDenoiser, bayer
from rawaug.denoising.denoiser import Noisy
from rawaug.denoising.guard import STRIP, _mend_strips, guard_result
from rawaug.io import RawFrame

LEVELS = (1e-3, 1e-6)


def noisy_of(clean: Tensor, told: float = 1.0) -> Noisy:
    deviation = (LEVELS[0] * clean + LEVELS[1]).sqrt()
    image = clean + deviation * torch.randn(clean.shape, generator=torch.Generator().manual_seed(0))
    return Noisy.of(image, (told * LEVELS[0], told * LEVELS[1]), "RGGB")


def mean(noisy: Noisy) -> Tensor:
    """The mean over 25 cells: right where the scene is flat, and blind to all detail."""
    return F.avg_pool2d(F.pad(noisy.image, (2, 2, 2, 2), mode="reflect"), 5, stride=1)


def error(image: Tensor, clean: Tensor) -> float:
    return float((image - clean).square().mean())


def flat() -> Tensor:
    return torch.linspace(0.1, 0.4, 128).expand(1, 4, 128, 128).clone()


def textured(amplitude: float) -> Tensor:
    return (flat() + amplitude * torch.randn(1, 4, 128, 128, generator=torch.Generator().manual_seed(7))).clamp_min(0.0)


@pytest.mark.parametrize("told", [0.5, 1.0, 2.0])
def test_a_denoiser_that_is_right_is_left_alone_whatever_the_levels_say(told: float) -> None:
    noisy = noisy_of(flat(), told)
    guarded, share = guard_result(mean, noisy, mean(noisy))
    assert share == pytest.approx(1.0, abs=1e-3)
    torch.testing.assert_close(guarded, mean(noisy))


@pytest.mark.parametrize("amplitude", [0.005, 0.08])
def test_the_blend_is_near_the_best_one(amplitude: float) -> None:
    clean = textured(amplitude)
    clean[..., :24] = flat()[..., :24]  # which shows that the levels are right
    noisy = noisy_of(clean)
    denoised = mean(noisy)
    guarded, _ = guard_result(mean, noisy, denoised)
    assert error(guarded, clean) < 1.15 * min(error(noisy.image, clean), error(denoised, clean))

    blends = [error(noisy.image.lerp(denoised, share), clean) for share in torch.linspace(0, 1, 21).tolist()]
    assert error(guarded, clean) < 1.25 * min(blends)


def test_a_light_is_given_back_and_a_hot_pixel_is_not() -> None:
    clean = flat()
    light = torch.zeros(256, 256)
    places = torch.arange(256.0)
    light += 0.5 * torch.exp(-((places - 100.5)[:, None].square() + (places - 60.5).square()) / (2 * 0.6**2))
    lit = clean + bayer.pack(light[None, None], "RGGB")
    noisy = noisy_of(lit)
    noisy.image[0, 1, 90, 90] = 0.9
    guarded, _ = guard_result(mean, noisy, mean(noisy))

    window = (..., slice(46, 55), slice(26, 35))
    peak = (lit - clean)[window].max()
    assert (mean(noisy) - clean)[window].max() < 0.2 * peak < 0.7 * peak < (guarded - clean)[window].max()
    assert guarded[0, 1, 90, 90] < 0.5


def test_a_denoiser_that_changes_nothing_is_left_alone() -> None:
    noisy = noisy_of(textured(0.08))
    guarded, share = guard_result(lambda part: part.image.clone(), noisy, noisy.image)
    assert share == 1.0
    torch.testing.assert_close(guarded, noisy.image)


def test_where_texture_is_removed_non_local_means_help() -> None:
    clean = flat()
    clean[..., 24::3] += 0.05  # stripes, which the filter finds again
    noisy = noisy_of(clean)
    second = RawDenoiser.of("NonLocalMeans")(noisy)
    guarded, share = guard_result(mean, noisy, mean(noisy))
    assert share < 0.5
    assert error(guarded, clean) < 1.02 * min(
        error(noisy.image, clean), error(second, clean), error(mean(noisy), clean)
    )


def test_lone_pixels_of_texture_stay_texture() -> None:
    clean = textured(0.15).clamp(max=0.9)
    signal = clean / 0.01  # hardly any noise
    assert torch.equal(mend_planes(signal), signal)


def test_a_frame_is_mended_by_strips_as_at_once() -> None:
    signal = 20.0 + torch.randn(1, 4, 2 * STRIP + 3, 24, generator=torch.Generator().manual_seed(0))
    signal[0, 2, 100, 7] += 60.0  # a defect
    signal[0, 0, STRIP - 1, 12] += 60.0  # as alone, but with texture near it, in the next strip
    texture = signal[0, :, STRIP + 24 : STRIP + 30 : 2, 4:20:4]
    texture += torch.tensor([60.0, 20.0, 0.0, 20.0])[:, None, None]
    at_once = mend_planes(signal)
    assert (at_once != signal).nonzero().tolist() == [[0, 2, 100, 7]]
    assert torch.equal(_mend_strips(signal), at_once)


def test_a_frame_is_guarded_unless_told_otherwise() -> None:
    clean = textured(0.08)
    mosaic = bayer.unpack(noisy_of(clean).image, "RGGB")[0].clamp(max=1.0)
    frame = RawFrame(mosaic, "RGGB", floating=True)
    denoiser = RawDenoiser.of(lambda noisy, variance: mean(Noisy(noisy)), name="mean")
    results = {}
    for guard in (False, True, None):
        result = rawaug.denoise(frame, denoiser=denoiser, noise=LEVELS, guard=guard)
        results[guard] = error(bayer.pack(result.mosaic[None], "RGGB"), clean)
    assert results[None] == results[True] < 0.5 * results[False]
    with pytest.raises(ValueError, match="levels"):
        guard_result(mean, Noisy(clean), clean)
