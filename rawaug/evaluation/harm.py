r"""Conditions in which denoisers harm: a camera's base ISO, small lights, and hot pixels beside them.

.. math:: \mathrm{kept} = \frac{\sum_i (f_i(y) - b)}{\sum_i (x_i - b)}, \qquad
          x_i = b + a \exp\Big(-4 \ln 2\, \frac{|i - p|^2}{w^2}\Big)

is the share of its flux that a light of width w (full width at half maximum, in pixels) keeps at the place p. A light
within a cell of 2 x 2 looks like a cell of defects, one on a site like a hot pixel, and one between four cells like
neither; so lights are measured at each of these places, in the mean over draws of the noise. A field of such lights, of
all brightnesses and places, has a PSNR. Hot pixels must still be removed: the last column has frames with some.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from statistics import fmean
from typing import Any

import torch
from torch import Tensor

from rawaug import bayer
from rawaug.bayer import CFA, noise_variance
from rawaug.data.pairs import Pair
from rawaug.denoising.denoiser import Levels, Noisy
from rawaug.evaluation.scores import NOISY, ScoredDenoiser, group_rows, score, summary
from rawaug.evaluation.trials import Trial, freeze_noise, raw_trial
from rawaug.metrics import psnr
from rawaug.noise import FixedLevels, SensorNoise
from rawaug.progress import progress
from rawaug.seeding import keyed_generator

FULL_FRAME = (1.2e-5, 3e-8)
"""(shot_var, read_var) of a full-frame camera at its base ISO, as a Sony ILCE-7M3's at ISO 100."""

FRAMES: Mapping[str, Mapping[str, Any]] = {
    "base ISO, full frame": {"levels": FixedLevels(*FULL_FRAME)},
    "hot pixels": {"levels": FixedLevels(1.8e-3, 1.2e-5), "hot": 3e-4, "dead": 1e-4},
}
"""Settings of :class:`rawaug.noise.SensorNoise` by the name of a column; hot pixels come with a phone's noise."""

WIDTHS = (1.2, 1.5, 1.9)
"""Full width at half maximum of the lights, in pixels; a lens that is as sharp as its sensor draws about 1.2."""

PLACES = {"between cells": (31.5, 31.5), "on R": (32.0, 32.0), "on Gr": (32.0, 33.0), "in a cell": (30.5, 30.5)}
"""Row and column of a light, in pixels of an RGGB mosaic of :data:`_SIDE`."""

_LEVELS: Levels = (1e-4, 1e-6)
_GROUND, _PEAK = 0.01, 0.5
_SIDE = 64
_FIELD_SIDE, _FIELD_LIGHTS = 192, 197
_AROUND = slice(12, 20)
_DRAWS = 4


def measure_harm(
    denoisers: Sequence[ScoredDenoiser], frames: Sequence[Pair], crop: int, seed: int = 0
) -> dict[str, dict[str, Any]]:
    """Measure denoisers in all conditions, levels told.

    Args:
        denoisers: see :meth:`rawaug.RawDenoiser.of`.
        frames: clean references.
        crop: side of the middles that are used, in pixels of the mosaic.
        seed: seed of the noise.

    Returns:
        By denoiser, the noisy input first: ``frames``, the scores of each column of :data:`FRAMES`; ``kept``, shares of
        flux by width and place; and ``fields``, PSNR by width.
    """
    everyone = [NOISY, *denoisers]
    rows: dict[str, dict[str, Any]] = {denoiser.name: {"frames": {}} for denoiser in everyone}

    trials = [_frame_trial(frame.middle(crop), column, seed) for column in FRAMES for frame in frames]
    for name, scores in group_rows(score(everyone, trials, "harm")).items():
        for column, of_column in group_rows(scores, "strength").items():
            rows[name]["frames"][column] = summary(of_column)

    for denoiser in progress(everyone, label="lights", unit="denoiser"):
        rows[denoiser.name]["kept"] = _measure_kept(denoiser, seed)
        rows[denoiser.name]["fields"] = _measure_fields(denoiser, seed)
    return rows


