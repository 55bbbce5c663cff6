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

    def fill(start: int, stop: int) -> None:
        pictures = np.zeros((2 if homogeneous else 1, 3, 4, padded.shape[1]), np.float32)
        steps = np.zeros((3, 3, 2, padded.shape[1]), np.float32)
        lead = np.zeros((4, padded.shape[1]), np.int8)
        sums, total = np.zeros(padded.shape[1], np.int32), np.ones(padded.shape[1], np.int32)
        _rows(padded, *cfa.sites[0], homogeneous, gains, rgb, pictures, steps, lead, sums, total, start, stop)

    run_over_rows(height, width, fill)


@compile_loop
def _balance(mosaic, gains, black, padded):  # type: ignore[no-untyped-def]
    """Multiply a mosaic by the gains of its sites, clip it at black, and reflect it about its border sites."""
    height, width = mosaic.shape
    for i in range(height + 2 * _MARGIN):
        y = _reflect(i - _MARGIN, height)
        even, odd = gains[y & 1, 0], gains[y & 1, 1]
        values, row, inner = mosaic[y], padded[i], padded[i, _MARGIN:]
        for j in range(width):
            inner[j] = max(values[j] * (odd if j & 1 else even), black)
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


@compile_loop
def _rows(  # type: ignore[no-untyped-def]
    mosaic, red_row, red_column, homogeneous, gains, rgb, pictures, steps, lead, sums, total, start, stop
):
    """Demosaic rows ``start`` to ``stop`` of a picture whose mosaic has margins, and divide them by the gains.

    A row of green is filled in at a time, then what has become possible above it. Of what is filled in, along rows and
    along columns, the last four rows are kept, which fit the fastest cache.
    """
    directions = len(pictures)
    for row in range(start - 3, stop + 3):
        i = row + _MARGIN  # green of this row
        above, below = (mosaic[i - 2], mosaic[i - 1]), (mosaic[i + 1], mosaic[i + 2])
        measured = (row + red_row + red_column + 1) % 2  # columns of this parity hold green
        if homogeneous:
            _green_in_row(mosaic[i], measured, pictures[0, 1, i % 4])
            _green_in_column(above[0], above[1], mosaic[i], below[0], below[1], measured, pictures[1, 1, i % 4])
        else:
            _green_of_lesser_change(above[0], above[1], mosaic[i], below[0], below[1], measured, pictures[0, 1, i % 4])

        i -= 1  # red and blue of the row above
        near, far, sites = 2, 0, 1 - red_column
        if (row - 1 + red_row) % 2 == 0:  # it measures red
            near, far, sites = 0, 2, red_column
        for d in range(directions):
            picture, green = pictures[d], pictures[d, 1]
            green_above, green_here, green_below = green[(i - 1) % 4], green[i % 4], green[(i + 1) % 4]
            _colour_in_row(mosaic[i], green_here, sites, picture[near, i % 4])
            _colour_between_rows(
                mosaic[i - 1], mosaic[i + 1], green_above, green_here, green_below, sites, picture[far, i % 4]
            )

        i -= 1  # which picture is more homogeneous there, two rows above
        if homogeneous:
            _lead(pictures, i, steps, lead[i % 4])

        i -= 1  # and the choice, three rows above
        if row - 3 < start:
            continue
        if homogeneous:
            _add_around(lead[(i - 1) % 4], lead[i % 4], lead[(i + 1) % 4], sums, total)
        for c in range(3):
            along_row, along_column = pictures[0, c, i % 4], pictures[directions - 1, c, i % 4]
            _pick(along_row, along_column, total, gains[c], rgb[c, row - 3])


@compile_part
def _pick(along_row, along_column, total, gain, out):  # type: ignore[no-untyped-def]
    """Take the first row of colours where ``total`` is above 0, the second below, else their mean, over the gain."""
    for j in range(len(out)):
        a, b, lead = along_row[_MARGIN + j], along_column[_MARGIN + j], total[_MARGIN + j]
        value = b if lead < 0 else a
        value = _HALF * (a + b) if lead == 0 else value
        out[j] = value / gain


