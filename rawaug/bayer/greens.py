r"""Greens that agree: the two greens of Bayer's cell see the same light, but a sensor may measure it differently.

.. math:: G_r - G_b = q_R(u, v) R + q_G(u, v) G + q_B(u, v) B + e

Gr has its red neighbours along the row and its blue ones along the column; for Gb it is the other way round. The
difference comes from light that leaks from them, from each pixel's own gain and from the black level. Each q is a
quadratic in the place (u, v), since leaks grow with the angle of the light. Noise hides the difference; without noise,
demosaicing turns it into a maze. The model has no term for a difference that the light does not make, so taking it out
scales details by a percent or so and blurs none.

Each block of the frame gives one equation, which counts less the more the block varies, so smooth places tell the
difference, and edges and texture do not. The greens disagree if one half of the frame foretells the other: in clearly
more of its tiles than by chance, the prediction makes the greens agree better, and what is left is noise.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional as F

from rawaug.bayer.cfa import CFA, pack, require_channels

BLOCK = 16
"""A block has this side, in cells."""

_TILES = 8
"""The frame has this many tiles along each side; every other tile foretells the rest."""

_SURE = 4.0
"""Tiles agree significantly from this many standard deviations, which chance reaches 1 in 30,000 times."""

_CLEAR = 5.0
"""A difference is significant from this many standard errors."""

_LARGEST = 0.06
"""A sensor's greens differ by at most this share; a larger difference is a pattern in the scene."""

_CLIPPED = 0.98
"""A site counts as clipped from this signal."""

_GAIN_SD, _OFFSET_SD = 0.02, 1e-3
"""The prior of the coefficients has these standard deviations."""

_LEAST_SD, _LEAST_SCALE = 1e-5, 0.5
"""These are the lower limits of the blocks' standard deviation and of the misfit's scale."""

_LARGEST_SCALE = 2.0
"""The misfit's scale is at most this; it is 0.8 for white noise and more for regular texture."""

_ROUNDS = 10
"""The robust fit has this many rounds."""

_I, _J = torch.tensor([(0, 0), (0, 1), (0, 2), (1, 0), (1, 1), (2, 0)]).T
"""These are the powers of u and v in a quadratic."""


@dataclass(frozen=True)
class GreenDifference:
    """The difference between the greens of a frame.

    Attributes:
        gains: float64 ``(3, 3, 3)``: the factor of u^i v^j for R, G and B at ``[colour, i, j]``, where u and v go from
            -1 to 1 down and along the frame.
        offset: what is left in the dark, white = 1.
        share: root mean square of Gr - Gb over the frame's blocks, as a part of their green.
        error: the standard error of ``share``.
        significant: whether one half of the frame foretells the other.
    """

    gains: Tensor
    offset: float
    share: float
    error: float
    significant: bool


def measure_greens(mosaic: Tensor, cfa: CFA | str) -> GreenDifference | None:
    """Measure by how much the greens of a Bayer frame differ where it is smooth.

    Args:
        mosaic: ``(1, H, W)``, noisy or not, black-subtracted, white = 1; sides even.
        cfa: its pattern.

    Returns:
        The difference, or None if the frame is smaller than :data:`_TILES` blocks either way or nearly all clipped.

    Example:
        >>> light = torch.linspace(0.3, 0.4, 512).expand(1, 512, 512)
        >>> gains = torch.tensor([[1.0, 1.01], [0.99, 1.0]]).tile(256, 256)  # Gr 2 % above Gb
        >>> difference = measure_greens(light * gains, "RGGB")
        >>> difference.significant, round(difference.share, 3)
        (True, 0.02)
    """
    if min(mosaic.shape[-2:]) < 2 * BLOCK * _TILES:
        return None
    blocks = _blocks(mosaic, cfa)
    if len(blocks.sd) < _TILES**2:
        return None

    coefficients, covariance, scale = _fit(blocks.terms, blocks.difference, blocks.sd)
    level = blocks.green.mean().clamp_min(1e-6)
    share = float((blocks.terms @ coefficients).square().mean().sqrt() / level)
    error = float(((blocks.terms @ covariance) * blocks.terms).sum(1).mean().sqrt() / level)
    significant = (
        _CLEAR * error < share < _LARGEST  # not by chance, and not a pattern of the scene
        and scale < _LARGEST_SCALE
        and _halves_agree(blocks, scale)
    )

    gains = torch.zeros(3, 3, 3, dtype=torch.float64)
    gains[:, _I, _J] = coefficients[:-1].reshape(3, -1)
    return GreenDifference(gains, float(coefficients[-1]), share, error, significant)


