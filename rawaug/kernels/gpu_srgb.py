"""The way from mosaics to developed and finished sRGB as Triton kernels: a program works on a block of pixels.

Four passes develop a batch, each picture by its own demosaicing: green along rows and columns, the colours that follow
from it, which of the two is more homogeneous, and sRGB. A picture that a pass has nothing to do for ends it at once.
Outside a picture, mosaics and planes are reflected about the border sites, and finishing repeats the border.
"""

from __future__ import annotations

from functools import lru_cache

import torch
import triton
import triton.language as tl
from torch import Tensor

from rawaug.bayer import CFA, METHODS
from rawaug.kernels.gpu import _attention, _axis, _curve, _read, _shade
from rawaug.kernels.reference import Display, site_weights
from rawaug.kernels.runtime import move_together

_BLOCK = 256
_LONG_BLOCK = 2048
_ADAMS, _AHD = tl.constexpr(METHODS.index("adams")), tl.constexpr(METHODS.index("ahd"))
"""The numbers of the methods that choose directions; those before are stencils."""


def develop(raw: Tensor, display: Display, cfa: CFA | str, methods: Tensor) -> Tensor:
    """Develop mosaics ``(B, 1, H, W)`` to sRGB, as :func:`rawaug.kernels.cpu.develop` does, on a GPU."""
    raw = raw.detach().contiguous()
    batch, _, height, width = raw.shape
    red_row, red_column = CFA(cfa).sites[0]
    *parts, methods = move_together([*display, methods], raw.device)
    tensors = [part.contiguous() for part in parts]
    display = Display(*parts)

    pictures = raw.new_empty(batch, 2, 3, height, width)  # along rows, along columns
    leads = torch.empty_like(raw, dtype=torch.int8)
    srgb = raw.new_empty(batch, 3, height, width)
    demosaiced = (raw, methods, tensors[4], pictures, height, width, red_row, red_column)

    blocks = triton.cdiv(height * width, _BLOCK)
    with torch.cuda.device_of(raw):  # which need not be the current one
        _greens[blocks, batch](*demosaiced, BLOCK=_BLOCK)
        _colours[blocks, batch, 2](*demosaiced, BLOCK=_BLOCK)
        _leads[blocks, batch](methods, pictures, leads, height, width, BLOCK=_BLOCK)
        _srgb_pixels[blocks, batch](
            raw, methods, pictures, leads, _weights(CFA(cfa), raw.device), *tensors, srgb, height, width,
            NODES=max(display.table.shape[0], display.attention.shape[0]),
            ENTRIES=display.curves.shape[1] if display.curves.numel() else 0,
            ATTENDS=display.attention.numel() > 0, SHADES=display.shading.numel() > 0, BLOCK=_BLOCK,
        )  # fmt: skip
    return srgb


@lru_cache
def _weights(cfa: CFA, device: torch.device) -> Tensor:
    """The weights of the stencils on a device, to which they cross once."""
    return move_together([site_weights(cfa)], device)[0]


@triton.jit
def _mirror(k, size):  # type: ignore[no-untyped-def]
    """Reflect a row or column about the first and the last."""
    k = tl.abs(k)
    return tl.where(k >= size, 2 * size - 2 - k, k)


@triton.jit
def _at(plane, row, column, h, w, inside):  # type: ignore[no-untyped-def]
    """Read a plane, reflected about its border."""
    return tl.load(plane + _mirror(row, h) * w + _mirror(column, w), mask=inside, other=0)


@triton.jit
def _balanced(raw, gains, row, column, h, w, red_row, red_column, inside):  # type: ignore[no-untyped-def]
    """Read a mosaic under the gains of its sites, clipped at black."""
    row, column = _mirror(row, h), _mirror(column, w)
    colour = (row % 2 != red_row).to(tl.int32) + (column % 2 != red_column).to(tl.int32)
    value = tl.load(raw + row * w + column, mask=inside, other=0.0)
    return tl.maximum(value * tl.load(gains + colour), 0.0)


