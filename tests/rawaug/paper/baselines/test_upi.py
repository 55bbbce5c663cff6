"""UPI against numbers worked out by hand, its distributions, and replay."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from rawaug.bayer import CFA
from rawaug.paper.baselines.upi import UPI, UPIParams, camera_matrix, inverse_smoothstep, render_pixels, smoothstep
from rawaug.paper.baselines.upi import unprocess_pixels as unprocess


def flat(red: float, green: float, blue: float) -> torch.Tensor:
    return torch.tensor([red, green, blue])[None, :, None, None].expand(1, 3, 8, 8)


def test_tone_curve_by_hand() -> None:
    x = torch.tensor([0.0, 0.25, 0.5, 0.75, 1.0])
    y = torch.tensor([0.0, 0.15625, 0.5, 0.84375, 1.0])  # 3x^2 - 2x^3
    torch.testing.assert_close(smoothstep(x), y)
    torch.testing.assert_close(inverse_smoothstep(y), x)


@given(st.floats(0.0, 1.0))
def test_the_inverse_undoes_the_tone_curve(value: float) -> None:
    x = torch.tensor(value, dtype=torch.float64)
    assert smoothstep(inverse_smoothstep(x)).item() == pytest.approx(value, abs=1e-9)


def test_the_matrix_of_the_first_camera_by_hand() -> None:
    matrix = camera_matrix(torch.tensor([[1.0, 0.0, 0.0, 0.0]]))[0]
    torch.testing.assert_close(matrix[0], torch.tensor([0.82638, 0.29506, -0.12144]), atol=1e-4, rtol=0)


@given(st.lists(st.floats(0.01, 1.0), min_size=4, max_size=4))
def test_white_stays_white_in_every_mixture(weights: list[float]) -> None:
    torch.testing.assert_close(camera_matrix(torch.tensor([weights])).sum(2), torch.ones(1, 3))


def test_mid_grey_by_hand_with_the_mean_camera() -> None:
    raw = UPI("GRBG").reverse(flat(0.5, 0.5, 0.5))  # 0.5^2.2 = 0.21764; gains 1.25 x (2.15, 1, 1.7)
    cell = torch.tensor([[0.17411, 0.08098], [0.10242, 0.17411]])
    torch.testing.assert_close(raw[0, 0, :2, :2], cell, atol=1e-4, rtol=0)


def test_white_is_spared() -> None:
    torch.testing.assert_close(UPI().reverse(flat(1.0, 1.0, 1.0)), torch.ones(1, 1, 8, 8))


def test_the_distributions_are_the_published_ones() -> None:
    matrix, gains = UPI().sample(20000, torch.Generator().manual_seed(0))
    red, blue = gains[:, 0] / gains[:, 1], gains[:, 2] / gains[:, 1]
    assert red.min() > 1.899 and red.max() < 2.401 and blue.min() > 1.499 and blue.max() < 1.901
    assert red.mean().item() == pytest.approx(2.15, abs=0.01) and blue.mean().item() == pytest.approx(1.7, abs=0.01)
    inverse = 1.0 / gains[:, 1]
    assert inverse.mean().item() == pytest.approx(0.8, abs=0.01) and inverse.std().item() == pytest.approx(
        0.1, abs=0.01
    )
    torch.testing.assert_close(matrix.mean(0), UPI().default_params(1).matrix[0], atol=0.01, rtol=0)


@pytest.mark.parametrize("cfa", list(CFA))
def test_parameters_replay_and_pictures_do_not_mix(cfa: CFA) -> None:
    upi, srgb = UPI(cfa), torch.rand(3, 3, 6, 10, generator=torch.Generator().manual_seed(1))
    params = upi.sample(3, torch.Generator().manual_seed(2))
    again = upi.sample(3, torch.Generator().manual_seed(2))
    raw = upi.apply(srgb, params)
    assert torch.equal(raw, upi.apply(srgb, again))
    alone = UPIParams(*(value[1:2] for value in params))
    torch.testing.assert_close(upi.apply(srgb[1:2], alone), raw[1:2], atol=1e-6, rtol=0)
    assert not torch.equal(raw, upi.reverse(srgb))


def test_uint8_and_float_agree() -> None:
    srgb = torch.randint(256, (1, 3, 6, 6), dtype=torch.uint8, generator=torch.Generator().manual_seed(0))
    assert torch.equal(UPI().reverse(srgb), UPI().reverse(srgb / 255.0))


def test_rendering_is_the_exact_inverse_below_the_highlights() -> None:
    generator = torch.Generator().manual_seed(3)
    srgb = 0.15 + 0.7 * torch.rand(4, 3, 16, 16, generator=generator)
    params = UPI().sample(4, generator)
    linear = unprocess(srgb, params)
    inside = (linear > 0.0).all(1, keepdim=True).expand_as(srgb)  # a saturated colour may lie outside the camera's
    assert inside.float().mean() > 0.7
    torch.testing.assert_close(render_pixels(linear, params)[inside], srgb[inside], atol=1e-4, rtol=0)


def test_flat_pictures_survive_the_cycle_through_the_mosaic() -> None:
    srgb = flat(0.6, 0.5, 0.4)
    torch.testing.assert_close(UPI("BGGR").cycle(srgb), srgb, atol=1e-4, rtol=0)