def _frame_trial(frame: Pair, column: str, seed: int) -> Trial:
    noise = SensorNoise(**FRAMES[column])
    packed = bayer.pack(frame.clean.mosaic[None], frame.cfa)
    noisy, variance, levels = freeze_noise(packed, noise, seed, "harm", column, frame.name)
    return raw_trial(frame, noisy, packed, variance, levels, CFA(frame.cfa), strength=column)


def _measure_kept(denoiser: ScoredDenoiser, seed: int) -> dict[str, dict[str, float]]:
    """Measure the share of its flux that a light keeps, by width and place."""
    kept: dict[str, dict[str, float]] = {}
    for width in WIDTHS:
        for place, (row, column) in PLACES.items():
            clean = bayer.pack(_GROUND + draw_light(_SIDE, row, column, width)[None, None], CFA.RGGB)
            flux = _sum_flux(clean)
            shares = []
            for draw in range(_DRAWS):
                noisy = _add_noise(clean, "light", str(width), place, str(draw), seed=seed)
                shares.append(_sum_flux(denoiser(noisy)) / flux)
            kept.setdefault(f"{width:g}", {})[place] = fmean(shares)
    return kept


def _sum_flux(image: Tensor) -> float:
    """Sum the light above the ground in the 8 x 8 cells around the place."""
    return float((image[..., _AROUND, _AROUND] - _GROUND).sum())


def _measure_fields(denoiser: ScoredDenoiser, seed: int) -> dict[str, float]:
    """Measure the PSNR of fields of lights, by width."""
    fields = {}
    for width in WIDTHS:
        clean = draw_field(width, seed)
        noisy = _add_noise(clean, "field", str(width), seed=seed)
        fields[f"{width:g}"] = float(psnr(denoiser(noisy), clean))
    return fields


def draw_light(side: int, row: float, column: float, width: float, peak: float = _PEAK) -> Tensor:
    """Draw a light of this width at a place, without its ground, ``(side, side)``."""
    rate = 4.0 * math.log(2.0) / width**2
    sites = torch.arange(side)
    down = torch.exp(-rate * (sites - row).square())
    across = torch.exp(-rate * (sites - column).square())
    return peak * down[:, None] * across


def draw_field(width: float, seed: int) -> Tensor:
    """Draw a field of lights of this width at random places, packed RAW ``(1, 4, h, w)``; faint ones are many."""
    generator = keyed_generator(seed, "harm field")
    mosaic = torch.full((_FIELD_SIDE, _FIELD_SIDE), _GROUND)
    for row, column, brightness in torch.rand(_FIELD_LIGHTS, 3, generator=generator).tolist():
        mosaic += draw_light(_FIELD_SIDE, row * _FIELD_SIDE, column * _FIELD_SIDE, width, _PEAK * brightness**3)
    return bayer.pack(mosaic.clamp(max=1.0)[None, None], CFA.RGGB)


def _add_noise(clean: Tensor, *key: str, seed: int) -> Noisy:
    deviation = noise_variance(clean, *_LEVELS).sqrt()
    noise = torch.randn(clean.shape, generator=keyed_generator(seed, "harm", *key))
    return Noisy.of((clean + deviation * noise).clamp(max=1.0), _LEVELS, CFA.RGGB)


def harm_tables(rows: Mapping[str, Mapping[str, Any]]) -> Iterator[tuple[str, list[str], dict[str, list[str]]]]:
    """Yield title, columns and cells by denoiser of the tables of :func:`measure_harm`."""
    widths = [f"{width:g}" for width in WIDTHS]
    head = [*FRAMES, *(f"field {width}" for width in widths)]
    cells = {}
    for name, row in rows.items():
        figures = [row["frames"][column]["psnr"] for column in FRAMES] + [row["fields"][width] for width in widths]
        cells[name] = [f"{figure:.2f}" for figure in figures]
    yield "where denoisers harm: PSNR of RAW in dB", head, cells

    head = [f"{width} {place}" for width in widths for place in PLACES]
    cells = {}
    for name, row in rows.items():
        cells[name] = [f"{100 * row['kept'][width][place]:.0f}" for width in widths for place in PLACES]
    yield "flux that a light keeps, in %, by width in pixels and place", head, cells
