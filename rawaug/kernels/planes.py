"""Passes over whole planes as loops for the CPU: demosaicings that choose between row and column, and smoothing."""

from __future__ import annotations

from functools import partial

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from rawaug.bayer import CFA, demosaic
from rawaug.kernels.runtime import compile_loop, compile_part, run_over_rows

_MARGIN = 6
"""A picture has this many sites around it: green looks 2 around, colour 1, steps 1, their count 1; it must be even."""
_HALF, _QUARTER, _TWO = np.float32(0.5), np.float32(0.25), np.float32(2)


def demosaic_directional(raw: Tensor, cfa: CFA, method: str) -> Tensor:
    """Demosaic ``(B, 1, H, W)``, float32 on the CPU, to ``(B, 3, H, W)``; only ``adams`` and ``ahd`` have loops."""
    if method not in ("adams", "ahd"):
        return demosaic(raw, cfa, method)

    rgb = torch.empty(len(raw), 3, *raw.shape[2:])
    for mosaic, out in zip(raw.detach().numpy()[:, 0], rgb.numpy(), strict=True):
        demosaic_balanced(mosaic, np.ones(3, np.float32), False, cfa, method == "ahd", out)
    return rgb


def demosaic_balanced(
    mosaic: np.ndarray, gains: np.ndarray, clipped: bool, cfa: CFA, homogeneous: bool, rgb: np.ndarray
) -> None:
    """Demosaic ``(H, W)`` to ``(3, H, W)`` by ``ahd``, or ``adams``, under the gains of three colours, then undone.

    Balanced RAW is clipped at black if ``clipped``.
    """
    height, width = mosaic.shape
    site_gains = gains[np.array(cfa.channels)]
    padded = np.empty((height + 2 * _MARGIN, width + 2 * _MARGIN), np.float32)
    _balance(mosaic, site_gains, np.float32(0 if clipped else -np.inf), padded)
    run_over_rows(height, width, partial(_rows, padded, *cfa.sites[0], homogeneous, gains, rgb))


@compile_loop
def _balance(mosaic, gains, black, padded):  # type: ignore[no-untyped-def]
    """Multiply a mosaic by the gains of its sites, clip it at black, and reflect it about its border sites."""
    height, width = mosaic.shape
    for i in range(height + 2 * _MARGIN):
        y = _reflect(i - _MARGIN, height)
        row = padded[i]
        for j in range(width):
            row[_MARGIN + j] = max(mosaic[y, j] * gains[y & 1, j & 1], black)
        for j in range(-_MARGIN, 0):
            row[_MARGIN + j] = row[_MARGIN + _reflect(j, width)]
        for j in range(width, width + _MARGIN):
            row[_MARGIN + j] = row[_MARGIN + _reflect(j, width)]


@compile_part
def _reflect(k, size):  # type: ignore[no-untyped-def]
    """Reflect a row or column about the first and the last, as often as it takes."""
    period = 2 * size - 2
    k = abs(k) % period
    return period - k if k >= size else k


@partial(compile_loop, allocates=True)
def _rows(mosaic, red_row, red_column, homogeneous, gains, rgb, start, stop):  # type: ignore[no-untyped-def]
    """Demosaic rows ``start`` to ``stop`` of a picture whose mosaic has margins, and divide them by the gains."""
    own = mosaic[start : stop + 2 * _MARGIN]
    rows, width = own.shape
    first = (start + red_row) % 2  # of the rows with red
    directions = 2 if homogeneous else 1
    pictures = np.zeros((directions, 3, rows, width), np.float32)  # along rows, along columns

    for i in range(2, rows - 2):
        measured = (i + first + red_column + 1) % 2  # columns of this parity hold green
        above, below = (own[i - 2], own[i - 1]), (own[i + 1], own[i + 2])
        if homogeneous:
            _green_in_row(own[i], measured, pictures[0, 1, i])
            _green_in_column(above[0], above[1], own[i], below[0], below[1], measured, pictures[1, 1, i])
        else:
            _green_of_lesser_change(above[0], above[1], own[i], below[0], below[1], measured, pictures[0, 1, i])
    for d in range(directions):
        for i in range(3, rows - 3):
            near, far = 2, 0
            if (i + first) % 2 == 0:
                near, far = 0, 2
            sites = red_column
            if near == 2:
                sites = 1 - red_column
            picture, green = pictures[d], pictures[d, 1]
            _colour_in_row(own[i], green[i], sites, picture[near, i])
            _colour_between_rows(own[i - 1], own[i + 1], green[i - 1], green[i], green[i + 1], sites, picture[far, i])

    lead = np.zeros((rows, width), np.int8)
    if homogeneous:
        _leads(pictures, lead)

    sums, total = np.zeros(width, np.int32), np.ones(width, np.int32)
    for i in range(_MARGIN, rows - _MARGIN):
        if homogeneous:
            for j in range(width):
                sums[j] = np.int32(lead[i - 1, j]) + np.int32(lead[i, j]) + np.int32(lead[i + 1, j])
            for j in range(1, width - 1):
                total[j] = sums[j - 1] + sums[j] + sums[j + 1]
        for c in range(3):
            along_row, along_column = pictures[0, c, i], pictures[directions - 1, c, i]
            _pick(along_row, along_column, total, gains[c], rgb[c, start + i - _MARGIN])


