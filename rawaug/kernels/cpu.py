"""The passes of :mod:`rawaug.kernels.reference` as loops for the CPU, compiled by Numba.

A row is processed in tiles that fit the fastest cache. Each step is a separate loop, which the compiler turns into
vector instructions, except for those of :mod:`rawaug.kernels.vectors`. The exponential is a minimax polynomial.
"""

from __future__ import annotations

from functools import cache, lru_cache

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from rawaug.bayer import CFA, METHODS, STENCILS
from rawaug.kernels.planes import demosaic_balanced
from rawaug.kernels.planes import demosaic_directional as demosaic_directional
from rawaug.kernels.planes import smooth as smooth
from rawaug.kernels.reference import Display, Unprocessing, site_weights
from rawaug.kernels.runtime import compile_loop, compile_part, run_over_rows
from rawaug.kernels.shot_read import shot_read as shot_read
from rawaug.kernels.vectors import at_least, at_most, blur_plane, clip, interpolate, take_codes

_TILE = 256
"""A tile has this many cells of RAW."""

_LINE = _TILE + 16
"""A line of every second pixel has this many places: those of a tile, and a margin."""

_ZERO, _ONE, _FAR = np.float32(0), np.float32(1), np.float32(np.inf)
_LEAST = np.float32(-125)
"""A mask counts as 0 at this exponent; below it, floats would become denormal."""

_EVERY_SECOND = torch.tensor([1.0, 1.0, 1.0, 1.0, 0.5, 0.5])
"""The mask is computed at every second pixel of a row; with these factors to a frame, at every one."""

_EXP2 = tuple(map(np.float32, (1.8775839e-3, 8.9893471e-3, 0.055826288, 0.24015364, 0.69315308, 0.99999994)))
"""This approximates 2^f on [0, 1], within 7.5e-8, relative."""


