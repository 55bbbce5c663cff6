r"""Demosaicing: sums over neighbours, and choices between row and column.

.. math:: \hat G = \tfrac12 (y_{-1} + y_{+1}) + \tfrac14 (2 y_0 - y_{-2} - y_{+2}), \qquad
          \hat R = \hat G + \mathrm{mean}(R - \hat G)

along the row or the column. ``adams`` takes the one along which y changes least at this site (J. F. Adams and
J. E. Hamilton, US patent 5,629,734, 1997), ``ahd`` the one whose picture in full colour is more homogeneous around it
(K. Hirakawa and T. W. Parks, "Adaptive homogeneity-directed demosaicing algorithm", TIP 2005). RAW developers choose in
this way. In flat areas noise decides and leaves a maze of short lines, which a sum over neighbours never does.
"""

from __future__ import annotations

from functools import lru_cache
from itertools import product

import torch
import torch.nn.functional as F
from torch import Tensor

from rawaug.bayer.cfa import CFA, require_channels, require_even

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
"""By these stencils, in eighths and by method, a site gets a colour that it lacks from its surroundings.

The three stencils are for green at red or blue; for a colour at a green whose neighbours along the row have it (or,
turned, along the column); and for red at blue or blue at red.
"""


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
    candidates = torch.cat([raw, F.conv2d(padded, stencils[:, None].to(raw))], dim=1)

    rgb = raw.new_empty(len(raw), 3, *raw.shape[-2:])
    for channel, i, j in product(range(3), range(2), range(2)):
        rgb[:, channel, i::2, j::2] = candidates[:, kinds[channel][i][j], i::2, j::2]
    return rgb


@lru_cache
def demosaicing_stencils(cfa: CFA | str, method: str) -> tuple[Tensor, list[list[list[int]]]]:
    """Make the four stencils ``(4, K, K)``, and say which one gives a colour at a site of the cell.

    ``kinds[colour][row][column]`` is 0 where the site has the colour itself, else the number of its stencil from 1.
    """
    cross, along_row, diagonal = STENCILS[method]
    stencils = torch.stack([cross, along_row, along_row.T, diagonal]) / 8
    cell = CFA(cfa).channels
    green = 1

    kinds = [[[0, 0], [0, 0]], [[0, 0], [0, 0]], [[0, 0], [0, 0]]]
    for colour, i, j in product(range(3), range(2), range(2)):
        if cell[i][j] == colour:
            kind = 0
        elif cell[i][j] == green and cell[i][1 - j] == colour:
            kind = 2
        elif cell[i][j] == green:
            kind = 3
        elif colour == green:
            kind = 1
        else:
            kind = 4
        kinds[colour][i][j] = kind
    return stencils, kinds


def _along(raw: Tensor, axis: int) -> tuple[Tensor, Tensor]:
    """Estimate the other colour of a row, or column, at every site, and how much both change there."""
    margins = {-1: (2, 2, 0, 0), -2: (0, 0, 2, 2)}
    padded = F.pad(raw, margins[axis], mode="reflect")
    side = raw.shape[axis]
    second_before, before = padded.narrow(axis, 0, side), padded.narrow(axis, 1, side)
    site = padded.narrow(axis, 2, side)
    after, second_after = padded.narrow(axis, 3, side), padded.narrow(axis, 4, side)

    bend = 2 * site - second_before - second_after
    return (before + after) / 2 + bend / 4, (before - after).abs() + bend.abs()


