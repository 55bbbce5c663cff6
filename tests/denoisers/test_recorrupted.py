"""R2R's average at a test."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from denoisers.inference import Recorrupted

SHOT_VAR, READ_VAR, ALPHA = 2e-3, 1e-4, 0.5


def frame() -> tuple[Tensor, Tensor]:
    noisy = 0.2 + 0.3 * torch.rand(1, 4, 64, 64, generator=torch.Generator().manual_seed(0))
    return noisy, SHOT_VAR * noisy + READ_VAR


def test_the_network_meets_recorrupted_frames_with_their_noise_map() -> None:
    noisy, variance = frame()
    seen: list[tuple[Tensor, Tensor]] = []

    def network(image: Tensor, noise_map: Tensor | None = None) -> Tensor:
        assert noise_map is not None
        seen.append((image, noise_map))
        return image

    Recorrupted(network, ALPHA, draws=2)(noisy, variance)
    (whole, whole_map), (first, first_map), (second, _) = seen
    assert torch.equal(whole, noisy) and torch.equal(whole_map, variance), "the signal, where the noise is drawn"
    added = (first - noisy) / (ALPHA * variance.sqrt())
    assert float(added.mean()) == pytest.approx(0.0, abs=0.03) and float(added.std()) == pytest.approx(1.0, abs=0.03)
    torch.testing.assert_close(first_map, (1 + ALPHA**2) * (SHOT_VAR * first + READ_VAR), rtol=1e-3, atol=1e-7)
    assert not torch.equal(first, second)


def test_the_average_of_many_is_that_of_the_network_over_the_noise() -> None:
    """Of y^2 it is y^2 plus the variance of what was added, which is that at y^2: one draw is far from it, and the
    draws are a mean."""
    noisy, variance = frame()
    expected = noisy**2 + ALPHA**2 * (SHOT_VAR * noisy**2 + READ_VAR)

    def error(draws: int) -> float:
        return float((Recorrupted(lambda z, _: z**2, ALPHA, draws)(noisy, variance) - expected).square().mean())

    assert error(64) == pytest.approx(error(1) / 64, rel=0.3)


def test_in_shadows_the_extra_noise_does_not_follow_the_noise() -> None:
    """Drawn with the variance at the noisy value, bright readings would get more of it than dark ones."""
    clean, shot_var, read_var = torch.full((1, 4, 128, 128), 0.02), 8e-3, 3e-4
    deviation = (shot_var * 0.02 + read_var) ** 0.5
    noisy = clean + deviation * torch.randn(clean.shape, generator=torch.Generator().manual_seed(0))
    seen: list[Tensor] = []

    def perfect(image: Tensor, noise_map: Tensor | None) -> Tensor:
        seen.append(image)
        return clean

    Recorrupted(perfect, ALPHA, draws=4)(noisy, shot_var * noisy.clamp_min(0.0) + read_var)
    added = (torch.stack(seen[1:]) - noisy) / (ALPHA * deviation)
    for side in (noisy > clean, noisy < clean):
        assert added.square().mean(0)[side].mean().item() == pytest.approx(1.0, abs=0.03)


def test_it_is_the_same_in_every_call_and_refuses_nonsense() -> None:
    noisy, variance = frame()
    average = Recorrupted(lambda z, _: z, ALPHA, 3)
    assert torch.equal(average(noisy, variance), average(noisy, variance))
    with pytest.raises(ValueError, match=r"draws must be at least 1 and alpha positive, got 0 and 0\.5"):
        Recorrupted(lambda z, _: z, ALPHA, 0)