@compile_part
def _pick(along_row, along_column, total, gain, out):  # type: ignore[no-untyped-def]
    """Take the first row of colours where ``total`` is above 0, the second below, else their mean, over the gain."""
    for j in range(len(out)):
        a, b, lead = along_row[_MARGIN + j], along_column[_MARGIN + j], total[_MARGIN + j]
        value = b if lead < 0 else a
        value = _HALF * (a + b) if lead == 0 else value
        out[j] = value / gain


@compile_part
def _green_in_row(own, measured, out):  # type: ignore[no-untyped-def]
    """Fill in the green of a row from the row itself; columns of the parity ``measured`` hold green."""
    for j in range(2, len(own) - 2):
        here = own[j]
        bend = _TWO * here - own[j - 2] - own[j + 2]
        value = (own[j - 1] + own[j + 1]) * _HALF + bend * _QUARTER
        out[j] = here if (j & 1) == measured else value


@compile_part
def _green_in_column(second_above, above, own, below, second_below, measured, out):  # type: ignore[no-untyped-def]
    """Fill in the green of a row from the columns, as :func:`_green_in_row`."""
    for j in range(2, len(own) - 2):
        here = own[j]
        bend = _TWO * here - second_above[j] - second_below[j]
        value = (above[j] + below[j]) * _HALF + bend * _QUARTER
        out[j] = here if (j & 1) == measured else value


@compile_part
def _green_of_lesser_change(second_above, above, own, below, second_below, measured, out):  # type: ignore[no-untyped-def]
    """Fill in the green of a row from row or column, whichever changes less, or from both if they change alike."""
    for j in range(2, len(own) - 2):
        here = own[j]
        bend = _TWO * here - own[j - 2] - own[j + 2]
        bend_down = _TWO * here - second_above[j] - second_below[j]
        row = (own[j - 1] + own[j + 1]) * _HALF + bend * _QUARTER
        column = (above[j] + below[j]) * _HALF + bend_down * _QUARTER
        change = abs(own[j - 1] - own[j + 1]) + abs(bend)
        change_down = abs(above[j] - below[j]) + abs(bend_down)

        value = column if change > change_down else row
        value = _HALF * (row + column) if change == change_down else value
        out[j] = here if (j & 1) == measured else value


@compile_part
def _colour_in_row(own, green, sites, out):  # type: ignore[no-untyped-def]
    """Fill in the colour that a row measures in columns of the parity ``sites``: green plus the difference nearby."""
    for j in range(3, len(own) - 3):
        across = (own[j - 1] - green[j - 1]) + (own[j + 1] - green[j + 1])
        out[j] = own[j] if (j & 1) == sites else green[j] + across * _HALF


@compile_part
def _colour_between_rows(above, below, green_above, green, green_below, sites, out):  # type: ignore[no-untyped-def]
    """Fill in the colour that the rows above and below measure; columns of the parity ``sites`` hold the row's own."""
    for j in range(3, len(green) - 3):
        down = (above[j] - green_above[j]) + (below[j] - green_below[j])
        corners = above[j - 1] - green_above[j - 1] + above[j + 1] - green_above[j + 1]
        corners += below[j - 1] - green_below[j - 1] + below[j + 1] - green_below[j + 1]
        out[j] = green[j] + corners * _QUARTER if (j & 1) == sites else green[j] + down * _HALF