def _fill_colours(raw: Tensor, other: Tensor, cfa: CFA) -> Tensor:
    """Fill in the colours, given the green at red and blue sites: the differences to green are interpolated."""
    red_site, *green_sites, blue_site = cfa.sites

    green = other.clone()
    for i, j in green_sites:
        green[..., i::2, j::2] = raw[..., i::2, j::2]

    # This is red and blue less green, at first only at their own sites; between two sites it is the mean of both.
    chroma = raw.new_zeros(len(raw), 2, *raw.shape[-2:])
    for k, (i, j) in enumerate((red_site, blue_site)):
        chroma[:, k, i::2, j::2] = (raw - green)[:, 0, i::2, j::2]
    for axis, margins in ((-2, (0, 0, 1, 1)), (-1, (1, 1, 0, 0))):
        padded = F.pad(chroma, margins, mode="reflect")
        side = chroma.shape[axis]
        before, after = padded.narrow(axis, 0, side), padded.narrow(axis, 2, side)
        chroma = chroma + (before + after) / 2

    red_blue = green + chroma
    rgb = torch.stack([red_blue[:, 0], green[:, 0], red_blue[:, 1]], dim=1)
    for channel, (i, j) in ((0, red_site), (2, blue_site)):
        rgb[:, channel, i::2, j::2] = raw[:, 0, i::2, j::2]
    return rgb


def _adams(raw: Tensor, cfa: CFA) -> Tensor:
    """Demosaic with the green of the direction in which the mosaic changes least, or with the mean of both."""
    along_row, change_in_row = _along(raw, -1)
    along_column, change_in_column = _along(raw, -2)

    row_share = (change_in_row < change_in_column).to(raw) + 0.5 * (change_in_row == change_in_column)
    green = torch.lerp(along_column, along_row, row_share)
    return _fill_colours(raw, green, cfa)


def _ahd(raw: Tensor, cfa: CFA) -> Tensor:
    """Demosaic along rows and along columns, and take each site from the picture that is more homogeneous around it."""
    along_rows = _fill_colours(raw, _along(raw, -1)[0], cfa)
    along_columns = _fill_colours(raw, _along(raw, -2)[0], cfa)
    row_light, row_colour = _steps(along_rows)
    column_light, column_colour = _steps(along_columns)

    # Steps along rows in the picture along rows, and along columns in the other, say what is alike here.
    alike_light = torch.minimum(row_light[:, :2].amax(1), column_light[:, 2:].amax(1))[:, None]
    alike_colour = torch.minimum(row_colour[:, :2].amax(1), column_colour[:, 2:].amax(1))[:, None]

    def homogeneity(light: Tensor, colour: Tensor) -> Tensor:
        alike = (light <= alike_light) & (colour <= alike_colour)
        count = alike.to(raw).sum(1, keepdim=True)
        return F.avg_pool2d(F.pad(count, (1, 1, 1, 1), mode="reflect"), 3, 1)

    of_rows = homogeneity(row_light, row_colour)
    of_columns = homogeneity(column_light, column_colour)
    row_share = (of_rows > of_columns + 1e-3).to(raw) + 0.5 * ((of_rows - of_columns).abs() <= 1e-3)
    return torch.lerp(along_columns, along_rows, row_share)


def _steps(rgb: Tensor) -> tuple[Tensor, Tensor]:
    """Square the steps of light and of colour, ``(B, 4, H, W)``, to the neighbours left, right, above and below."""
    green = rgb[:, 1:2]
    return _squared_steps(green), _squared_steps(rgb[:, ::2] - green)


def _squared_steps(image: Tensor) -> Tensor:
    across = image.diff(dim=-1).square().sum(1)
    down = image.diff(dim=-2).square().sum(1)

    left, right = F.pad(across, (1, 0)), F.pad(across, (0, 1))
    above, below = F.pad(down, (0, 0, 1, 0)), F.pad(down, (0, 0, 0, 1))
    return torch.stack([left, right, above, below], dim=1)


DIRECTIONAL = {"adams": _adams, "ahd": _ahd}
"""These methods, by name, choose between row and column."""

METHODS = (*STENCILS, *DIRECTIONAL)
"""These are the names of all demosaicings."""


def require_method(name: str) -> None:
    """Raise ValueError unless there is such a demosaicing."""
    if name not in METHODS:
        raise ValueError(f"demosaicing {name!r} is unknown; use one of {', '.join(METHODS)}")