# Below, neighbours are slices that begin earlier or later: an index that could be negative keeps a loop from vectors.


@compile_part
def _green_in_row(row, measured, out):  # type: ignore[no-untyped-def]
    """Fill in the green of a row from the row itself; columns of the parity ``measured`` hold green."""
    count = len(row) - 4
    second_left, left, here, right, second_right = row[:count], row[1:], row[2:], row[3:], row[4:]
    green = out[2:]
    for j in range(count):
        bend = _TWO * here[j] - second_left[j] - second_right[j]
        value = (left[j] + right[j]) * _HALF + bend * _QUARTER
        green[j] = here[j] if (j & 1) == measured else value


@compile_part
def _green_in_column(second_above, above, row, below, second_below, measured, out):  # type: ignore[no-untyped-def]
    """Fill in the green of a row from the columns, as :func:`_green_in_row`."""
    for j in range(len(row)):
        bend = _TWO * row[j] - second_above[j] - second_below[j]
        value = (above[j] + below[j]) * _HALF + bend * _QUARTER
        out[j] = row[j] if (j & 1) == measured else value


@compile_part
def _green_of_lesser_change(second_above, above, row, below, second_below, measured, out):  # type: ignore[no-untyped-def]
    """Fill in the green of a row from row or column, whichever changes less, or from both if they change alike."""
    count = len(row) - 4
    second_left, left, here, right, second_right = row[:count], row[1:], row[2:], row[3:], row[4:]
    second_up, up, down, second_down = second_above[2:], above[2:], below[2:], second_below[2:]
    green = out[2:]
    for j in range(count):
        bend = _TWO * here[j] - second_left[j] - second_right[j]
        bend_down = _TWO * here[j] - second_up[j] - second_down[j]
        in_row = (left[j] + right[j]) * _HALF + bend * _QUARTER
        in_column = (up[j] + down[j]) * _HALF + bend_down * _QUARTER
        change = abs(left[j] - right[j]) + abs(bend)
        change_down = abs(up[j] - down[j]) + abs(bend_down)

        value = in_column if change > change_down else in_row
        value = _HALF * (in_row + in_column) if change == change_down else value
        green[j] = here[j] if (j & 1) == measured else value


@compile_part
def _colour_in_row(row, green, sites, out):  # type: ignore[no-untyped-def]
    """Fill in the colour that a row measures in columns of the parity ``sites``: green plus the difference nearby."""
    count = len(row) - 2
    left, here, right = row[:count], row[1:], row[2:]
    green_left, green_here, green_right = green[:count], green[1:], green[2:]
    colour = out[1:]
    for j in range(count):
        across = (left[j] - green_left[j]) + (right[j] - green_right[j])
        colour[j] = here[j] if (j & 1) != sites else green_here[j] + across * _HALF


@compile_part
def _colour_between_rows(above, below, green_above, green, green_below, sites, out):  # type: ignore[no-untyped-def]
    """Fill in the colour that the rows above and below measure; columns of the parity ``sites`` hold the row's own."""
    count = len(green) - 2
    left, middle, right = above[:count], above[1:], above[2:]
    low_left, low_middle, low_right = below[:count], below[1:], below[2:]
    green_left, green_middle, green_right = green_above[:count], green_above[1:], green_above[2:]
    green_low_left, green_low_middle, green_low_right = green_below[:count], green_below[1:], green_below[2:]
    here, colour = green[1:], out[1:]
    for j in range(count):
        down = (middle[j] - green_middle[j]) + (low_middle[j] - green_low_middle[j])
        corners = left[j] - green_left[j] + right[j] - green_right[j]
        corners += low_left[j] - green_low_left[j] + low_right[j] - green_low_right[j]
        at_corners, in_column = here[j] + corners * _QUARTER, here[j] + down * _HALF
        colour[j] = at_corners if (j & 1) != sites else in_column


