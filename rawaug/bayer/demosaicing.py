r"""Demosaicing: sums over neighbours, and choices between row and column.

.. math:: \hat G = \tfrac12 (y_{-1} + y_{+1}) + \tfrac14 (2 y_0 - y_{-2} - y_{+2}), \qquad
          \hat R = \hat G + \mathrm{mean}(R - \hat G)

along the row or the column. ``adams`` takes the one along which y changes least at this site (J. F. Adams and
J. E. Hamilton, US patent 5,629,734, 1997), ``ahd`` the one whose picture in full colour is more homogeneous around it
(K. Hirakawa and T. W. Parks, "Adaptive homogeneity-directed demosaicing algorithm", TIP 2005). RAW developers choose
like this. In flat areas noise decides, and leaves a maze of short lines, which a sum over neighbours never does.
"""

from __future__ import annotations

from functools import lru_cache

import torch
import torch.nn.functional as F
from torch import Tensor

from rawaug.bayer.cfa import CFA, require_channels, require_even

# A colour that a site lacks, from its surroundings, in eighths: green at red or blue; a colour at a green whose
# neighbours along the row have it (turned, along the column); red at blue or blue at red.
STENCILS: dict[str, tuple[Tensor, Tensor, Tensor]] = {
    "bilinear": (
        torch.tensor([[0.0, 2, 0], [2, 0, 2], [0, 2, 0]]),
        torch.tensor([[0.0, 0, 0], [4, 0, 4], [0, 0, 0]]),
        torch.tensor([[2.0, 0, 2], [0, 0, 0], [2, 0, 2]]),
    ),
    "malvar": (
        torch.tensor([[0.0, 0, -1, 0, 0], [0, 0, 2, 0, 0], [-1, 2, 4, 2, -1], [0, 0, 2, 0, 0], [0, 0, -1, 0, 0]]),
        torch.tensor([[0, 0, 0.5, 0, 0], [0, -1, 0, -1, 0], [-1, 4, 5, 4, -1], [0, -1, 0, -1, 0], [0, 0, 0.5, 0, 0]]),
        torch.tensor([[0, 0, -1.5, 0, 0], [0, 2, 0, 2, 0], [-1.5, 0, 6, 0, -1.5], [0, 2, 0, 2, 0], [0, 0, -1.5, 0, 0]]),
    ),
}


def demosaic(raw: Tensor, cfa: CFA | str, method: str = "bilinear") -> Tensor:
    """Demosaic ``(B, 1, H, W)``, sides even, to ``(B, 3, H, W)``, stage f6: each site keeps the colour it measured.

    The methods are ``bilinear``; ``malvar``, where a missing colour follows its neighbours, corrected by the Laplacian
    of the known one (H. S. Malvar, L. He, R. Cutler, "High-quality linear interpolation for demosaicing of
    Bayer-patterned color images", ICASSP 2004); ``adams`` and ``ahd``, which the module explains and which expect white
    balance. All but the first take sides of at least 4.
    """
    require_channels(raw, 1, "a mosaic")
    require_even(*raw.shape[-2:])
    require_method(method)
    if method in DIRECTIONAL:
        return DIRECTIONAL[method](raw, CFA(cfa))
    stencils, kinds = demosaicing_stencils(cfa, method)
    edge = stencils.shape[-1] // 2
    padded = F.pad(raw, (edge, edge, edge, edge), mode="reflect")  # about the border sites: the pattern stays
    found = torch.cat([raw, F.conv2d(padded, stencils[:, None].to(raw))], dim=1)
    rgb = raw.new_empty(len(raw), 3, *raw.shape[-2:])
    for channel, rows in enumerate(kinds):
        for i, row in enumerate(rows):
            for j, kind in enumerate(row):
                rgb[:, channel, i::2, j::2] = found[:, kind, i::2, j::2]
    return rgb


@lru_cache
def demosaicing_stencils(cfa: CFA | str, method: str) -> tuple[Tensor, list[list[list[int]]]]:
    """Make the four stencils ``(4, K, K)``, and say which gives a colour at a site of the cell.

    ``kinds[colour][row][column]`` is 0 where the site has the colour itself, else the number of its stencil from 1.
    """
    cross, along_row, diagonal = STENCILS[method]
    own = CFA(cfa).channels

    def kind(colour: int, i: int, j: int) -> int:
        if own[i][j] == colour:
            return 0
        if own[i][j] == 1:
            return 2 if own[i][1 - j] == colour else 3
        return 1 if colour == 1 else 4

    kinds = [[[kind(colour, i, j) for j in (0, 1)] for i in (0, 1)] for colour in range(3)]
    return torch.stack([cross, along_row, along_row.T, diagonal]) / 8, kinds


