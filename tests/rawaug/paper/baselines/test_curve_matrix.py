"""The least that a reconstruction has to beat: the curve by its definition, and both matrices found again."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from rawaug.bayer import CFA
from rawaug.data.pairs import Pair
from rawaug.io import RawFrame
from rawaug.paper.baselines import Training, fit_baseline
from rawaug.paper.baselines.curve_matrix import CurveMatrix, inverse_balance, undo_bt709

MATRIX = torch.tensor([[0.7, 0.3, 0.0], [0.1, 0.8, 0.1], [0.0, 0.3, 0.7]])


def encode(linear: Tensor) -> Tensor:
    return torch.where(linear < 0.018, 4.5 * linear, 1.099 * linear.clamp_min(1e-9) ** 0.45 - 0.099)


def shot(seed: int, white_balance: tuple[float, float, float]) -> Pair:
    """A frame whose colour, balanced by its gains, is the matrix times linear light."""
    generator = torch.Generator().manual_seed(seed)
    srgb = torch.randint(0, 220, (3, 64, 64), dtype=torch.uint8, generator=generator)
    model = CurveMatrix("GBRG")
    raw = model.reverse(srgb[None], inverse_balance(white_balance)[:, None] * MATRIX)[0]
    return Pair(f"shot{seed}", RawFrame(raw, CFA.GBRG, white_balance=white_balance), srgb)


def test_the_curve_is_that_of_bt_709() -> None:
    light = torch.linspace(0, 1, 101)
    torch.testing.assert_close(undo_bt709(encode(light)), light, atol=2e-4, rtol=0)


def test_the_matrix_is_found_and_the_gains_change_it_from_shot_to_shot() -> None:
    pairs = [shot(0, (2.0, 1.0, 1.5)), shot(1, (1.5, 1.0, 2.2))]
    model = fit_baseline(CurveMatrix("GBRG"), pairs, Training())
    torch.testing.assert_close(model.balanced, MATRIX, atol=1e-3, rtol=0)

    pair = shot(2, (1.2, 1.0, 2.6))
    as_shot = model.reverse(pair.srgb[None], model.as_shot_setting(pair.clean.white_balance))
    torch.testing.assert_close(as_shot[0], pair.clean.mosaic, atol=1e-3, rtol=0)
    blind = model.reverse(pair.srgb[None])[0]
    assert (blind - pair.clean.mosaic).abs().mean() > 0.01
    with pytest.raises(ValueError, match="converts"):
        model.render(pair.clean.mosaic[None])
