"""Inverse tone curves: monotone from black to white, true to their points, exact on 8 bits."""

from __future__ import annotations

import json
from importlib import resources

import pytest
import torch

from rawaug.isp.tone import NODES, STEPS, ToneDictionary, srgb_to_linear, to_code, to_linear, tone_tables


def tables_of(*names: str) -> torch.Tensor:
    return torch.stack([tone_tables()[name] for name in names or tone_tables()])


def test_curves_rise_from_black_to_white() -> None:
    tables = tables_of()
    assert tables.shape == (27, NODES)
    assert (tables.diff(dim=1) >= 0).all()
    assert (tables[:, 0].abs() < 1e-6).all() and torch.allclose(tables[:, -1], torch.ones(len(tables)))


def test_every_inverse_passes_through_the_measured_points() -> None:
    curves = json.loads(resources.files("rawaug.isp").joinpath("facts/tone_curves.json").read_text())["curves"]
    display = srgb_to_linear(torch.linspace(0, 1, NODES, dtype=torch.float64))
    for name, points in curves.items():
        table = tone_tables()[name].double()
        for light, shown in points[1:]:
            right = int(torch.searchsorted(display, shown).clamp(1, NODES - 1))
            assert table[right - 1] - 1e-6 <= light <= table[right] + 1e-6, name


def test_cameras_lift_the_middle_where_the_linear_rendering_does_not() -> None:
    middle = tables_of()[:, 118 * STEPS]
    linear = tone_tables()["linear"][118 * STEPS]
    assert linear.item() == pytest.approx(0.1812, abs=1e-4)  # sRGB's definition at 118 / 255
    assert (torch.log2(linear / middle[2:]) > 0.25).all()


def test_curves_go_both_ways() -> None:
    tables = tables_of()
    code = torch.rand(len(tables), 3, 8, 8, generator=torch.Generator().manual_seed(0))
    there = to_linear(code, tables)
    torch.testing.assert_close(to_linear(to_code(there, tables), tables), there, atol=1e-5, rtol=0)
    assert torch.equal(to_code(torch.tensor([[[[-1.0, 2.0]]]]), tables[:1]), torch.tensor([[[[0.0, 1.0]]]]))


def test_a_mixture_of_curves_has_the_same_bits_in_any_batch_with_and_without_zeros() -> None:
    tone = ToneDictionary(5)
    tone.curves.copy_(torch.rand(5, tone.curves.shape[1], generator=torch.Generator().manual_seed(0)))
    weights = torch.tensor([[0.0, 0.3, 0.0, 0.7, 0.0], [0.1, 0.2, 0.3, 0.15, 0.25], [0.0, 0.0, 0.0, 0.0, 1.0]])
    mixed = tone.combine(weights)
    torch.testing.assert_close(mixed, weights @ tone.curves)
    assert all(torch.equal(tone.combine(row[None])[0], table) for row, table in zip(weights, mixed, strict=True))
    fitted = weights.clone().requires_grad_()
    assert torch.equal(tone.combine(fitted), mixed)
    tone.combine(fitted)[:, 500].sum().backward()
    torch.testing.assert_close(fitted.grad, tone.curves[:, 500].expand(3, 5))