@triton.jit
def _greens(raw, methods, gains, pictures, h, w, red_row, red_column, BLOCK: tl.constexpr):  # type: ignore[no-untyped-def]
    """Estimate green along rows and along columns, or along that in which the mosaic changes less."""
    picture = tl.program_id(1).to(tl.int64)
    method = tl.load(methods + picture)
    if method >= _ADAMS:
        pixel = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
        inside = pixel < h * w
        i, j = pixel // w, pixel % w
        size = h.to(tl.int64) * w
        y, g = raw + picture * size, gains + picture * 4

        here = _balanced(y, g, i, j, h, w, red_row, red_column, inside)
        left = _balanced(y, g, i, j - 1, h, w, red_row, red_column, inside)
        right = _balanced(y, g, i, j + 1, h, w, red_row, red_column, inside)
        above = _balanced(y, g, i - 1, j, h, w, red_row, red_column, inside)
        below = _balanced(y, g, i + 1, j, h, w, red_row, red_column, inside)
        bend = 2.0 * here - _balanced(y, g, i, j - 2, h, w, red_row, red_column, inside)
        bend -= _balanced(y, g, i, j + 2, h, w, red_row, red_column, inside)
        bend_down = 2.0 * here - _balanced(y, g, i - 2, j, h, w, red_row, red_column, inside)
        bend_down -= _balanced(y, g, i + 2, j, h, w, red_row, red_column, inside)

        is_green = (i % 2 == red_row) != (j % 2 == red_column)
        along_row = tl.where(is_green, here, 0.5 * (left + right) + 0.25 * bend)
        along_column = tl.where(is_green, here, 0.5 * (above + below) + 0.25 * bend_down)
        if method == _ADAMS:
            change, change_down = tl.abs(left - right) + tl.abs(bend), tl.abs(above - below) + tl.abs(bend_down)
            chosen = tl.where(change > change_down, along_column, along_row)
            along_row = tl.where(change == change_down, 0.5 * (along_row + along_column), chosen)

        out = pictures + picture * 6 * size + size + pixel
        tl.store(out, along_row, mask=inside)
        tl.store(out + 3 * size, along_column, mask=inside)


@triton.jit
def _colours(raw, methods, gains, pictures, h, w, red_row, red_column, BLOCK: tl.constexpr):  # type: ignore[no-untyped-def]
    """Fill in red and blue: the differences to green are interpolated."""
    picture, direction = tl.program_id(1).to(tl.int64), tl.program_id(2)
    method = tl.load(methods + picture)
    if method >= _ADAMS:
        pixel = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
        inside = pixel < h * w
        i, j = pixel // w, pixel % w
        size = h.to(tl.int64) * w
        y, g = raw + picture * size, gains + picture * 4
        out = pictures + picture * 6 * size + direction * 3 * size
        green = tl.load(out + size + pixel, mask=inside, other=0.0)
        here = _balanced(y, g, i, j, h, w, red_row, red_column, inside)

        across = tl.zeros([BLOCK], tl.float32)
        down = tl.zeros([BLOCK], tl.float32)
        corners = tl.zeros([BLOCK], tl.float32)
        for di in tl.static_range(-1, 2):
            for dj in tl.static_range(-1, 2):
                if di != 0 or dj != 0:
                    value = _balanced(y, g, i + di, j + dj, h, w, red_row, red_column, inside)
                    value -= _at(out + size, i + di, j + dj, h, w, inside)
                    if di == 0:
                        across += value
                    elif dj == 0:
                        down += value
                    else:
                        corners += value

        # A row measures one of the two, at every second site; the rows above and below measure the other.
        in_red_row = i % 2 == red_row
        is_green = in_red_row != (j % 2 == red_column)
        near = tl.where(is_green, green + 0.5 * across, here)
        far = green + tl.where(is_green, 0.5 * down, 0.25 * corners)
        tl.store(out + pixel, tl.where(in_red_row, near, far), mask=inside)
        tl.store(out + 2 * size + pixel, tl.where(in_red_row, far, near), mask=inside)


@triton.jit
def _step(plane, size, i, j, di, dj, h, w, inside):  # type: ignore[no-untyped-def]
    """Square the steps of light and of colour from a pixel to another."""
    light = _at(plane + size, i, j, h, w, inside) - _at(plane + size, i + di, j + dj, h, w, inside)
    warm = _at(plane, i, j, h, w, inside) - _at(plane, i + di, j + dj, h, w, inside) - light
    cold = _at(plane + 2 * size, i, j, h, w, inside) - _at(plane + 2 * size, i + di, j + dj, h, w, inside) - light
    return light * light, warm * warm + cold * cold


@triton.jit
def _leads(methods, pictures, leads, h, w, BLOCK: tl.constexpr):  # type: ignore[no-untyped-def]
    """Count how many more of a site's four neighbours are like it in the first picture than in the second."""
    picture = tl.program_id(1).to(tl.int64)
    if tl.load(methods + picture) == _AHD:
        pixel = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
        inside = pixel < h * w
        i, j = pixel // w, pixel % w
        size = h.to(tl.int64) * w
        rows = pictures + picture * 6 * size
        columns = rows + 3 * size

        # The picture along rows is judged by its steps along rows, the one along columns by its steps along columns.
        left, left_colour = _step(rows, size, i, j, 0, -1, h, w, inside)
        right, right_colour = _step(rows, size, i, j, 0, 1, h, w, inside)
        above, above_colour = _step(columns, size, i, j, -1, 0, h, w, inside)
        below, below_colour = _step(columns, size, i, j, 1, 0, h, w, inside)
        light = tl.minimum(tl.maximum(left, right), tl.maximum(above, below))
        colour = tl.minimum(tl.maximum(left_colour, right_colour), tl.maximum(above_colour, below_colour))

        lead = _alike(left, left_colour, light, colour) + _alike(right, right_colour, light, colour)
        lead -= _alike(above, above_colour, light, colour) + _alike(below, below_colour, light, colour)
        for k in tl.static_range(-1, 2, 2):
            step, step_colour = _step(rows, size, i, j, k, 0, h, w, inside)
            lead += _alike(step, step_colour, light, colour)
            step, step_colour = _step(columns, size, i, j, 0, k, h, w, inside)
            lead -= _alike(step, step_colour, light, colour)
        tl.store(leads + picture * size + pixel, lead.to(tl.int8), mask=inside)