def balance_greens(mosaic: Tensor, cfa: CFA | str, difference: GreenDifference) -> Tensor:
    """Take half of the difference from Gr and add half of it to Gb; red, blue and clipped sites stay.

    Args:
        mosaic: ``(1, H, W)``, as :func:`measure_greens` takes it.
        cfa: its pattern.
        difference: what :func:`measure_greens` found in it, significant or not.

    Returns:
        A new mosaic ``(1, H, W)``.
    """
    row_means, column_means = _neighbours(mosaic)
    height, width = mosaic.shape[-2:]
    down = _powers(torch.linspace(-1, 1, height).to(mosaic))
    along = _powers(torch.linspace(-1, 1, width).to(mosaic))
    gains = difference.gains.to(mosaic) / 2
    _, gr_site, gb_site, _ = CFA(cfa).sites

    balanced = mosaic.clone()
    for sign, (i, j), red, blue in (
        (-1, gr_site, row_means, column_means),
        (1, gb_site, column_means, row_means),
    ):
        half = torch.full_like(mosaic[:, i::2, j::2], difference.offset / 2)
        for light, gain in zip((red, mosaic, blue), gains, strict=True):
            half.addcmul_(light[:, i::2, j::2], down[i::2] @ gain @ along[j::2].T)

        green = mosaic[:, i::2, j::2]
        corrected = half.mul_(sign).add_(green).clamp_(max=1)
        balanced[:, i::2, j::2] = torch.where(green < 1, corrected, green)
    return balanced


def _neighbours(mosaic: Tensor) -> tuple[Tensor, Tensor]:
    """Average the nearest sites in the row and those in the column of each site, ``(1, H, W)`` each."""
    padded = _pad_by_one(mosaic)
    row = (padded[:, 1:-1, :-2] + padded[:, 1:-1, 2:]) / 2
    column = (padded[:, :-2, 1:-1] + padded[:, 2:, 1:-1]) / 2
    return row, column


def _diagonals(mosaic: Tensor) -> Tensor:
    """Average the nearest sites on the diagonals of each site, ``(1, H, W)``."""
    padded = _pad_by_one(mosaic)
    row = (padded[..., :-2] + padded[..., 2:]) / 2
    return (row[:, :-2] + row[:, 2:]) / 2


def _pad_by_one(mosaic: Tensor) -> Tensor:
    return F.pad(mosaic, (1, 1, 1, 1), mode="reflect")  # about the border sites, so the pattern stays


def _powers(x: Tensor) -> Tensor:
    """Compute 1, x and x^2, ``(N, 3)``."""
    return torch.stack([torch.ones_like(x), x, x.square()], dim=-1)


class _Blocks(NamedTuple):
    """The equations of the N blocks of a frame in which nothing is clipped, float64.

    Attributes:
        terms: ``(N, 19)``, what the model's coefficients multiply: six powers of the place times R, G and B, and 1.
        difference: ``(N,)``, Gr - Gb.
        sd: ``(N,)``, the standard deviation of ``difference``.
        green: ``(N,)``, the mean of both greens.
        tile: ``(N,)``, the number of the tile, row by row.
    """

    terms: Tensor
    difference: Tensor
    sd: Tensor
    green: Tensor
    tile: Tensor