@compile_part
def _steps(red, green, blue, next_red, next_green, next_blue, light, colour):  # type: ignore[no-untyped-def]
    """Square the steps of a row to its neighbours, of light and of colour."""
    for j in range(len(next_red)):
        step = green[j] - next_green[j]
        warm, cold = red[j] - next_red[j] - step, blue[j] - next_blue[j] - step
        light[j], colour[j] = step * step, warm * warm + cold * cold


@compile_part
def _lesser_step(across, above, below, out):  # type: ignore[no-untyped-def]
    """Take the lesser of the largest step along the row and the largest along the column, from the second site on."""
    before, after, up, down, least = across[:-1], across[1:], above[1:], below[1:], out[1:]
    for j in range(len(before)):
        least[j] = min(max(before[j], after[j]), max(up[j], down[j]))


@compile_part
def _count_alike(across, above, below, light, colour, sign, lead):  # type: ignore[no-untyped-def]
    """Add to ``lead``, or subtract by ``sign``, how many of four neighbours are within the steps allowed at a site."""
    left, left_colour = across[0, :-1], across[1, :-1]
    right, right_colour = across[0, 1:], across[1, 1:]
    up, up_colour = above[0, 1:], above[1, 1:]
    down, down_colour = below[0, 1:], below[1, 1:]
    most, most_colour, out = light[1:], colour[1:], lead[1:]
    for j in range(len(left)):
        alike = np.int32((left[j] <= most[j]) & (left_colour[j] <= most_colour[j]))
        alike += np.int32((right[j] <= most[j]) & (right_colour[j] <= most_colour[j]))
        alike += np.int32((up[j] <= most[j]) & (up_colour[j] <= most_colour[j]))
        alike += np.int32((down[j] <= most[j]) & (down_colour[j] <= most_colour[j]))
        out[j] += np.int8(sign * alike)


@compile_part
def _lead(pictures, i, steps, lead):  # type: ignore[no-untyped-def]
    """Count how many more of a site's four neighbours are like it in the first picture than in the second, in row i.

    ``steps`` are of a picture: to the right, and down from rows of even and of odd numbers; of light, of colour.
    """
    down, down_above = 1 + i % 2, 2 - i % 2
    for d in range(2):
        red, green, blue = pictures[d, 0, i % 4], pictures[d, 1, i % 4], pictures[d, 2, i % 4]
        k = (i + 1) % 4
        red_below, green_below, blue_below = pictures[d, 0, k], pictures[d, 1, k], pictures[d, 2, k]
        _steps(red, green, blue, red[1:], green[1:], blue[1:], steps[d, 0, 0], steps[d, 0, 1])
        _steps(red, green, blue, red_below, green_below, blue_below, steps[d, down, 0], steps[d, down, 1])

    # The picture along rows is judged by its steps along rows, the one along columns by its steps along columns.
    light, colour = steps[2, 0, 0], steps[2, 0, 1]
    across, above, below = steps[0, 0], steps[1, down_above], steps[1, down]
    _lesser_step(across[0], above[0], below[0], light)
    _lesser_step(across[1], above[1], below[1], colour)
    lead[:] = 0
    for d in range(2):
        _count_alike(steps[d, 0], steps[d, down_above], steps[d, down], light, colour, 1 - 2 * d, lead)


@compile_part
def _add_around(above, here, below, sums, total):  # type: ignore[no-untyped-def]
    """Add the 3 x 3 numbers around each site of a row, except for the first and the last."""
    for j in range(len(sums)):
        sums[j] = np.int32(above[j]) + np.int32(here[j]) + np.int32(below[j])
    left, middle, right, inner = sums[:-2], sums[1:-1], sums[2:], total[1:-1]
    for j in range(len(inner)):
        inner[j] = left[j] + middle[j] + right[j]


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
