r"""Greens that agree: the two greens of Bayer's cell see one light, and a sensor may measure it differently.

.. math:: G_r - G_b = q_R(u, v) R + q_G(u, v) G + q_B(u, v) B + e

Gr has its red neighbours along the row and its blue ones along the column, Gb the other way round. Light that leaks
from them, each pixel's own gain and the black level make the difference, and each q is a quadratic in the place (u, v),
since leaks grow with the angle of the light. Noise hides the difference; without noise, demosaicing turns it into a
maze. The model has no term for a difference that the light does not make, so that taking it out scales details by a
percent or so and blurs none.

Each block of the frame gives one equation, which counts less the more the block varies: smooth places tell, edges and
texture do not. The greens disagree where one half of the frame foretells the other: in clearly more of its tiles than
by chance, the prediction makes the greens agree better, and what is left is noise.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional as F

from rawaug.bayer.cfa import CFA, pack, require_channels

BLOCK = 16
"""Side of a block, in cells."""
TILES = 8
"""Tiles along each side of the frame, of which every other foretells the rest."""
SURE = 4.0
"""Standard deviations by which the tiles that agree better must be more than half of them; 1 in 30,000 by chance."""
CLEAR = 5.0
"""Standard errors above which a difference must be as well."""
LARGEST = 0.06
"""Greens that differ by more than this part of them are a pattern in the scene: no sensor does that."""
_CLIPPED = 0.98
_GAIN_SD, _OFFSET_SD = 0.02, 1e-3  # coefficients are expected to be as small as this
_LEAST_SD, _LEAST_SCALE = 1e-5, 0.5
_LARGEST_SCALE = 2.0  # of the misfit: 0.8 for white noise, more for regular texture
_ROUNDS = 10
_I, _J = torch.tensor([(i, j) for i in range(3) for j in range(3 - i)]).T  # powers of u and v in a quadratic


@dataclass(frozen=True)
class GreenDifference:
    """By how much the greens of a frame differ.

    Attributes:
        gains: float64 ``(3, 3, 3)``: of R, G and B, the factor of u^i v^j at ``[colour, i, j]``, where u and v go from
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
        The difference, or None if the frame is smaller than :data:`TILES` blocks either way, or nearly all is clipped.

    Example:
        >>> light = torch.linspace(0.3, 0.4, 512).expand(1, 512, 512)
        >>> gains = torch.tensor([[1.0, 1.01], [0.99, 1.0]]).tile(256, 256)  # Gr 2 % above Gb
        >>> found = measure_greens(light * gains, "RGGB")
        >>> found.significant, round(found.share, 3)
        (True, 0.02)
    """
    if min(mosaic.shape[-2:]) < 2 * BLOCK * TILES:
        return None
    terms, difference, sd, green, tile = _blocks(mosaic, cfa)
    if len(sd) < TILES**2:
        return None
    found, covariance, scale = _fit(terms, difference, sd)
    half, foretold = (tile // TILES + tile % TILES) % 2 == 0, torch.zeros_like(difference)
    for known in (half, ~half):
        foretold[~known] = terms[~known] @ _fit(terms[known], difference[known], sd[known])[0]
    # Cauchy's loss, without and with the prediction
    before, after = ((off / (2 * scale * sd)).square().log1p() for off in (difference, difference - foretold))
    agree = torch.zeros(TILES**2, dtype=sd.dtype).index_add(0, tile, before - after)[tile.unique()].sign()
    level = green.mean().clamp_min(1e-6)
    share = float((terms @ found).square().mean().sqrt() / level)
    error = float(((terms @ covariance) * terms).sum(1).mean().sqrt() / level)
    sure = float(agree.sum()) >= SURE * len(agree) ** 0.5 and CLEAR * error < share < LARGEST
    gains = torch.zeros(3, 3, 3, dtype=torch.float64)
    gains[:, _I, _J] = found[:-1].reshape(3, -1)
    return GreenDifference(gains, float(found[-1]), share, error, sure and scale < _LARGEST_SCALE)


def balance_greens(mosaic: Tensor, cfa: CFA | str, difference: GreenDifference) -> Tensor:
    """Take half of the difference from Gr and add half of it to Gb; red, blue and clipped sites stay.

    Args:
        mosaic: ``(1, H, W)``, as :func:`measure_greens` takes it.
        cfa: its pattern.
        difference: what :func:`measure_greens` found in it, significant or not.

    Returns:
        A new mosaic ``(1, H, W)``.
    """
    row, column, _ = _neighbours(mosaic)
    down, along = (_powers(torch.linspace(-1, 1, side).to(mosaic)) for side in mosaic.shape[-2:])
    gains, balanced = difference.gains.to(mosaic) / 2, mosaic.clone()
    for sign, (i, j), red, blue in zip((-1, 1), CFA(cfa).sites[1:3], (row, column), (column, row), strict=True):
        half = torch.full_like(mosaic[:, i::2, j::2], difference.offset / 2)
        for light, gain in zip((red, mosaic, blue), gains, strict=True):
            half.addcmul_(light[:, i::2, j::2], down[i::2] @ gain @ along[j::2].T)
        site = mosaic[:, i::2, j::2]
        balanced[:, i::2, j::2] = torch.where(site < 1, half.mul_(sign).add_(site).clamp_(max=1), site)
    return balanced


def _neighbours(mosaic: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Means of the next sites in the row, in the column and on the diagonals of each site, ``(1, H, W)`` each."""
    padded = F.pad(mosaic, (1, 1, 1, 1), mode="reflect")  # about the border sites: the pattern stays
    row, column = (padded[..., :-2] + padded[..., 2:]) / 2, (padded[:, :-2] + padded[:, 2:]) / 2
    return row[:, 1:-1], column[..., 1:-1], (row[:, :-2] + row[:, 2:]) / 2