def _along(raw: Tensor, axis: int) -> tuple[Tensor, Tensor]:
    """Estimate the other colour of a row, or column, at every site, and how much both change there."""
    padded = F.pad(raw, (2, 2, 0, 0) if axis == -1 else (0, 0, 2, 2), mode="reflect")
    far, near, own, after, last = (padded.narrow(axis, k, raw.shape[axis]) for k in range(5))
    bend = 2 * own - far - last
    return (near + after) / 2 + bend / 4, (near - after).abs() + bend.abs()


def _fill_colours(raw: Tensor, other: Tensor, cfa: CFA) -> Tensor:
    """Fill in the colours, given the green at red and blue sites: the differences to green are interpolated."""
    red, first, second, blue = cfa.sites
    green = other.clone()
    for i, j in (first, second):
        green[..., i::2, j::2] = raw[..., i::2, j::2]
    known = raw.new_zeros(len(raw), 2, *raw.shape[-2:])
    for k, (i, j) in enumerate((red, blue)):
        known[:, k, i::2, j::2] = (raw - green)[:, 0, i::2, j::2]
    for axis, ends in ((-2, (0, 0, 1, 1)), (-1, (1, 1, 0, 0))):
        padded = F.pad(known, ends, mode="reflect")
        before, after = (padded.narrow(axis, k, known.shape[axis]) for k in (0, 2))
        known = known + (before + after) / 2
    spread = green + known
    rgb = torch.stack([spread[:, 0], green[:, 0], spread[:, 1]], dim=1)
    for k, (i, j) in ((0, red), (2, blue)):
        rgb[:, k, i::2, j::2] = raw[:, 0, i::2, j::2]
    return rgb


def _adams(raw: Tensor, cfa: CFA) -> Tensor:
    (row, change), (column, change_down) = _along(raw, -1), _along(raw, -2)
    share = (change < change_down).to(raw) + 0.5 * (change == change_down)
    return _fill_colours(raw, torch.lerp(column, row, share), cfa)


def _ahd(raw: Tensor, cfa: CFA) -> Tensor:
    pictures = [_fill_colours(raw, _along(raw, axis)[0], cfa) for axis in (-1, -2)]
    steps = [_steps(picture) for picture in pictures]
    # Of the picture along rows the steps along rows, and of the other those along columns, say what is alike here.
    alike = [torch.minimum(steps[0][k][:, :2].amax(1), steps[1][k][:, 2:].amax(1))[:, None] for k in (0, 1)]
    counts = [((light <= alike[0]) & (colour <= alike[1])).to(raw).sum(1, keepdim=True) for light, colour in steps]
    row, column = (F.avg_pool2d(F.pad(count, (1, 1, 1, 1), mode="reflect"), 3, 1) for count in counts)
    share = (row > column + 1e-3).to(raw) + 0.5 * ((row - column).abs() <= 1e-3)
    return torch.lerp(pictures[1], pictures[0], share)


def _steps(rgb: Tensor) -> tuple[Tensor, Tensor]:
    """Square the steps of light and of colour, ``(B, 4, H, W)``, to the neighbours left, right, above and below."""
    found = []
    for image in (rgb[:, 1:2], rgb[:, ::2] - rgb[:, 1:2]):
        across, down = (image.diff(dim=axis).square().sum(1) for axis in (-1, -2))
        near = [(across, (1, 0)), (across, (0, 1)), (down, (0, 0, 1, 0)), (down, (0, 0, 0, 1))]
        found.append(torch.stack([F.pad(step, ends) for step, ends in near], dim=1))
    return found[0], found[1]


DIRECTIONAL = {"adams": _adams, "ahd": _ahd}
METHODS = (*STENCILS, *DIRECTIONAL)
"""The names of all demosaicings."""


def require_method(name: str) -> None:
    """Raise ValueError unless there is such a demosaicing."""
    if name not in METHODS:
        raise ValueError(f"demosaicing {name!r} is unknown; use one of {', '.join(METHODS)}")
