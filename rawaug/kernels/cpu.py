"""The passes of :mod:`rawaug.kernels.reference` as loops for the CPU, compiled by Numba.

A row is processed in tiles that fit the fastest cache. Each step is a separate loop, which the compiler turns into
vector instructions. It does not find those for the table's look-up, so :func:`_interpolate` spells them out, for four
colours of two neighbouring nodes at a time. Exponential, logarithm and sine are minimax polynomials.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache, partial

import numpy as np
import torch
import torch.nn.functional as F
from llvmlite import ir
from numba import types
from numba.core.typing.templates import Signature
from numba.extending import intrinsic
from numba.np.arrayobj import make_array
from torch import Tensor

from rawaug.bayer import CFA, demosaicing_stencils
from rawaug.kernels.planes import demosaic_directional as demosaic_directional
from rawaug.kernels.planes import smooth as smooth
from rawaug.kernels.reference import INCREMENTS, MULTIPLIERS, ROUNDS, Display, Unprocessing
from rawaug.kernels.runtime import compile_loop, compile_part, run_over_rows

_TILE = 256
"""A tile has this many cells of RAW."""

_LINE = _TILE + 16
"""A line of every second pixel has this many places: those of a tile, and a margin."""

_NOISE_TILE = 512
"""A tile has this many cells of noise."""

_ZERO, _ONE, _FAR = np.float32(0), np.float32(1), np.float32(np.inf)
_LEAST = np.float32(-125)
"""A mask counts as 0 at this exponent; below it, floats would become denormal."""

_M0, _M1 = np.uint64(MULTIPLIERS[0]), np.uint64(MULTIPLIERS[1])
_K0, _K1 = np.uint32(INCREMENTS[0]), np.uint32(INCREMENTS[1])
_32 = np.uint64(32)
_QUARTER_TURN = np.int32(2**30)


def _polynomial(*coefficients: float) -> tuple[np.float32, ...]:
    """Store the coefficients of a polynomial, in falling powers."""
    return tuple(np.float32(coefficient) for coefficient in coefficients)


_EXP2 = _polynomial(1.8775839e-3, 8.9893471e-3, 0.055826288, 0.24015364, 0.69315308, 0.99999994)
"""This approximates 2^f on [0, 1], within 7.5e-8, relative."""

_LOG = _polynomial(
    0.08960108, -0.14482562, 0.14917466, -0.16543691, 0.19958405, -0.25002947, 0.3333416, -0.49999979, 1.0
)
"""This approximates ln(1 + m) / m, within 2.6e-8 for 1 + m between sqrt(1/2) and sqrt(2)."""

_SINE = _polynomial(1.5167854e-4, -4.6741581e-3, 0.079689927, -0.64596379, 1.57079637)
"""This approximates sin(pi / 2 sqrt(s)) / sqrt(s), within 6.7e-9 on [0, 1]."""


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

    codes, curves = None, _present(camera.curves)
    if in_bytes and entries == 256:
        codes, curves = curves, None
    convert = partial(
        _raw_rows,
        srgb.detach().contiguous().numpy(),
        scale,
        _present(camera.table),
        codes,
        curves,
        _present(camera.attention),
        _present(camera.colour),
        np.float32(camera.knee),
        _present(camera.frame),
        _present(camera.shading),
        _present(camera.sites),
        _present(camera.taps),
        np.float32(white),
        raw.numpy(),
    )
    run_over_rows(batch * height // 2, 2 * width, convert)
    return raw


def _present(part: Tensor) -> np.ndarray | None:
    """Return a part of the settings as an array, or None if it is empty, so that no code is compiled for it."""
    if not part.numel():
        return None
    return part.detach().contiguous().numpy()


def render(linear: Tensor, display: Display) -> Tensor:
    """Develop camera colour x5 ``(B, 3, H, W)``, float32 on the CPU, to sRGB in [0, 1]."""
    return _render_rows(linear.detach().contiguous(), None, np.empty(0, np.int64), linear.shape, display)


def develop(raw: Tensor, display: Display, cfa: CFA | str, methods: Sequence[str]) -> Tensor:
    """Develop mosaics to sRGB.

    Args:
        raw: ``(B, 1, H, W)``, float32 on the CPU.
        display: the way from camera colour to sRGB.
        cfa: pattern of the mosaics.
        methods: the demosaicing of each, one of :data:`rawaug.bayer.STENCILS`.

    Returns:
        sRGB ``(B, 3, H, W)`` in [0, 1].
    """
    padded = F.pad(raw.detach(), (2, 2, 2, 2), mode="reflect")  # about the border sites, so the pattern stays
    names = sorted(set(methods))
    weights = np.stack([_site_weights(CFA(cfa), name) for name in names])
    numbers = np.array([names.index(method) for method in methods])
    return _render_rows(padded, weights, numbers, (len(raw), 3, *raw.shape[2:]), display)


def _render_rows(
    source: Tensor, weights: np.ndarray | None, methods: np.ndarray, shape: Sequence[int], display: Display
) -> Tensor:
    srgb = torch.empty(tuple(shape), dtype=torch.float32)
    if not srgb.numel():
        return srgb

    batch, _, height, width = shape
    settings = map(_present, display)
    run_over_rows(
        batch * height, 3 * width, partial(_srgb_rows, source.numpy(), weights, methods, *settings, srgb.numpy())
    )
    return srgb


@lru_cache
def _site_weights(cfa: CFA, method: str) -> np.ndarray:
    """Lay out the weights of :func:`_demosaic`'s six sums by row of the cell, colour and site, (2, 3, 6, _TILE)."""
    stencils, kinds = demosaicing_stencils(cfa, method)
    edge = 2 - stencils.shape[-1] // 2
    around = F.pad(stencils, (edge, edge, edge, edge))

    measured = torch.eye(6)[:1]  # a site that has the colour keeps its own value
    sums = torch.stack([around[:, i, j] for i, j in ((2, 2), (2, 1), (1, 2), (1, 1), (2, 0), (0, 2))], dim=1)
    weights = torch.cat([measured, sums])[torch.tensor(kinds)]  # (colour, row, column, sum)
    return weights.permute(1, 0, 3, 2).repeat(1, 1, 1, _TILE // 2).contiguous().numpy()


@intrinsic
def _interpolate(context, table, node, row, layer, u, v, w, out, at, plane):  # type: ignore[no-untyped-def]
    """Mix eight nodes of ``table``, to ``out[at]``, ``out[at + plane]`` and ``out[at + 2 plane]``, all flat float32.

    ``node`` is the place of the first. A node is 4 numbers; the next is ``row`` ahead along v and ``layer`` along w.
    """
    signature = types.void(table, node, row, layer, u, v, w, out, at, plane)
    return signature, _interpolation


def _interpolation(context, build, signature: Signature, values):  # type: ignore[no-untyped-def]
    """Emit the code of :func:`_interpolate`: two nodes along u are one vector of 8, mixed along w, v, then u."""
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

    def along_w(node):  # type: ignore[no-untyped-def]
        return mix(load(node), load(build.add(node, layer)), spread(w, 8))

    pair = mix(along_w(node), along_w(build.add(node, row)), spread(v, 8))
    mixed = mix(pick(pair, [0, 1, 2, 3]), pick(pair, [4, 5, 6, 7]), spread(u, 4))

    for lane in range(3):
        build.store(build.extract_element(mixed, ir.Constant(index, lane)), address(out, signature.args[7], at))
        at = build.add(at, plane)
    return context.get_dummy_value()


@compile_part
def _at_least(x, limit):  # type: ignore[no-untyped-def]
    """Take the larger of two numbers, or the limit in place of NaN."""
    return x if x > limit else limit


@compile_part
def _at_most(x, limit):  # type: ignore[no-untyped-def]
    """Take the smaller of two numbers, or the limit in place of NaN."""
    return x if x < limit else limit


@compile_part
def _clip(x, white):  # type: ignore[no-untyped-def]
    """Limit a signal to white; NaN stays NaN."""
    return white if x > white else x


@compile_part
def _cell_of(value, scale, last):  # type: ignore[no-untyped-def]
    """Find the node below a value, at most ``last``, and the share of the way to the next; values are clamped."""
    # NaN goes to node 0: an index must never be out of bounds.
    x = _at_least(np.float32(value) * scale, _ZERO)
    x = _at_most(x, np.float32(last + 1))
    node = _at_most(np.int32(x), last)
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
        _interpolate(flat_table, np.int64(nodes[j]), row, layer, u, v, w, flat_out, at, plane)


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
def _of_codes(plane, curve, out):  # type: ignore[no-untyped-def]
    """Look up a curve that has an entry for each byte, as :func:`_through_curve` does."""
    even, odd = out[0], out[1]
    for j in range(len(plane) // 2):
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
        exponent = _at_least(-(a * v * v + (b * v + c * u) * u), _LEAST)
        whole = np.int32(exponent) - np.int32(1)
        rest = exponent - np.float32(whole)
        p = _EXP2[0]
        for k in range(1, len(_EXP2)):
            p = p * rest + _EXP2[k]
        out[j] = p * np.int32((whole + np.int32(127)) << np.int32(23)).view(np.float32)


@compile_part
def _develop(x2, colour, channel, knee, mask, white, out):  # type: ignore[no-untyped-def]
    """Compute one channel of x4 times the mask from x2 ``(3, n)``."""
    c0, c1, c2 = colour[channel, 0], colour[channel, 1], colour[channel, 2]
    m0, m1, m2 = colour[3, 0], colour[3, 1], colour[3, 2]
    floor, rise = colour[4, channel], colour[5, channel]
    slope = _ONE / (_ONE - knee)

    for j in range(len(out)):
        red, green, blue = x2[0, j], x2[1, j], x2[2, j]
        m = _at_least((m0 * red + m1 * green + m2 * blue - knee) * slope, _ZERO)
        m = _at_most(m, _ONE)

        y = c0 * red + c1 * green + c2 * blue
        y *= (floor + rise * (m * m)) * mask[j]
        out[j] = _clip(y, white)


@compile_part
def _attend(x4, channel, table, nodes, shares, attention, white, out):  # type: ignore[no-untyped-def]
    """Multiply one channel of x4 ``(3, n)`` by the attention, which depends on all three."""
    count, scale = len(out), np.float32(len(table) - 1)
    _look_up(x4[0, :count], x4[1, :count], x4[2, :count], scale, table, nodes, shares, 0, 0, attention)

    for j in range(count):
        out[j] = _clip(x4[channel, j] * attention[0, 0, j], white)


@compile_part
def _light(srgb, b, i, pixels, scale, table, codes, curves, nodes, shares, first, out):  # type: ignore[no-untyped-def]
    """Look up linear light of some pixels of a row: even ones go to ``out[0]``, odd ones to ``out[1]``."""
    if table is not None:
        red, green, blue = srgb[b, 0, i, pixels], srgb[b, 1, i, pixels], srgb[b, 2, i, pixels]
        _look_up(red, green, blue, scale, table, nodes, shares, 1, first, out)
    if codes is not None:
        for c in range(3):
            _of_codes(srgb[b, c, i, pixels], codes[b], out[:, c, first:])
    if curves is not None:
        for c in range(3):
            _through_curve(srgb[b, c, i, pixels], scale, curves[b], nodes, shares, out[:, c, first:])


@intrinsic
def _blur_down(context, lines, above, over, upper, lower, under, below, a, b, c, out, one, other):  # type: ignore[no-untyped-def]
    """Blur 16 places of two rows, between two above and two below, down the columns; all are places in ``lines``."""
    signature = types.void(lines, above, over, upper, lower, under, below, a, b, c, out, one, other)
    return signature, _emit_blur_down


def _emit_blur_down(context, build, signature: Signature, values):  # type: ignore[no-untyped-def]
    lines, *rows, a, b, c, out, one, other = values
    code = _Vectors(context, build, 16)
    above, over, upper, lower, under, below = [code.load(signature.args[0], lines, row) for row in rows]
    taps = [code.spread(tap) for tap in (a, b, c)]
    code.store(code.weigh(taps, upper, over, lower, above, under), signature.args[10], out, one)
    code.store(code.weigh(taps, lower, upper, under, over, below), signature.args[10], out, other)
    return context.get_dummy_value()


@intrinsic
def _blur_along(context, row, even, odd, a, b, c, out, evens, odds):  # type: ignore[no-untyped-def]
    """Blur 16 cells along a row, whose cells begin a place before ``even`` and ``odd``, for the pixel to the left."""
    return types.void(row, even, odd, a, b, c, out, evens, odds), _emit_blur_along


def _emit_blur_along(context, build, signature: Signature, values):  # type: ignore[no-untyped-def]
    row, even, odd, a, b, c, out, evens, odds = values
    code = _Vectors(context, build, 16)
    shifted = []
    for place in (even, odd):
        first = code.load(signature.args[0], row, place)
        second = code.load(signature.args[0], row, build.add(place, ir.Constant(place.type, 16)))
        shifted.append([code.window(first, second, shift) for shift in range(3)])

    (even_before, even_here, even_after), (odd_before, odd_here, odd_after) = shifted
    taps = [code.spread(tap) for tap in (a, b, c)]
    even_light = code.weigh(taps, even_here, odd_before, odd_here, even_before, even_after)
    odd_light = code.weigh(taps, odd_here, even_here, even_after, odd_before, odd_after)
    code.store(even_light, signature.args[6], out, evens)
    code.store(odd_light, signature.args[6], out, odds)
    return context.get_dummy_value()


class _Vectors:
    """Emits code on vectors of float32."""

    def __init__(self, context, build, lanes):  # type: ignore[no-untyped-def]
        self.context, self.build, self.lanes = context, build, lanes
        self.type = ir.VectorType(ir.FloatType(), lanes)

    def address(self, kind, array, place):  # type: ignore[no-untyped-def]
        data = make_array(kind)(self.context, self.build, array).data
        return self.build.bitcast(self.build.gep(data, [place]), self.type.as_pointer())

    def load(self, kind, array, place):  # type: ignore[no-untyped-def]
        return self.build.load(self.address(kind, array, place), align=4)

    def store(self, vector, kind, array, place):  # type: ignore[no-untyped-def]
        self.build.store(vector, self.address(kind, array, place), align=4)

    def window(self, first, second, shift):  # type: ignore[no-untyped-def]
        """The lanes from ``shift`` on of two vectors in a row."""
        index = ir.IntType(32)
        lanes = ir.Constant(ir.VectorType(index, self.lanes), [shift + lane for lane in range(self.lanes)])
        return self.build.shuffle_vector(first, second, lanes)

    def spread(self, scalar):  # type: ignore[no-untyped-def]
        index = ir.IntType(32)
        undefined = ir.Constant(self.type, ir.Undefined)
        vector = self.build.insert_element(undefined, scalar, ir.Constant(index, 0))
        return self.build.shuffle_vector(
            vector, undefined, ir.Constant(ir.VectorType(index, self.lanes), [0] * self.lanes)
        )

    def weigh(self, taps, here, before, after, far_before, far_after):  # type: ignore[no-untyped-def]
        """Compute a here + b (before + after) + c (far before + far after)."""
        flags, build = ("contract",), self.build
        near = build.fmul(taps[1], build.fadd(before, after, flags=flags), flags=flags)
        far = build.fmul(taps[2], build.fadd(far_before, far_after, flags=flags), flags=flags)
        return build.fadd(build.fadd(build.fmul(taps[0], here, flags=flags), near, flags=flags), far, flags=flags)


@compile_part
def _blur(lines, i, end, taps, n, columns, x2):  # type: ignore[no-untyped-def]
    """Blur n cells of rows i and i + 1; ``lines`` hold the six rows about them, and ``end`` is the last row."""
    a, b, c = taps[0], taps[1], taps[2]
    width = lines.shape[3]
    size = np.int64(6) * width
    above, over, upper = max(i - 2, 0) % 6 * size, max(i - 1, 0) % 6 * size, i % 6 * size
    lower, under, below = (i + 1) % 6 * size, min(i + 2, end) % 6 * size, min(i + 3, end) % 6 * size
    flat_lines, flat = lines.reshape(-1), x2.reshape(-1)

    for channel in range(3):
        for p in range(2):
            first = np.int64((3 * p + channel) * width)
            for j in range(0, width, 16):
                at, out = first + j, np.int64(p * _LINE + j)
                _blur_down(
                    flat_lines, above + at, over + at, upper + at, lower + at, under + at, below + at, a, b, c,
                    columns, out, out + 2 * _LINE,
                )  # fmt: skip

        for row in range(2):
            even, out = np.int64(2 * row * _LINE), np.int64((6 * row + channel) * _TILE)
            for j in range(0, n, 16):
                _blur_along(columns, even + j, even + _LINE + j, a, b, c, flat, out + j, out + 3 * _TILE + j)


@compile_loop
def _raw_rows(  # type: ignore[no-untyped-def]
    srgb, scale, table, codes, curves, attention, colour, knee, frame, shading, sites, taps, white, raw, start, stop,
):  # fmt: skip
    """Convert rows ``start`` to ``stop`` of all pictures' rows of cells, counted through the batch."""
    height, width = raw.shape[2], raw.shape[3]
    nodes, shares = np.empty(2 * _LINE, np.int32), np.empty((3, 2 * _LINE), np.float32)
    x2, attended = np.empty((2, 2, 3, _TILE), np.float32), np.empty((2, 3, _TILE), np.float32)
    x4, mask = np.empty((3, _TILE), np.float32), np.ones(_TILE, np.float32)

    # Six rows of light of each tile are kept, with a cell more on either side, for the blur.
    tiles = -(-width // _TILE)
    # They are as long as whole vectors of 16, of which the last begins within the margin.
    lines = np.zeros((tiles, 6, 2, 3, (min(width, _TILE) + 2 + 15) // 16 * 16), np.float32)
    columns, latest = np.zeros(4 * _LINE + 32, np.float32), -1

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
                    _light(srgb, b, 2 * k + i, pixels, scale, table, codes, curves, nodes, shares, 0, x2[i])
            else:
                left, right = max(first - 1, 0), min(last + 1, width)
                for i in range(latest + 1, min(2 * k + 4, 2 * height)):
                    line, pixels = lines[tile, i % 6], slice(2 * left, 2 * right)
                    _light(srgb, b, i, pixels, scale, table, codes, curves, nodes, shares, left - first + 1, line)
                    for c in range(3):  # the picture's edge is repeated outwards
                        if first == 0:
                            line[0, c, 0] = line[1, c, 0] = line[0, c, 1]
                        if last == width:
                            line[0, c, n + 1] = line[1, c, n + 1] = line[1, c, n]
                _blur(lines[tile], 2 * k, 2 * height - 1, taps[b], n, columns, x2)

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
def _demosaic(mosaic, row, first, weights, sums, out):  # type: ignore[no-untyped-def]
    """Demosaic a row from ``first`` on to colours ``(3, n)``; the mosaic has margins of 2.

    Stencils are symmetric: with the weights of its site, a colour is the sum of the site's own value, of the values of
    its neighbours along the row, the column and the diagonals, and of those two sites away along row and column.
    """
    n = out.shape[1]
    above, own, below = mosaic[row + 1, first:], mosaic[row + 2, first:], mosaic[row + 3, first:]
    _pairs(own[1:], own[3:], sums[1, :n])
    _pairs(above[2:], below[2:], sums[2, :n])
    _pairs(above[1:], above[3:], sums[6, :n])
    _pairs(below[1:], below[3:], sums[7, :n])
    _pairs(sums[6], sums[7], sums[3, :n])
    _pairs(own, own[4:], sums[4, :n])
    _pairs(mosaic[row, first + 2 :], mosaic[row + 4, first + 2 :], sums[5, :n])

    for c in range(3):
        _add_weighted(weights[c, 0], own[2:], weights[c, 1], sums[1], False, out[c])
        for k in (2, 4):
            _add_weighted(weights[c, k], sums[k], weights[c, k + 1], sums[k + 1], True, out[c])


@compile_part
def _add_weighted(a, x, b, y, more, out):  # type: ignore[no-untyped-def]
    """Write a x + b y to ``out``; with ``more``, add it to what is there."""
    for j in range(len(out)):
        out[j] = (out[j] if more else _ZERO) + (a[j] * x[j] + b[j] * y[j])


@compile_part
def _root(x, c0, c1, c2, out):  # type: ignore[no-untyped-def]
    """Compute the root of one channel of x2, held to [0, 1], from x3 ``(3, n)``."""
    for j in range(len(out)):
        y = _at_least(c0 * x[0, j] + c1 * x[1, j] + c2 * x[2, j], _ZERO)
        out[j] = np.sqrt(_at_most(y, _ONE))


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
    source, weights, methods, table, curves, attention, matrix, gains, frame, shading, srgb, start, stop,
):  # fmt: skip
    """Develop rows ``start`` to ``stop`` of all pictures' rows, of camera colour or, with weights, of mosaics."""
    height, width = srgb.shape[2], srgb.shape[3]
    nodes, shares = np.empty(_TILE, np.int32), np.empty((3, _TILE), np.float32)
    x, root, mask = np.empty((3, _TILE), np.float32), np.empty((3, _TILE), np.float32), np.ones(_TILE, np.float32)
    sums = np.empty((8, _TILE), np.float32)
    looked_up, half = np.empty((2, 3, _TILE), np.float32), np.ones(6, np.float32)
    half[4:] = np.float32(0.5)  # the mask is made for every second pixel

    for row in range(start, stop):
        b, i = divmod(row, height)
        for first in range(0, width, _TILE):
            last = min(first + _TILE, width)
            n = last - first

            if weights is None:
                for c in range(3):
                    for j in range(n):  # faster than slices
                        x[c, j] = source[b, c, i, first + j]
            else:
                _demosaic(source[b, 0], i, first, weights[methods[b], i % 2], sums, x[:, :n])

            if shading is not None:
                _fall_off(frame[b] * half, i, 2 * first, shading, mask[:n])
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
                    x[c, j] = _at_most(x[c, j] * gain, white)

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
                        y = _at_least(looked_up[0, c, j], _ZERO)
                        srgb[b, c, i, first + j] = _at_most(y, _ONE)


def shot_read(clean: Tensor, levels: Tensor, keys: list[int], white: float, mapped: bool) -> tuple[Tensor, Tensor]:
    """Add shot and read noise to clean RAW.

    Args:
        clean: packed ``(B, 4, h, w)``, float32 on the CPU.
        levels: ``(B, 2)``, shot_var and read_var of each picture.
        keys: one number below 2^64 for each picture.
        white: the value to clip at.
        mapped: whether to compute the variance map of the noisy signal.

    Returns:
        Noisy RAW and its variance map, both ``(B, 4, h, w)``; the map is empty if it was not requested.
    """
    noisy = torch.empty_like(clean, memory_format=torch.contiguous_format)
    variance = torch.empty_like(noisy if mapped else noisy[:, :, :0])
    if not noisy.numel():
        return noisy, variance

    batch, _, height, width = clean.shape
    add_noise = partial(
        _noise_rows,
        clean.detach().contiguous().numpy(),
        levels.detach().to("cpu", torch.float32).numpy(),
        np.array([(key & 0xFFFFFFFF, key >> 32) for key in keys], dtype=np.uint32),
        np.float32(white),
        noisy.numpy(),
        _present(variance),
    )
    run_over_rows(batch * height, 4 * width, add_noise)
    return noisy, variance


@compile_part
def _words(key, first, count, words):  # type: ignore[no-untyped-def]
    """Draw the four words of each cell from ``first`` on, as :func:`rawaug.kernels.reference.philox` does."""
    for i in range(count):
        a, b, c, d = np.uint32(first + i), np.uint32(0), np.uint32(0), np.uint32(0)
        low, high = key[0], key[1]
        for _ in range(ROUNDS):
            p, q = np.uint64(a) * _M0, np.uint64(c) * _M1
            a, b = np.uint32(q >> _32) ^ b ^ low, np.uint32(q)
            c, d = np.uint32(p >> _32) ^ d ^ high, np.uint32(p)
            low, high = np.uint32(low + _K0), np.uint32(high + _K1)
        words[0, i], words[1, i], words[2, i], words[3, i] = a, b, c, d


@compile_part
def _log(x):  # type: ignore[no-untyped-def]
    """Compute the natural logarithm of a positive, normal float32 by its exponent and a polynomial in its mantissa."""
    bits = np.float32(x).view(np.int32)
    exponent = (bits - np.int32(0x3F3504F3)) >> np.int32(23)  # mantissa in [1 / sqrt(2), sqrt(2))
    m = np.int32(bits - (exponent << np.int32(23))).view(np.float32) - _ONE

    p = _LOG[0]
    for k in range(1, len(_LOG)):
        p = p * m + _LOG[k]
    return np.float32(exponent) * np.float32(math.log(2)) + m * p


@compile_part
def _sine(turn):  # type: ignore[no-untyped-def]
    """Compute the sine of an angle in units of 2^-32 turns: fold it to a quarter turn about 0, then a polynomial."""
    # int32 overflows at the full turn, so no remainder has to be taken.
    folded = turn
    if turn > _QUARTER_TURN or turn < -_QUARTER_TURN:
        folded = np.int32(np.int32(-(2**31)) - turn)

    x = np.float32(folded) * np.float32(2.0**-30)
    square = x * x
    p = _SINE[0]
    for k in range(1, len(_SINE)):
        p = p * square + _SINE[k]
    return x * p


@compile_part
def _normals(words, count, normals):  # type: ignore[no-untyped-def]
    """Turn the words of cells ``(4, count)`` into as many normals, two by two (Box and Muller)."""
    for pair in (0, 2):
        for i in range(count):
            u = (np.float32(words[pair, i]) + np.float32(0.5)) * np.float32(2.0**-32)
            radius = np.sqrt(_at_least(np.float32(-2) * _log(u), _ZERO))
            turn = np.int32(words[pair + 1, i])
            normals[pair, i] = radius * _sine(np.int32(turn + _QUARTER_TURN))
            normals[pair + 1, i] = radius * _sine(turn)


@compile_part
def _disturb(signal, normals, shot_var, read_var, white, noisy):  # type: ignore[no-untyped-def]
    """Add noise to a row of one plane."""
    for j in range(len(signal)):
        light = _at_least(signal[j], _ZERO)
        deviation = np.sqrt(shot_var * light + read_var)
        noisy[j] = _clip(signal[j] + deviation * normals[j], white)


@compile_part
def _law(noisy, shot_var, read_var, variance):  # type: ignore[no-untyped-def]
    """Compute the variance of a row of one plane."""
    for j in range(len(noisy)):
        variance[j] = shot_var * _at_least(noisy[j], _ZERO) + read_var


@compile_loop
def _noise_rows(clean, levels, keys, white, noisy, variance, start, stop):  # type: ignore[no-untyped-def]
    """Add noise to rows ``start`` to ``stop`` of all pictures' rows of cells, counted through the batch."""
    height, width = clean.shape[2], clean.shape[3]
    words, normals = np.empty((4, _NOISE_TILE), np.uint32), np.empty((4, _NOISE_TILE), np.float32)

    for row in range(start, stop):
        b, i = divmod(row, height)
        shot_var, read_var = levels[b, 0], levels[b, 1]
        for first in range(0, width, _NOISE_TILE):
            count = min(_NOISE_TILE, width - first)
            cells = slice(first, first + count)
            _words(keys[b], i * width + first, count, words)
            _normals(words, count, normals)

            for k in range(4):
                _disturb(clean[b, k, i, cells], normals[k], shot_var, read_var, white, noisy[b, k, i, cells])
                if variance is not None:
                    _law(noisy[b, k, i, cells], shot_var, read_var, variance[b, k, i, cells])