def _powers(x: Tensor) -> Tensor:
    """1, x and x^2, ``(N, 3)``."""
    return torch.stack([torch.ones_like(x), x, x.square()], dim=-1)


def _blocks(mosaic: Tensor, cfa: CFA | str) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """The model's terms ``(N, 19)``, Gr - Gb, its deviation, green and the tile ``(N,)`` of blocks without clipping."""
    require_channels(mosaic, 1, "a mosaic")
    packed = pack(mosaic, cfa)
    # each green less the mean of the other kind around it, so that a slope of the light is no difference
    above = pack(mosaic - _neighbours(mosaic)[2], cfa)[1:3]
    quarters = torch.cat([packed, above, above.square(), (packed >= _CLIPPED).any(0, keepdim=True).to(packed)])
    # means weighted by a tent, as texture that a block cuts off would count as a difference
    means = F.avg_pool2d(F.avg_pool2d(F.avg_pool2d(quarters, BLOCK // 2), 2, 1), 2, 1)[..., ::2, ::2].double()
    rows, columns = means.shape[-2:]
    clear = means[8] == 0
    sd = ((means[6:8] - means[4:6].square()).clamp_min(0).mean(0).sqrt() / BLOCK).clamp_min(_LEAST_SD)
    u, v = (
        _powers(2 * BLOCK * (2 * torch.arange(n, dtype=torch.float64) + 1) / side - 1)
        for n, side in zip((rows, columns), mosaic.shape[-2:], strict=True)
    )
    place, green = u[:, None, _I] * v[None, :, _J], (means[1] + means[2]) / 2
    terms = [place * light[..., None] for light in (means[0], green, means[3])] + [torch.ones_like(place[..., :1])]
    tiles = (torch.arange(rows) * TILES // rows)[:, None] * TILES + torch.arange(columns) * TILES // columns
    return torch.cat(terms, -1)[clear], ((means[4] - means[5]) / 2)[clear], sd[clear], green[clear], tiles[clear]


def _fit(terms: Tensor, difference: Tensor, sd: Tensor) -> tuple[Tensor, Tensor, float]:
    """The coefficients ``(19,)`` by robust ridge regression, their covariance, and by what ``sd`` is too small."""
    prior = torch.tensor([_GAIN_SD**-2] * (terms.shape[1] - 1) + [_OFFSET_SD**-2], dtype=terms.dtype)
    found, covariance, scale = torch.zeros_like(prior), torch.diag(1 / prior), 1.0
    for _ in range(_ROUNDS if len(sd) else 0):
        off = (difference - terms @ found) / sd
        scale = max(1.4826 * float(off.abs().median()), _LEAST_SCALE)
        weight = 1 / (scale * sd).square() / (1 + (off / (2 * scale)).square())
        covariance = torch.linalg.inv(terms.T @ (weight[:, None] * terms) + torch.diag(prior))
        found = covariance @ (terms.T @ (weight * difference))
    return found, covariance, scale
