"""The reverse pass of :mod:`rawaug.kernels.raw_torch` in one pass over the picture, compiled; and thumbnails.

A row is worked on in pieces that fit the fastest cache, each step a loop of its own that the compiler turns into vector
instructions. :func:`_interpolate` spells these out for the table, four colours of two neighbouring nodes at a time,
which no compiler finds by itself.
"""

from __future__ import annotations

import numpy as np
import torch
from llvmlite import ir
from numba import types
from numba.core.typing.templates import Signature
from numba.extending import intrinsic
from numba.np.arrayobj import make_array
from torch import Tensor

from rawaug.kernels.compiled import compiled, over_rows, part
from rawaug.kernels.raw_torch import Camera

_TILE = 256
"""Cells that are worked on at a time."""

_ZERO, _ONE, _FAR = np.float32(0), np.float32(1), np.float32(np.inf)
_LEAST = np.float32(-125)
"""Exponent at which a mask counts as 0."""

# 2^f within 7.5e-8 on [0, 1], least greatest relative error, in falling powers.
_EXP2 = tuple(np.float32(c) for c in (1.8775839e-3, 8.9893471e-3, 0.055826288, 0.24015364, 0.69315308, 0.99999994))


def unprocess(srgb: Tensor, camera: Camera, white: float) -> Tensor:
    """sRGB ``(B, 3, H, W)``, uint8 or float32 on the CPU, to packed RAW ``(B, 4, H/2, W/2)``, at most ``white``."""
    batch, _, height, width = srgb.shape
    raw = torch.empty(batch, 4, height // 2, width // 2, dtype=torch.float32)
    if not raw.numel():
        return raw
    picture, out = srgb.detach().contiguous().numpy(), raw.numpy()
    entries = camera.curves.shape[1] if camera.curves.numel() else len(camera.table)
    in_bytes = srgb.dtype == torch.uint8
    scale = np.float32((entries - 1) / (255.0 if in_bytes else 1.0))
    # Absent parts are None, so that no code is compiled for them.
    table, curves, attention, colour, frame, shading, sites = (
        value.contiguous().numpy() if value.numel() else None for value in camera if isinstance(value, Tensor)
    )
    codes, curves = (curves, None) if in_bytes and entries == 256 else (None, curves)
    knee, ceiling = np.float32(camera.knee), np.float32(white)

    def run(start: int, stop: int) -> None:
        _rows(
            picture,
            scale,
            table,
            codes,
            curves,
            attention,
            colour,
            knee,
            frame,
            shading,
            sites,
            ceiling,
            out,
            start,
            stop,
        )

    over_rows(batch * height, width, run)
    return raw


def thumbnails(srgb: Tensor, table: Tensor, height: int, width: int) -> Tensor:
    """uint8 ``(B, 3, H, W)`` on the CPU, averaged to ``(B, 3, height, width)`` and looked up in the table: x2."""
    x2 = torch.empty(len(srgb), 3, height, width, dtype=torch.float32)
    picture, nodes, out = srgb.detach().contiguous().numpy(), table.contiguous().numpy(), x2.numpy()
    rows, columns = _windows(srgb.shape[2], height), _windows(srgb.shape[3], width)

    def run(start: int, stop: int) -> None:
        _small_rows(picture, rows, columns, nodes, out, start, stop)

    over_rows(len(srgb) * height, srgb[0].numel() // height, run)
    return x2


def _windows(size: int, count: int) -> np.ndarray:
    """``(count, 2)`` start and stop of the pixels of a mean, as adaptive average pooling has them: they may overlap."""
    k = np.arange(count)
    return np.stack([k * size // count, -(-(k + 1) * size // count)], axis=1)


@intrinsic
def _interpolate(context, table, node, row, layer, u, v, w, out, at, plane):  # type: ignore[no-untyped-def]
    """Mix eight nodes of ``table``, to ``out[at]``, ``out[at + plane]`` and ``out[at + 2 plane]``, all flat float32.

    ``node`` is the place of the first; a node is 4 numbers, the next along v ``row`` and along w ``layer`` ahead.
    """
    signature = types.void(table, node, row, layer, u, v, w, out, at, plane)
    return signature, _interpolation


def _interpolation(context, build, signature: Signature, values):  # type: ignore[no-untyped-def]
    """Machine code of :func:`_interpolate`: two nodes along u are one vector of 8, mixed along w, then v, then u."""
    table, node, row, layer, u, v, w, out, at, plane = values
    number, index = ir.FloatType(), ir.IntType(32)
    wide, narrow = ir.VectorType(number, 8), ir.VectorType(number, 4)

    def pick(vector, lanes):  # type: ignore[no-untyped-def]
        nothing = ir.Constant(vector.type, ir.Undefined)
        return build.shuffle_vector(vector, nothing, ir.Constant(ir.VectorType(index, len(lanes)), lanes))

    def spread(scalar, lanes):  # type: ignore[no-untyped-def]
        vector = build.insert_element(ir.Constant(narrow, ir.Undefined), scalar, ir.Constant(index, 0))
        return pick(vector, [0] * lanes)

    def address(array, kind, offset):  # type: ignore[no-untyped-def]
        return build.gep(make_array(kind)(context, build, array).data, [offset])

    def load(offset):  # type: ignore[no-untyped-def]
        return build.load(build.bitcast(address(table, signature.args[0], offset), wide.as_pointer()), align=4)

    def mix(a, b, t):  # type: ignore[no-untyped-def]
        flags = ("contract",)
        return build.fadd(a, build.fmul(build.fsub(b, a, flags=flags), t, flags=flags), flags=flags)

    below, above = (mix(load(n), load(build.add(n, layer)), spread(w, 8)) for n in (node, build.add(node, row)))
    pair = mix(below, above, spread(v, 8))
    mixed = mix(pick(pair, [0, 1, 2, 3]), pick(pair, [4, 5, 6, 7]), spread(u, 4))
    for lane in range(3):
        build.store(build.extract_element(mixed, ir.Constant(index, lane)), address(out, signature.args[7], at))
        at = build.add(at, plane)
    return context.get_dummy_value()


@part
def _cell_of(value, scale, last):  # type: ignore[no-untyped-def]
    """The node below a value, at most ``last``, and the share of the way to the next; values are clamped."""
    x = np.float32(value) * scale
    x = x if x > _ZERO else _ZERO
    top = np.float32(last + 1)
    x = x if x < top else top
    node = np.int32(x)
    node = node if node < last else last
    return node, x - np.float32(node)


@part
def _look_up(red, green, blue, scale, table, nodes, shares, halves, out):  # type: ignore[no-untyped-def]
    """Values of the table ``(N, N, N, 4)`` at colours ``(n,)``, to ``out`` ``(2, 3, _TILE)``.

    With ``halves`` = 1 even and odd sites go apart, to the two halves of ``out``; with 0 all go to its first half.
    """
    size = np.int32(len(table))
    last = np.int32(size - 2)
    for j in range(len(red)):
        r, u = _cell_of(red[j], scale, last)
        g, v = _cell_of(green[j], scale, last)
        b, w = _cell_of(blue[j], scale, last)
        nodes[j] = np.int32(4) * (r + size * (g + size * b))
        shares[0, j], shares[1, j], shares[2, j] = u, v, w
    flat, found = table.reshape(-1), out.reshape(-1)
    row, layer = np.int64(4) * size, np.int64(4) * size * size
    for j in range(len(red)):
        at = (j >> halves) + (j & halves) * (3 * _TILE)
        u, v, w = shares[0, j], shares[1, j], shares[2, j]
        _interpolate(flat, np.int64(nodes[j]), row, layer, u, v, w, found, at, np.int64(_TILE))


@part
def _through_curve(plane, scale, curve, nodes, shares, out):  # type: ignore[no-untyped-def]
    """Values of a curve ``(T,)`` at one channel of a row: even sites to ``out`` ``(2, n)`` [0], odd ones to [1]."""
    last, share = np.int32(len(curve) - 2), shares[0]
    for j in range(len(plane)):
        nodes[j], share[j] = _cell_of(plane[j], scale, last)
    even, odd = out[0], out[1]
    for j in range(len(plane) // 2):
        a, b = np.uint32(nodes[2 * j]), np.uint32(nodes[2 * j + 1])  # unsigned, or negative ones are looked for
        even[j] = curve[a] + (curve[a + np.uint32(1)] - curve[a]) * share[2 * j]
        odd[j] = curve[b] + (curve[b + np.uint32(1)] - curve[b]) * share[2 * j + 1]


@part
def _of_codes(plane, curve, out):  # type: ignore[no-untyped-def]
    """:func:`_through_curve` of bytes, for which the curve has an entry each."""
    even, odd = out[0], out[1]
    for j in range(len(plane) // 2):
        even[j], odd[j] = curve[plane[2 * j]], curve[plane[2 * j + 1]]


@part
def _fall_off(frame, row, first, shading, out):  # type: ignore[no-untyped-def]
    """The mask at every second pixel of a row from ``first`` on.

    2^f is a polynomial, the whole exponent goes to a float's bits.
    """
    y = frame[0] + np.float32(row) * frame[2] + np.float32(first) * frame[4]
    x = frame[1] + np.float32(row) * frame[3] + np.float32(first) * frame[5]
    dy, dx = np.float32(2) * frame[4], np.float32(2) * frame[5]
    a, b, c = shading[0], shading[1], shading[2]
    for j in range(len(out)):
        v, u = y + np.float32(j) * dy, x + np.float32(j) * dx
        exponent = -(a * v * v + (b * v + c * u) * u)
        exponent = exponent if exponent > _LEAST else _LEAST
        whole = np.int32(exponent) - np.int32(1)
        rest = exponent - np.float32(whole)
        p = _EXP2[0]
        for k in range(1, len(_EXP2)):
            p = p * rest + _EXP2[k]
        out[j] = p * np.int32((whole + np.int32(127)) << np.int32(23)).view(np.float32)


@part
def _develop(x2, colour, channel, knee, mask, white, out):  # type: ignore[no-untyped-def]
    """One channel of x4 times the mask, of x2 ``(3, n)``."""
    c0, c1, c2 = colour[channel, 0], colour[channel, 1], colour[channel, 2]
    m0, m1, m2 = colour[3, 0], colour[3, 1], colour[3, 2]
    floor, rise = colour[4, channel], colour[5, channel]
    slope = _ONE / (_ONE - knee)
    for j in range(len(out)):
        red, green, blue = x2[0, j], x2[1, j], x2[2, j]
        m = (m0 * red + m1 * green + m2 * blue - knee) * slope
        m = m if m > _ZERO else _ZERO
        m = m if m < _ONE else _ONE
        y = c0 * red + c1 * green + c2 * blue
        y *= (floor + rise * (m * m)) * mask[j]
        out[j] = white if y > white else y


@part
def _attend(x4, channel, table, nodes, shares, found, white, out):  # type: ignore[no-untyped-def]
    """One channel of x4 ``(3, n)`` times the attention that all three call for."""
    count, scale = len(out), np.float32(len(table) - 1)
    _look_up(x4[0, :count], x4[1, :count], x4[2, :count], scale, table, nodes, shares, 0, found)
    for j in range(count):
        y = x4[channel, j] * found[0, 0, j]
        out[j] = white if y > white else y


@compiled
def _rows(srgb, scale, table, codes, curves, attention, colour, knee, frame, shading, sites, white, raw, start, stop):  # type: ignore[no-untyped-def]
    """Rows ``start`` to ``stop`` of the batch's rows of pixels, one picture's after the other's."""
    height, width = srgb.shape[2], raw.shape[3]
    nodes, shares = np.empty(2 * _TILE, np.int32), np.empty((3, 2 * _TILE), np.float32)
    x2, attended = np.empty((2, 3, _TILE), np.float32), np.empty((2, 3, _TILE), np.float32)
    x4, mask = np.empty((3, _TILE), np.float32), np.ones(_TILE, np.float32)
    for row in range(start, stop):
        b, i = divmod(row, height)
        red, green, blue = srgb[b, 0, i], srgb[b, 1, i], srgb[b, 2, i]
        for first in range(0, width, _TILE):
            last = min(first + _TILE, width)
            pixels = slice(2 * first, 2 * last)
            if table is not None:
                _look_up(red[pixels], green[pixels], blue[pixels], scale, table, nodes, shares, 1, x2)
            if codes is not None:
                for c in range(3):
                    _of_codes(srgb[b, c, i, pixels], codes[b], x2[:, c])
            if curves is not None:
                for c in range(3):
                    _through_curve(srgb[b, c, i, pixels], scale, curves[b], nodes, shares, x2[:, c])
            for k in range(len(sites)):
                if sites[k, 0] != i % 2:
                    continue
                column, channel, out = sites[k, 1], sites[k, 2], raw[b, k, i // 2, first:last]
                if shading is not None:
                    _fall_off(frame[b], i, 2 * first + column, shading, mask[: last - first])
                if attention is not None:
                    for c in range(len(x4)):
                        _develop(x2[column], colour[b], c, knee, mask, _FAR, x4[c, : last - first])
                    _attend(x4, channel, attention, nodes, shares, attended, white, out)
                else:
                    _develop(x2[column], colour[b], channel, knee, mask, white, out)


@part
def _average(plane, top, bottom, edges, sums, means):  # type: ignore[no-untyped-def]
    """Means of the windows of a plane between ``top`` and ``bottom``, and ``edges`` ``(n, 2)`` from left to right."""
    sums[:] = 0
    for y in range(top, bottom):
        line = plane[y]
        for x in range(len(sums)):
            sums[x] += np.uint32(line[x])
    for j in range(len(means)):
        left, right = edges[j]
        total = np.uint32(0)
        for x in range(left, right):
            total += sums[x]
        means[j] = np.float32(total / (255.0 * (bottom - top) * (right - left)))


@compiled
def _small_rows(srgb, rows, columns, table, x2, start, stop):  # type: ignore[no-untyped-def]
    """Rows ``start`` to ``stop`` of the batch's rows of thumbnails, one picture's after the other's."""
    scale, width = np.float32(len(table) - 1), len(columns)
    sums, means = np.empty(srgb.shape[3], np.uint32), np.empty((3, width), np.float32)
    nodes, shares = np.empty(_TILE, np.int32), np.empty((3, _TILE), np.float32)
    found = np.empty((2, 3, _TILE), np.float32)
    for row in range(start, stop):
        b, i = divmod(row, len(rows))
        for c in range(3):
            _average(srgb[b, c], rows[i, 0], rows[i, 1], columns, sums, means[c])
        for first in range(0, width, _TILE):
            last = min(first + _TILE, width)
            red, green, blue = means[0, first:last], means[1, first:last], means[2, first:last]
            _look_up(red, green, blue, scale, table, nodes, shares, 0, found)
            x2[b, :, i, first:last] = found[0, :, : last - first]
