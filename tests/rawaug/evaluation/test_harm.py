"""Where denoisers harm: a light's flux by its place, and columns for base ISO and hot pixels."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from rawaug import RawDenoiser
from rawaug.data import demo_pairs
from rawaug.evaluation.harm import FRAMES, PLACES, WIDTHS, draw_field, draw_light, harm_tables, measure_harm


def test_a_light_has_half_its_peak_at_half_its_width() -> None:
    light = draw_light(65, 32.0, 30.0, 6.0, peak=0.8)
    assert light[32, 30] == pytest.approx(0.8) and light[32, 33] == pytest.approx(0.4)
    assert light.sum().item() == pytest.approx(0.8 * math.pi * 36 / (4 * math.log(2)), rel=1e-3)
    assert torch.equal(draw_field(1.5, 0), draw_field(1.5, 0)) and not torch.equal(
        draw_field(1.5, 0), draw_field(1.5, 1)
    )


def test_flux_is_what_a_denoiser_keeps_of_a_light() -> None:
    def halve(noisy: Tensor) -> Tensor:
        return 0.01 + 0.5 * (noisy - 0.01)

    frames = demo_pairs("test", count=1)
    denoisers = [RawDenoiser.of(halve, name="halve"), RawDenoiser.of(lambda noisy: 0.0 * noisy + 0.01, name="ground")]
    rows = measure_harm(denoisers, frames, crop=64)
    for width in WIDTHS:
        for place in PLACES:
            kept = {name: row["kept"][f"{width:g}"][place] for name, row in rows.items()}
            assert kept["noisy input"] == pytest.approx(1.0, abs=0.2)
            assert kept["halve"] == pytest.approx(0.5 * kept["noisy input"], abs=1e-4)
            assert kept["ground"] == pytest.approx(0.0, abs=1e-4)
    assert rows["noisy input"]["fields"]["1.2"] > rows["halve"]["fields"]["1.2"] > rows["ground"]["fields"]["1.2"]

    noisy = rows["noisy input"]["frames"]
    assert noisy["base ISO, full frame"]["psnr"] > 52 > 36 > noisy["hot pixels"]["psnr"]
    (_, head, cells), (_, places, shares) = harm_tables(rows)
    assert head[: len(FRAMES)] == list(FRAMES) and len(cells["halve"]) == len(head)
    assert len(shares["ground"]) == len(places) == len(WIDTHS) * len(PLACES)
