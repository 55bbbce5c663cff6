"""Every term of the losses, against its formula; each coefficient stands in the modules' heads."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, cast

import pytest
import torch
from torch import Tensor

from rawaug.data.pairs import Pair
from rawaug.isp.config import ISPConfig
from rawaug.isp.fit import FitConfig, encoders
from rawaug.isp.fit.descent import apart, cycle_error, mean_square, reading_error
from rawaug.isp.fit.samples import FrameSummary, PixelSamples, sample_pixels
from rawaug.isp.model import DictionaryISP

PIXELS = torch.arange(64)
CLEAN, NOISY = FitConfig(), FitConfig(noisy=True)


@pytest.fixture(scope="module")
def frame(exact_pair: Callable[..., Pair]) -> tuple[PixelSamples, list[FrameSummary]]:
    return sample_pixels([exact_pair("shot", (1.6, 1.0, 1.7), 0, size=(32, 40))], 64, 0)


@pytest.fixture
def isp() -> DictionaryISP:
    """Two atoms of each kind, between which the two directions choose differently."""
    model = DictionaryISP(ISPConfig(colour_atoms=2, gain_atoms=2, encoders=False, attention=False))
    with torch.no_grad():
        model.colour.matrices.add_(0.1 * torch.rand(2, 3, 3, generator=torch.Generator().manual_seed(0)))
        model.reverse_encoders.colour.set_prior(torch.tensor([0.7, 0.3]))
        model.forward_encoders.colour.set_prior(torch.tensor([0.4, 0.6]))
        model.reverse_encoders.gain.set_prior(torch.tensor([0.9, 0.1]))
        model.forward_encoders.gain.set_prior(torch.tensor([0.5, 0.5]))
    return model


APART = 2 * 0.3**2 + 2 * 0.4**2
"""|w_r - w_f|^2 of these priors."""


def both_passes(isp: DictionaryISP, part: PixelSamples) -> tuple[dict[str, Tensor], dict[str, Tensor], Tensor]:
    """Intermediate images of the two passes under the reverse weights, and the sRGB of the forward one."""
    params = isp.choose(part.srgb)
    back: dict[str, Tensor] = {}
    back["raw"] = isp.reverse_pixels(part.cell_srgb, params, part.place, back)
    ahead: dict[str, Tensor] = {}
    srgb = isp.forward_pixels(part.cell_raw, params, part.place, ahead)
    return back, ahead, srgb


def test_the_cycle_is_l2_on_srgb_and_a_tenth_on_every_image_between(
    isp: DictionaryISP, frame: tuple[PixelSamples, list[FrameSummary]]
) -> None:
    part, _ = frame
    back, ahead, srgb = both_passes(isp, part)
    assert set(ahead) == {"x1", "x2", "x3", "x4"} <= set(back)
    weight = part.cell_weight / (3.0 * part.cell_weight.sum())
    expected = ((srgb - part.cell_srgb) ** 2 * weight).sum()
    for name in ahead:
        expected = expected + 0.1 * ((ahead[name] - back[name]) ** 2 * weight).sum()
    error = cycle_error(isp, part, isp.choose(part.srgb), back, CLEAN)
    assert error.item() == pytest.approx(expected.item(), rel=1e-5)
    for name in ahead:
        shifted = {**back, name: ahead[name] + 0.5}
        without = {**back, name: ahead[name]}
        rise = cycle_error(isp, part, isp.choose(part.srgb), shifted, CLEAN) - cycle_error(
            isp, part, isp.choose(part.srgb), without, CLEAN
        )
        assert rise.item() == pytest.approx(0.1 * 0.5**2, rel=1e-4), name


def test_from_noisy_readings_the_way_back_starts_where_the_reverse_pass_ended(
    isp: DictionaryISP, frame: tuple[PixelSamples, list[FrameSummary]]
) -> None:
    part, _ = frame
    back, _, _ = both_passes(isp, part)
    params = isp.choose(part.srgb)
    other = part._replace(cell_raw=part.cell_raw + 0.3)
    assert torch.equal(cycle_error(isp, part, params, back, NOISY), cycle_error(isp, other, params, back, NOISY))
    assert not torch.equal(cycle_error(isp, part, params, back, CLEAN), cycle_error(isp, other, params, back, CLEAN))


def test_weights_apart_add_up_over_both_dictionaries(isp: DictionaryISP) -> None:
    srgb = torch.rand(1, 3, 8, 8)
    ours, theirs = isp.choose(srgb), isp.choose_forward(srgb)
    assert apart(ours, theirs).item() == pytest.approx(APART, rel=1e-4) and apart(ours, ours).item() == 0.0


def test_the_loss_of_the_encoders_has_both_directions_and_their_consistency(
    isp: DictionaryISP, frame: tuple[PixelSamples, list[FrameSummary]]
) -> None:
    part, shots = frame
    ours, theirs = isp.choose(shots[0].srgb), isp.choose_forward(shots[0].raw)
    first, second = ((mean_square(isp, part, params) + 1e-5).log().sum().item() for params in (ours, theirs))
    loss = encoders._frame_loss(isp, part, shots, 0, PIXELS, FitConfig(), torch.Generator().manual_seed(0))
    assert abs(first - second) > 1e-3
    assert loss.item() == pytest.approx(first + second + 1.0 * APART, rel=1e-5)


def test_the_joint_loss_has_raw_the_cycle_by_the_forward_weights_and_their_consistency(
    isp: DictionaryISP, frame: tuple[PixelSamples, list[FrameSummary]]
) -> None:
    part, shots = frame
    ours, theirs = isp.choose(shots[0].srgb), isp.choose_forward(shots[0].raw)
    back: dict[str, Tensor] = {}
    back["raw"] = isp.reverse_pixels(part.cell_srgb, ours, part.place, back)
    cycle = cycle_error(isp, part, theirs, back, CLEAN).item()
    assert abs(cycle - cycle_error(isp, part, ours, back, CLEAN).item()) > 1e-6
    loss = encoders._joint_frame_loss(isp, part, shots, 0, PIXELS, CLEAN)
    expected = mean_square(isp, part, ours)[0].item() + cycle + 0.01 * APART
    assert loss.item() == pytest.approx(expected, rel=1e-5)
    loss.backward()
    for direction in ("reverse", "forward"):
        gradients = [p.grad for name, p in isp.named_parameters() if f"{direction}_network" in name]
        assert gradients and any(g is not None and g.abs().max() > 0 for g in gradients), direction


@pytest.mark.parametrize("stage", ["encoders", "joint"])
def test_a_fit_shows_the_forward_encoders_what_the_forward_pass_does(
    stage: str, exact_pair: Callable[..., Pair]
) -> None:
    """Of a flat frame under strong shading: the same light everywhere."""
    isp = DictionaryISP(ISPConfig(colour_atoms=2, gain_atoms=2, attention=False))
    with torch.no_grad():
        cast(Any, isp.stages["shading"]).mask.set(torch.zeros(2), 3.0 * torch.eye(2))
    flat = isp.reverse(torch.full((1, 3, 32, 40), 0.5)).raw[0]
    part, shots = sample_pixels([replace(exact_pair("shot", (1.6, 1.0, 1.7), 0, size=(32, 40)), raw=flat)], 64, 0)
    seen: list[Tensor] = []
    isp.forward_encoders.colour.register_forward_pre_hook(lambda _, given: seen.append(given[0]))
    if stage == "encoders":
        encoders._frame_loss(isp, part, shots, 0, PIXELS, CLEAN, torch.Generator().manual_seed(0))
    else:
        encoders._joint_frame_loss(isp, part, shots, 0, PIXELS, CLEAN)
    shaded = shots[0].raw.std((2, 3)) / shots[0].raw.mean((2, 3))
    corrected = seen[0].std((3, 4)) / seen[0].mean((3, 4)).abs()
    assert corrected.max() < 0.2 * shaded.max()  # borders of the demosaicing remain


def test_readings_weigh_as_shot_noise_has_it(frame: tuple[PixelSamples, list[FrameSummary]]) -> None:
    part, _ = frame
    known = part.known.bool()
    predicted = torch.where(known, part.target + 0.01, part.target)
    expected = (0.01**2 / (4.0 * (predicted[known] + 0.01))).mean()
    assert reading_error(predicted, part).item() == pytest.approx(expected.item(), rel=1e-5)