def _blocks(mosaic: Tensor, cfa: CFA | str) -> _Blocks:
    """Make the equations of a mosaic ``(1, H, W)``."""
    require_channels(mosaic, 1, "a mosaic")
    packed = pack(mosaic, cfa)
    clipped = (packed >= _CLIPPED).any(0, keepdim=True).to(packed)
    # From each green, the mean of the other kind around it is subtracted, so that a slope of the light is no
    # difference.
    excess = pack(mosaic - _diagonals(mosaic), cfa)[1:3]

    # Means are weighted by a tent, as texture that a block cuts off would count as a difference.
    planes = torch.cat([packed, excess, excess.square(), clipped])
    halves = F.avg_pool2d(planes, BLOCK // 2)
    means = F.avg_pool2d(F.avg_pool2d(halves, 2, 1), 2, 1)[..., ::2, ::2].double()
    red, gr, gb, blue = means[:4]
    gr_excess, gb_excess = means[4:6]
    green = (gr + gb) / 2
    difference = (gr_excess - gb_excess) / 2
    variance = (means[6:8] - means[4:6].square()).clamp_min(0).mean(0)
    sd = (variance.sqrt() / BLOCK).clamp_min(_LEAST_SD)

    rows, columns = means.shape[-2:]
    u = _powers(_places(rows, mosaic.shape[-2]))
    v = _powers(_places(columns, mosaic.shape[-1]))
    place = u[:, None, _I] * v[None, :, _J]
    terms = [place * red[..., None], place * green[..., None], place * blue[..., None], torch.ones_like(place[..., :1])]
    tile_rows = torch.arange(rows) * _TILES // rows
    tile_columns = torch.arange(columns) * _TILES // columns
    tile = tile_rows[:, None] * _TILES + tile_columns

    clear = means[8] == 0
    return _Blocks(torch.cat(terms, -1)[clear], difference[clear], sd[clear], green[clear], tile[clear])


def _places(count: int, side: int) -> Tensor:
    """Compute where the middles of ``count`` blocks lie along a side, from -1 to 1, ``(count,)``."""
    middles = BLOCK * (2 * torch.arange(count, dtype=torch.float64) + 1)
    return 2 * middles / side - 1


def _fit(terms: Tensor, difference: Tensor, sd: Tensor) -> tuple[Tensor, Tensor, float]:
    """Fit the coefficients ``(19,)`` by robust ridge regression: these, their covariance, and by what ``sd`` is too
    small.
    """
    prior = torch.tensor([_GAIN_SD**-2] * (terms.shape[1] - 1) + [_OFFSET_SD**-2], dtype=terms.dtype)
    coefficients, covariance, scale = torch.zeros_like(prior), torch.diag(1 / prior), 1.0
    if len(sd) == 0:
        return coefficients, covariance, scale

    for _ in range(_ROUNDS):
        misfit = (difference - terms @ coefficients) / sd
        scale = max(1.4826 * float(misfit.abs().median()), _LEAST_SCALE)
        weight = 1 / (scale * sd).square() / (1 + (misfit / (2 * scale)).square())

        covariance = torch.linalg.inv(terms.T @ (weight[:, None] * terms) + torch.diag(prior))
        coefficients = covariance @ (terms.T @ (weight * difference))
    return coefficients, covariance, scale


def _halves_agree(blocks: _Blocks, scale: float) -> bool:
    """Tell whether each half of the frame's chessboard of tiles foretells the other in clearly more tiles than not."""
    white = (blocks.tile // _TILES + blocks.tile % _TILES) % 2 == 0
    prediction = torch.zeros_like(blocks.difference)
    for half in (white, ~white):
        coefficients, _, _ = _fit(blocks.terms[half], blocks.difference[half], blocks.sd[half])
        prediction[~half] = blocks.terms[~half] @ coefficients

    def loss(misfit: Tensor) -> Tensor:
        return (misfit / (2 * scale * blocks.sd)).square().log1p()  # Cauchy's

    gain = loss(blocks.difference) - loss(blocks.difference - prediction)
    gain_of_tiles = torch.zeros(_TILES**2, dtype=gain.dtype).index_add(0, blocks.tile, gain)
    agreement = gain_of_tiles[blocks.tile.unique()].sign()
    return float(agreement.sum()) >= _SURE * len(agreement) ** 0.5