def unprocess(srgb: Tensor, camera: Unprocessing, white: float) -> Tensor:
    """Convert sRGB ``(B, 3, H, W)``, uint8 or float32 on the CPU, to RAW ``(B, 4, H/2, W/2)`` up to ``white``."""
    batch, _, height, width = srgb.shape
    raw = torch.empty(batch, 4, height // 2, width // 2, dtype=torch.float32)
    if not raw.numel():
        return raw

    entries = camera.curves.shape[1] if camera.curves.numel() else len(camera.table)
    in_bytes = srgb.dtype == torch.uint8
    largest_code = 255.0 if in_bytes else 1.0
    scale = np.float32((entries - 1) / largest_code)

    codes, pieces, curves = None, None, _present(camera.curves)
    colour = camera.colour.detach().contiguous().numpy()
    if in_bytes and entries == 256 and curves is not None:
        codes, curves = curves, None
        pieces = np.ascontiguousarray(codes.view(np.uint8).reshape(batch, 256, 4).swapaxes(1, 2)).reshape(batch, 1024)
    settings = (
        srgb.detach().contiguous().numpy(),
        scale,
        _present(camera.table),
        codes,
        pieces,
        curves,
        _present(camera.attention),
        colour,
        np.float32(camera.knee) if colour[:, 5].any() else None,  # else no gain spares highlights
        _present(camera.frame),
        _present(camera.shading),
        _as_array(camera.sites),
        _present(camera.taps),
        np.float32(white),
        raw.numpy(),
    )

    # Six rows of light of each tile are kept, with a cell more on either side, for the blur. They are as long as whole
    # vectors of 16, and have one more that is read ahead.
    cells = width // 2
    kept = (-(-cells // _TILE), 6, 2, 3, -(-min(cells, _TILE) // 16) * 16 + 16)

    def convert(start: int, stop: int) -> None:
        scratch = (
            np.empty(2 * _LINE, np.int32),
            np.empty((3, 2 * _LINE), np.float32),
            np.empty((2, 2, 3, _TILE), np.float32),
            np.empty((2, 3, _TILE), np.float32),
            np.empty((3, _TILE), np.float32),
            np.ones(_TILE, np.float32),
            np.zeros(kept, np.float32),
        )
        _raw_rows(*settings, *scratch, start, stop)

    run_over_rows(batch * height // 2, 2 * width, convert)
    return raw


@cache
def _as_array(sites: tuple[tuple[int, int, int], ...]) -> np.ndarray:
    return np.array(sites)


def _present(part: Tensor) -> np.ndarray | None:
    """Return a part of the settings as an array, or None if it is empty, so that no code is compiled for it."""
    if not part.numel():
        return None
    return part.detach().contiguous().numpy()


def render(linear: Tensor, display: Display) -> Tensor:
    """Develop camera colour x5 ``(B, 3, H, W)``, float32 on the CPU, to sRGB in [0, 1]."""
    mosaics, srgb = linear.new_empty(0, 1, 1, 1), torch.empty(linear.shape)
    _render_rows(linear, mosaics, np.full(len(linear), -1), np.arange(len(linear)), CFA.RGGB, display, srgb)
    return srgb


def develop(raw: Tensor, display: Display, cfa: CFA | str, methods: Tensor) -> Tensor:
    """Develop mosaics to sRGB.

    Args:
        raw: ``(B, 1, H, W)``, float32 on the CPU.
        display: the way from camera colour to sRGB.
        cfa: pattern of the mosaics.
        methods: ``(B,)``, the numbers of their demosaicings in :data:`rawaug.bayer.METHODS`.

    Returns:
        sRGB ``(B, 3, H, W)`` in [0, 1].
    """
    raw, numbers = raw.detach(), methods.numpy()
    by_stencil = numbers < len(STENCILS)
    demosaiced = raw if by_stencil.all() else raw[by_stencil]
    mosaics = F.pad(demosaiced, (2, 2, 2, 2), mode="reflect")  # about the border sites, so the pattern stays

    srgb = torch.empty(len(raw), 3, *raw.shape[2:])  # camera colour is developed where it is
    for picture in np.flatnonzero(~by_stencil):
        homogeneous, gains = METHODS[numbers[picture]] == "ahd", display.gains[picture, :3].numpy()
        demosaic_balanced(raw[picture, 0].numpy(), gains, True, CFA(cfa), homogeneous, srgb[picture].numpy())

    places = np.where(by_stencil, np.cumsum(by_stencil) - 1, np.arange(len(raw)))
    _render_rows(srgb, mosaics, np.where(by_stencil, numbers, -1), places, CFA(cfa), display, srgb)
    return srgb


def _render_rows(
    linear: Tensor,
    mosaics: Tensor,
    stencils: np.ndarray,
    places: np.ndarray,
    cfa: CFA,
    display: Display,
    srgb: Tensor,
) -> None:
    """Develop pictures of camera colour and padded mosaics to ``srgb``.

    ``stencils`` ``(B,)`` are the numbers of the mosaics' stencils, -1 for camera colour, and ``places`` ``(B,)`` where
    each picture is among its like.
    """
    height, width = srgb.shape[-2:]
    if not srgb.numel():
        return

    display = display._replace(frame=display.frame * _EVERY_SECOND.to(display.frame))
    sources = linear.detach().contiguous().numpy(), mosaics.numpy(), _site_weights(cfa), stencils, places
    settings = *sources, *map(_present, display), srgb.numpy()

    def convert(start: int, stop: int) -> None:
        scratch = (
            np.empty(_TILE, np.int32),
            np.empty((3, _TILE), np.float32),
            np.empty((3, _TILE), np.float32),
            np.empty((3, _TILE), np.float32),
            np.ones(_TILE, np.float32),
            np.empty((8, _TILE), np.float32),
            np.empty((2, 3, _TILE), np.float32),
        )
        _srgb_rows(*settings, *scratch, start, stop)

    run_over_rows(len(places) * height, 3 * width, convert)


@lru_cache
def _site_weights(cfa: CFA) -> np.ndarray:
    """Lay out the weights of :func:`_demosaic`'s six sums by stencil, row of the cell, colour and site.

    Shape ``(2, 2, 3, 6, _TILE)``.
    """
    return site_weights(cfa).permute(0, 1, 3, 4, 2).repeat(1, 1, 1, 1, _TILE // 2).contiguous().numpy()


@compile_part
def _cell_of(value, scale, last):  # type: ignore[no-untyped-def]
    """Find the node below a value, at most ``last``, and the share of the way to the next; values are clamped."""
    # NaN goes to node 0: an index must never be out of bounds.
    x = at_least(np.float32(value) * scale, _ZERO)
    x = at_most(x, np.float32(last + 1))
    node = at_most(np.int32(x), last)
    return node, x - np.float32(node)


@compile_part
def _look_up(red, green, blue, scale, table, nodes, shares, halves, first, out):  # type: ignore[no-untyped-def]
    """Look up the table ``(N, N, N, 4)`` at colours ``(n,)``, and write to ``out`` ``(2, 3, width)`` from ``first`` on.

    With ``halves`` = 1, even and odd sites go to separate halves of ``out``; with 0, all go to its first half.
    """
    size = np.int32(len(table))
    last = np.int32(size - 2)
    for j in range(len(red)):
        r, u = _cell_of(red[j], scale, last)
        g, v = _cell_of(green[j], scale, last)
        b, w = _cell_of(blue[j], scale, last)
        nodes[j] = np.int32(4) * (r + size * (g + size * b))
        shares[0, j], shares[1, j], shares[2, j] = u, v, w

    flat_table, flat_out = table.reshape(-1), out.reshape(-1)
    row, layer, plane = np.int64(4) * size, np.int64(4) * size * size, out.shape[2]
    for j in range(len(red)):
        at = first + (j >> halves) + (j & halves) * (3 * plane)
        u, v, w = shares[0, j], shares[1, j], shares[2, j]
        interpolate(flat_table, np.int64(nodes[j]), row, layer, u, v, w, flat_out, at, plane)


@compile_part
def _through_curve(plane, scale, curve, nodes, shares, out):  # type: ignore[no-untyped-def]
    """Look up a curve ``(T,)`` at one channel of a row: even sites go to ``out[0]``, odd ones to ``out[1]``."""
    last, share = np.int32(len(curve) - 2), shares[0]
    for j in range(len(plane)):
        nodes[j], share[j] = _cell_of(plane[j], scale, last)

    even, odd = out[0], out[1]
    for j in range(len(plane) // 2):
        a, b = np.uint32(nodes[2 * j]), np.uint32(nodes[2 * j + 1])  # unsigned, as else negative ones are checked for
        even[j] = curve[a] + (curve[a + np.uint32(1)] - curve[a]) * share[2 * j]
        odd[j] = curve[b] + (curve[b + np.uint32(1)] - curve[b]) * share[2 * j + 1]


@compile_part
def _of_codes(plane, curve, pieces, out):  # type: ignore[no-untyped-def]
    """Look up a curve that has an entry for each byte, as :func:`_through_curve` does; ``pieces`` are its bytes."""
    even, odd = out[0], out[1]
    for j in range(take_codes(plane, pieces, even, odd), len(plane) // 2):
        even[j], odd[j] = curve[plane[2 * j]], curve[plane[2 * j + 1]]


@compile_part
def _fall_off(frame, row, first, shading, out):  # type: ignore[no-untyped-def]
    """Compute the mask at every second pixel of a row from ``first`` on."""
    # 2^exponent is a polynomial for the fraction, and the bits of a float for the whole part.
    y = frame[0] + np.float32(row) * frame[2] + np.float32(first) * frame[4]
    x = frame[1] + np.float32(row) * frame[3] + np.float32(first) * frame[5]
    dy, dx = np.float32(2) * frame[4], np.float32(2) * frame[5]
    a, b, c = shading[0], shading[1], shading[2]

    for j in range(len(out)):
        v, u = y + np.float32(j) * dy, x + np.float32(j) * dx
        exponent = at_least(-(a * v * v + (b * v + c * u) * u), _LEAST)
        whole = np.int32(exponent) - np.int32(1)
        rest = exponent - np.float32(whole)
        p = _EXP2[0]
        for k in range(1, len(_EXP2)):
            p = p * rest + _EXP2[k]
        out[j] = p * np.int32((whole + np.int32(127)) << np.int32(23)).view(np.float32)


@compile_part
def _develop(x2, colour, channel, knee, mask, white, out):  # type: ignore[no-untyped-def]
    """Compute one channel of x4 times the mask from x2 ``(3, n)``; without a knee, highlights have all of the gain."""
    c0, c1, c2 = colour[channel, 0], colour[channel, 1], colour[channel, 2]
    if knee is None:
        gain = colour[4, channel]
        for j in range(len(out)):
            y = c0 * x2[0, j] + c1 * x2[1, j] + c2 * x2[2, j]
            out[j] = clip(y * (gain * mask[j]), white)
        return

    m0, m1, m2 = colour[3, 0], colour[3, 1], colour[3, 2]
    floor, rise = colour[4, channel], colour[5, channel]
    slope = _ONE / (_ONE - knee)

    for j in range(len(out)):
        red, green, blue = x2[0, j], x2[1, j], x2[2, j]
        m = at_least((m0 * red + m1 * green + m2 * blue - knee) * slope, _ZERO)
        m = at_most(m, _ONE)

        y = c0 * red + c1 * green + c2 * blue
        y *= (floor + rise * (m * m)) * mask[j]
        out[j] = clip(y, white)


@compile_part
def _attend(x4, channel, table, nodes, shares, attention, white, out):  # type: ignore[no-untyped-def]
    """Multiply one channel of x4 ``(3, n)`` by the attention, which depends on all three."""
    count, scale = len(out), np.float32(len(table) - 1)
    _look_up(x4[0, :count], x4[1, :count], x4[2, :count], scale, table, nodes, shares, 0, 0, attention)

    for j in range(count):
        out[j] = clip(x4[channel, j] * attention[0, 0, j], white)


@compile_part
def _light(srgb, b, i, pixels, scale, table, codes, pieces, curves, nodes, shares, first, out):  # type: ignore[no-untyped-def]
    """Look up linear light of some pixels of a row: even ones go to ``out[0]``, odd ones to ``out[1]``."""
    if table is not None:
        red, green, blue = srgb[b, 0, i, pixels], srgb[b, 1, i, pixels], srgb[b, 2, i, pixels]
        _look_up(red, green, blue, scale, table, nodes, shares, 1, first, out)
    if codes is not None:
        for c in range(3):
            _of_codes(srgb[b, c, i, pixels], codes[b], pieces[b], out[:, c, first:])
    if curves is not None:
        for c in range(3):
            _through_curve(srgb[b, c, i, pixels], scale, curves[b], nodes, shares, out[:, c, first:])


@compile_part
def _blur(lines, i, end, taps, n, x2):  # type: ignore[no-untyped-def]
    """Blur n cells of rows i and i + 1; ``lines`` hold the six rows about them, and ``end`` is the last row."""
    width = lines.shape[3]
    size, step = np.int64(6 * width), np.int64(3 * _TILE)
    above, over, upper = max(i - 2, 0) % 6 * size, max(i - 1, 0) % 6 * size, i % 6 * size
    lower, under, below = (i + 1) % 6 * size, min(i + 2, end) % 6 * size, min(i + 3, end) % 6 * size

    for channel in range(3):
        at = np.int64(channel * width)
        blur_plane(
            lines, above + at, over + at, upper + at, lower + at, under + at, below + at, np.int64(3 * width),
            taps[0], taps[1], taps[2], x2, np.int64(channel * _TILE), step, np.int64((n + 15) // 16),
        )  # fmt: skip


@compile_loop
def _raw_rows(  # type: ignore[no-untyped-def]
    srgb, scale, table, codes, pieces, curves, attention, colour, knee, frame, shading, sites, taps, white, raw,
    nodes, shares, x2, attended, x4, mask, lines, start, stop,
):  # fmt: skip
    """Convert rows ``start`` to ``stop`` of all pictures' rows of cells, counted through the batch."""
    height, width = raw.shape[2], raw.shape[3]
    tiles = len(lines)
    latest = -1

    for row in range(start, stop):
        b, k = divmod(row, height)
        if k == 0 or row == start:
            latest = max(2 * k - 2, 0) - 1

        for tile in range(tiles):
            first, last = tile * _TILE, min(tile * _TILE + _TILE, width)
            n = last - first

            if taps is None:
                for i in range(2):
                    pixels = slice(2 * first, 2 * last)
                    _light(srgb, b, 2 * k + i, pixels, scale, table, codes, pieces, curves, nodes, shares, 0, x2[i])
            else:
                left, right = max(first - 1, 0), min(last + 1, width)
                for i in range(latest + 1, min(2 * k + 4, 2 * height)):
                    line, pixels = lines[tile, i % 6], slice(2 * left, 2 * right)
                    place = left - first + 1
                    _light(srgb, b, i, pixels, scale, table, codes, pieces, curves, nodes, shares, place, line)
                    for c in range(3):  # the picture's edge is repeated outwards
                        if first == 0:
                            line[0, c, 0] = line[1, c, 0] = line[0, c, 1]
                        if last == width:
                            line[0, c, n + 1] = line[1, c, n + 1] = line[1, c, n]
                _blur(lines[tile], 2 * k, 2 * height - 1, taps[b], n, x2)

            for s in range(len(sites)):
                i, column, channel = sites[s, 0], sites[s, 1], sites[s, 2]
                out = raw[b, s, k, first:last]
                if shading is not None:
                    _fall_off(frame[b], 2 * k + i, 2 * first + column, shading, mask[:n])
                if attention is not None:
                    for c in range(len(x4)):
                        _develop(x2[i, column], colour[b], c, knee, mask, _FAR, x4[c, :n])
                    _attend(x4, channel, attention, nodes, shares, attended, white, out)
                else:
                    _develop(x2[i, column], colour[b], channel, knee, mask, white, out)
        latest = 2 * k + 3


@compile_part
def _pairs(one, other, out):  # type: ignore[no-untyped-def]
    """Add two rows."""
    for j in range(len(out)):
        out[j] = one[j] + other[j]


@compile_part
def _demosaic(mosaic, row, first, n, weights, sums, out):  # type: ignore[no-untyped-def]
    """Demosaic n sites of a row from ``first`` on to colours ``(3, ...)``; the mosaic has margins of 2.

    Stencils are symmetric: with the weights of its site, a colour is the sum of the site's own value, of the values of
    its neighbours along the row, the column and the diagonals, and of those two sites away along row and column.
    """
    above, own, below = mosaic[row + 1, first:], mosaic[row + 2, first:], mosaic[row + 3, first:]
    _pairs(own[1:], own[3:], sums[1, :n])
    _pairs(above[2:], below[2:], sums[2, :n])
    _pairs(above[1:], above[3:], sums[6, :n])
    _pairs(below[1:], below[3:], sums[7, :n])
    _pairs(sums[6], sums[7], sums[3, :n])
    _pairs(own, own[4:], sums[4, :n])
    _pairs(mosaic[row, first + 2 :], mosaic[row + 4, first + 2 :], sums[5, :n])

    for c in range(3):
        _add_weighted(weights[c, 0], own[2:], weights[c, 1], sums[1], False, out[c, :n])
        for k in (2, 4):
            _add_weighted(weights[c, k], sums[k], weights[c, k + 1], sums[k + 1], True, out[c, :n])


@compile_part
def _add_weighted(a, x, b, y, more, out):  # type: ignore[no-untyped-def]
    """Write a x + b y to ``out``; with ``more``, add it to what is there."""
    for j in range(len(out)):
        out[j] = (out[j] if more else _ZERO) + (a[j] * x[j] + b[j] * y[j])


@compile_part
def _root(x, c0, c1, c2, out):  # type: ignore[no-untyped-def]
    """Compute the root of one channel of x2, held to [0, 1], from x3 ``(3, n)``."""
    for j in range(len(out)):
        y = at_least(c0 * x[0, j] + c1 * x[1, j] + c2 * x[2, j], _ZERO)
        out[j] = np.sqrt(at_most(y, _ONE))


@compile_part
def _at_curve(root, curve, nodes, shares, out):  # type: ignore[no-untyped-def]
    """Look up a curve ``(T,)`` at one channel of a row, which is in [0, 1]."""
    last = np.int32(len(curve) - 2)
    scale = np.float32(len(curve) - 1)
    for j in range(len(out)):
        nodes[j], shares[j] = _cell_of(root[j], scale, last)

    for j in range(len(out)):
        a = np.uint32(nodes[j])
        out[j] = curve[a] + (curve[a + np.uint32(1)] - curve[a]) * shares[j]


@compile_loop
def _srgb_rows(  # type: ignore[no-untyped-def]
    linear, mosaics, weights, stencils, places, table, curves, attention, matrix, gains, frame, shading, srgb,
    nodes, shares, x, root, mask, sums, looked_up, start, stop,
):  # fmt: skip
    """Develop rows ``start`` to ``stop`` of all pictures' rows, of camera colour or of mosaics."""
    height, width = srgb.shape[2], srgb.shape[3]

    for row in range(start, stop):
        b, i = divmod(row, height)
        place = places[b]
        for first in range(0, width, _TILE):
            last = min(first + _TILE, width)
            n = last - first

            if stencils[b] < 0:
                for c in range(3):
                    for j in range(n):  # faster than slices
                        x[c, j] = linear[place, c, i, first + j]
            else:
                _demosaic(mosaics[place, 0], i, first, n, weights[stencils[b], i % 2], sums, x)

            if shading is not None:
                _fall_off(frame[b], i, 2 * first, shading, mask[:n])
                for c in range(3):
                    for j in range(n):
                        x[c, j] /= mask[j]
            if attention is not None:
                scale = np.float32(len(attention) - 1)
                _look_up(x[0, :n], x[1, :n], x[2, :n], scale, attention, nodes, shares, 0, 0, looked_up)
                for c in range(3):
                    for j in range(n):
                        x[c, j] *= looked_up[0, 0, j]

            white = gains[b, 3]
            for c in range(3):
                gain = gains[b, c]
                for j in range(n):
                    x[c, j] = at_most(x[c, j] * gain, white)

            for c in range(3):
                _root(x, matrix[b, c, 0], matrix[b, c, 1], matrix[b, c, 2], root[c, :n])

            if curves is not None:
                for c in range(3):
                    _at_curve(root[c, :n], curves[b], nodes, shares[0], srgb[b, c, i, first:last])
            if table is not None:
                scale = np.float32(len(table) - 1)
                _look_up(root[0, :n], root[1, :n], root[2, :n], scale, table, nodes, shares, 0, 0, looked_up)
                for c in range(3):
                    for j in range(n):
                        y = at_least(looked_up[0, c, j], _ZERO)
                        srgb[b, c, i, first + j] = at_most(y, _ONE)