@partial(compile_part, allocates=True)
def _leads(pictures, lead):  # type: ignore[no-untyped-def]
    """Count how many more of a site's four neighbours are like it in the first picture than in the second."""
    rows, width = lead.shape
    steps = np.zeros((2, 2, 2, rows, width), np.float32)  # picture; to the right, below; of light, of colour
    for d in range(2):
        red, green, blue = pictures[d]
        for down in range(2):
            for i in range(3, rows - 4):
                for j in range(3, width - 4):
                    i2, j2 = i + down, j + 1 - down
                    light = green[i, j] - green[i2, j2]
                    warm, cold = red[i, j] - red[i2, j2] - light, blue[i, j] - blue[i2, j2] - light
                    steps[d, down, 0, i, j], steps[d, down, 1, i, j] = light * light, warm * warm + cold * cold

    # The picture along rows is judged by its steps along rows, the one along columns by its steps along columns.
    of_rows, of_columns = steps[0, 0], steps[1, 1]
    for i in range(4, rows - 4):
        for j in range(4, width - 4):
            light = min(max(of_rows[0, i, j - 1], of_rows[0, i, j]), max(of_columns[0, i - 1, j], of_columns[0, i, j]))
            colour = min(max(of_rows[1, i, j - 1], of_rows[1, i, j]), max(of_columns[1, i - 1, j], of_columns[1, i, j]))

            more = 0
            for d in range(2):
                across, down = steps[d, 0], steps[d, 1]
                number = np.int32((across[0, i, j - 1] <= light) & (across[1, i, j - 1] <= colour))
                number += (across[0, i, j] <= light) & (across[1, i, j] <= colour)
                number += (down[0, i - 1, j] <= light) & (down[1, i - 1, j] <= colour)
                number += (down[0, i, j] <= light) & (down[1, i, j] <= colour)
                more += number if d == 0 else -number
            lead[i, j] = more


def smooth(planes: Tensor, taps: Tensor) -> Tensor:
    """Filter each picture of ``(B, N, H, W)``, float32 on the CPU, with its own taps ``(B, K)`` along both axes.

    The first tap is the middle one, and the others are on both sides of it. Beyond the border the last values are
    repeated.
    """
    batch, count, height, width = planes.shape
    image = planes.contiguous().numpy().reshape(batch * count, height, width)
    odd_taps = F.pad(taps.float(), (0, 1 - taps.shape[1] % 2))
    weights = odd_taps.repeat_interleave(count, 0).numpy()

    out = torch.empty(batch, count, height, width)
    filter_rows = partial(_smooth_rows, image, weights, out.numpy().reshape(image.shape))
    run_over_rows(len(image) * height, width, filter_rows)
    return out


@partial(compile_loop, allocates=True)
def _smooth_rows(image, weights, out, start, stop):  # type: ignore[no-untyped-def]
    """Filter rows ``start`` to ``stop`` of all planes, two taps at a time.

    A row is filtered down the columns into a line with margins, and then along the line.
    """
    _, height, width = image.shape
    margin = weights.shape[1] - 1
    line = np.empty(width + 2 * margin, np.float32)
    middle = line[margin : margin + width]

    for row in range(start, stop):
        plane, y = row // height, row % height
        taps, own, result = weights[plane], image[plane, y], out[plane, y]
        reach = margin
        while reach > 0 and taps[reach] == 0 and taps[reach - 1] == 0:
            reach -= 2

        for x in range(width):
            middle[x] = taps[0] * own[x]
        for k in range(1, reach, 2):
            a, b = image[plane, max(y - k, 0)], image[plane, min(y + k, height - 1)]
            c, d = image[plane, max(y - k - 1, 0)], image[plane, min(y + k + 1, height - 1)]
            first, second = taps[k], taps[k + 1]
            for x in range(width):
                middle[x] += first * (a[x] + b[x]) + second * (c[x] + d[x])

        line[margin - reach : margin] = middle[0]
        line[margin + width : margin + width + reach] = middle[width - 1]
        for x in range(width):
            result[x] = taps[0] * middle[x]
        for k in range(1, reach, 2):
            a, b, c, d = line[margin - k :], line[margin + k :], line[margin - k - 1 :], line[margin + k + 1 :]
            first, second = taps[k], taps[k + 1]
            for x in range(width):
                result[x] += first * (a[x] + b[x]) + second * (c[x] + d[x])