@triton.jit
def _alike(light, colour, light_limit, colour_limit):  # type: ignore[no-untyped-def]
    return ((light <= light_limit) & (colour <= colour_limit)).to(tl.int32)


@triton.jit
def _sum_of_stencil(weights, own, row, column, corners, far_row, far_column, c):  # type: ignore[no-untyped-def]
    """Weigh the six sums around a site to a colour."""
    at = weights + 6 * c
    near = tl.load(at) * own + tl.load(at + 1) * row + tl.load(at + 2) * column
    return near + tl.load(at + 3) * corners + tl.load(at + 4) * far_row + tl.load(at + 5) * far_column


@triton.jit
def _srgb_pixels(  # type: ignore[no-untyped-def]
    raw, methods, pictures, leads, weights, table, curves, attention, matrix, gains, frame, shading, srgb, h, w,
    NODES: tl.constexpr, ENTRIES: tl.constexpr, ATTENDS: tl.constexpr, SHADES: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Demosaic by a stencil, or pick from the pictures along rows and columns, and develop."""
    picture = tl.program_id(1).to(tl.int64)
    method = tl.load(methods + picture)
    pixel = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside = pixel < h * w
    i, j = pixel // w, pixel % w
    size = h.to(tl.int64) * w
    gain = gains + picture * 4
    red_gain, green_gain, blue_gain = tl.load(gain), tl.load(gain + 1), tl.load(gain + 2)

    if method < _ADAMS:
        y = raw + picture * size
        own = tl.load(y + pixel, mask=inside, other=0.0)
        row = _at(y, i, j - 1, h, w, inside) + _at(y, i, j + 1, h, w, inside)
        column = _at(y, i - 1, j, h, w, inside) + _at(y, i + 1, j, h, w, inside)
        corners = _at(y, i - 1, j - 1, h, w, inside) + _at(y, i - 1, j + 1, h, w, inside)
        corners += _at(y, i + 1, j - 1, h, w, inside) + _at(y, i + 1, j + 1, h, w, inside)
        far_row = _at(y, i, j - 2, h, w, inside) + _at(y, i, j + 2, h, w, inside)
        far_column = _at(y, i - 2, j, h, w, inside) + _at(y, i + 2, j, h, w, inside)

        site = weights + ((method * 2 + i % 2) * 2 + j % 2) * 18
        r = _sum_of_stencil(site, own, row, column, corners, far_row, far_column, 0)
        g = _sum_of_stencil(site, own, row, column, corners, far_row, far_column, 1)
        b = _sum_of_stencil(site, own, row, column, corners, far_row, far_column, 2)
    else:
        total = tl.full([BLOCK], 1, tl.int32)
        if method == _AHD:
            total = tl.zeros([BLOCK], tl.int32)
            for di in tl.static_range(-1, 2):
                for dj in tl.static_range(-1, 2):
                    total += _at(leads + picture * size, i + di, j + dj, h, w, inside).to(tl.int32)
        share = tl.where(total > 0, 0.0, tl.where(total < 0, 1.0, 0.5))  # of the picture along columns

        at = pictures + picture * 6 * size + pixel
        r = (1.0 - share) * tl.load(at, mask=inside, other=0.0)
        g = (1.0 - share) * tl.load(at + size, mask=inside, other=0.0)
        b = (1.0 - share) * tl.load(at + 2 * size, mask=inside, other=0.0)
        used = inside & (total <= 0)
        r = (r + share * tl.load(at + 3 * size, mask=used, other=0.0)) / red_gain
        g = (g + share * tl.load(at + 4 * size, mask=used, other=0.0)) / green_gain
        b = (b + share * tl.load(at + 5 * size, mask=used, other=0.0)) / blue_gain

    if SHADES:
        shade = _shade(frame + picture * 6, shading, i, j)
        r, g, b = r / shade, g / shade, b / shade
    if ATTENDS:
        factor = _attention(attention, r, g, b, NODES)
        r, g, b = r * factor, g * factor, b * factor

    white = tl.load(gain + 3)
    r, g, b = tl.minimum(r * red_gain, white), tl.minimum(g * green_gain, white), tl.minimum(b * blue_gain, white)
    rows = matrix + picture * 9
    red, green, blue = _root(rows, r, g, b), _root(rows + 3, r, g, b), _root(rows + 6, r, g, b)
    if ENTRIES:
        curve = curves + picture * ENTRIES
        red = _curve(curve, red * (ENTRIES - 1.0), ENTRIES)
        green = _curve(curve, green * (ENTRIES - 1.0), ENTRIES)
        blue = _curve(curve, blue * (ENTRIES - 1.0), ENTRIES)
    else:
        x, u = _axis(red * (NODES - 1.0), NODES)
        y_node, v = _axis(green * (NODES - 1.0), NODES)
        z, t = _axis(blue * (NODES - 1.0), NODES)
        node = table + ((z * NODES + y_node) * NODES + x) * 4
        red = tl.minimum(tl.maximum(_read(node, 0, u, v, t, NODES), 0.0), 1.0)
        green = tl.minimum(tl.maximum(_read(node, 1, u, v, t, NODES), 0.0), 1.0)
        blue = tl.minimum(tl.maximum(_read(node, 2, u, v, t, NODES), 0.0), 1.0)

    out = srgb + picture * 3 * size + pixel
    tl.store(out, red, mask=inside)
    tl.store(out + size, green, mask=inside)
    tl.store(out + 2 * size, blue, mask=inside)


@triton.jit
def _root(row, r, g, b):  # type: ignore[no-untyped-def]
    """Compute the root of a channel of x2, held to [0, 1]; the table is over these roots."""
    x2 = tl.load(row) * r + tl.load(row + 1) * g + tl.load(row + 2) * b
    return tl.sqrt(tl.minimum(tl.maximum(x2, 1e-12), 1.0))


def smooth(planes: Tensor, taps: Tensor) -> Tensor:
    """Filter each picture of ``(B, N, H, W)`` with its taps ``(B, K)``, as :func:`rawaug.kernels.cpu.smooth` does."""
    planes = planes.contiguous()
    batch, count, height, width = planes.shape
    (taps,) = move_together([taps.float().contiguous()], planes.device)
    down, out = torch.empty_like(planes), torch.empty_like(planes)

    grid = (triton.cdiv(height * width, _BLOCK), batch * count)
    with torch.cuda.device_of(planes):
        for source, target, is_down in ((planes, down, True), (down, out, False)):
            _smooth_lines[grid](source, taps, target, count, height, width, taps.shape[1], DOWN=is_down, BLOCK=_BLOCK)
    return out


@triton.jit
def _smooth_lines(source, taps, out, count, h, w, reach, DOWN: tl.constexpr, BLOCK: tl.constexpr):  # type: ignore[no-untyped-def]
    """Filter along columns or rows; the first of the taps is the middle one."""
    plane = tl.program_id(1).to(tl.int64)
    pixel = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside = pixel < h * w
    i, j = pixel // w, pixel % w
    x, tap = source + plane * h * w, taps + plane // count * reach

    total = tl.load(tap) * tl.load(x + pixel, mask=inside, other=0.0)
    for k in range(1, reach):
        if DOWN:
            before, after = tl.maximum(i - k, 0) * w + j, tl.minimum(i + k, h - 1) * w + j
        else:
            before, after = i * w + tl.maximum(j - k, 0), i * w + tl.minimum(j + k, w - 1)
        both = tl.load(x + before, mask=inside, other=0.0) + tl.load(x + after, mask=inside, other=0.0)
        total += tl.load(tap + k) * both
    tl.store(out + plane * h * w + pixel, total, mask=inside)


def mean_square(pairs: Tensor) -> Tensor:
    """Mean squared difference ``(B,)`` of two planes ``(B, 2, H, W)``, with the same bits in a batch of any size."""
    pairs = pairs.contiguous()
    batch, _, height, width = pairs.shape
    means = pairs.new_empty(batch)
    with torch.cuda.device_of(pairs):
        _mean_squares[(batch,)](pairs, means, height * width, BLOCK=_LONG_BLOCK)
    return means


@triton.jit
def _mean_squares(pairs, means, size, BLOCK: tl.constexpr):  # type: ignore[no-untyped-def]
    picture = tl.program_id(0).to(tl.int64)
    at = pairs + picture * 2 * size + tl.arange(0, BLOCK)
    total = tl.zeros([BLOCK], tl.float32)
    for start in range(0, size, BLOCK):
        inside = start + tl.arange(0, BLOCK) < size
        step = tl.load(at + start, mask=inside, other=0.0) - tl.load(at + start + size, mask=inside, other=0.0)
        total += step * step
    tl.store(means + picture, tl.sum(total) / size)
