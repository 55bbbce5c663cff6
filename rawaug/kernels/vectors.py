"""Parts of the CPU's loops that the compiler turns into no vector instructions by itself, spelled out for LLVM.

Each function is called by loops of other modules. Numba's cache on disk knows only the file of the loop, so after a
change here the caches (``__pycache__/*.nbi``) have to be removed.
"""

from __future__ import annotations

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.typing.templates import Signature
from numba.extending import intrinsic
from numba.np.arrayobj import make_array

from rawaug.kernels.runtime import compile_part


@compile_part
def at_least(x, limit):  # type: ignore[no-untyped-def]
    """Take the larger of two numbers, or the limit in place of NaN."""
    return x if x > limit else limit


@compile_part
def at_most(x, limit):  # type: ignore[no-untyped-def]
    """Take the smaller of two numbers, or the limit in place of NaN."""
    return x if x < limit else limit


@compile_part
def clip(x, white):  # type: ignore[no-untyped-def]
    """Limit a signal to white; NaN stays NaN."""
    return white if x > white else x


@intrinsic
def interpolate(context, table, node, row, layer, u, v, w, out, at, plane):  # type: ignore[no-untyped-def]
    """Mix eight nodes of ``table``, to ``out[at]``, ``out[at + plane]`` and ``out[at + 2 plane]``, all flat float32.

    ``node`` is the place of the first. A node is 4 numbers; the next is ``row`` ahead along v and ``layer`` along w.
    """
    return types.void(table, node, row, layer, u, v, w, out, at, plane), _emit_interpolate


def _emit_interpolate(context, build, signature: Signature, values):  # type: ignore[no-untyped-def]
    """Emit the code of :func:`interpolate`: two nodes along u are one vector of 8, mixed along w, v, then u."""
    _, node, row, layer, u, v, w, _, at, plane = values
    code = _Code(context, build, signature, values)

    def mix(a, b, t):  # type: ignore[no-untyped-def]
        return code.add(a, code.multiply(build.fsub(b, a, flags=("contract",)), t))

    def along_w(node):  # type: ignore[no-untyped-def]
        return mix(code.load(0, node, 8), code.load(0, build.add(node, layer), 8), code.spread(w, 8))

    pair = mix(along_w(node), along_w(build.add(node, row)), code.spread(v, 8))
    mixed = mix(code.pick(pair, pair, range(4)), code.pick(pair, pair, range(4, 8)), code.spread(u, 4))

    for lane in range(3):
        build.store(build.extract_element(mixed, ir.Constant(_INDEX, lane)), code.address(7, at))
        at = build.add(at, plane)
    return context.get_dummy_value()


@intrinsic
def take_codes(context, row, pieces, even, odd):  # type: ignore[no-untyped-def]
    """Look up bytes ``(n,)`` in a table of 256 numbers, 64 bytes at a time: numbers of even places, then of odd ones.

    ``pieces`` ``(1024,)`` are the first bytes of all numbers, their second, third and fourth ones. Returns how many
    pairs are done; without the instructions (AVX-512 VBMI) none are.
    """
    return types.int64(row, pieces, even, odd), _emit_take_codes


def _emit_take_codes(context, build, signature: Signature, values):  # type: ignore[no-untyped-def]
    """Emit the code of :func:`take_codes`: one instruction looks up 64 bytes in a table of 128."""
    length = ir.IntType(64)
    _, _, features = context.codegen().magic_tuple()
    if "+avx512vbmi," not in features + ",":
        return ir.Constant(length, 0)

    code = _Code(context, build, signature, values)
    tables = [code.load(1, ir.Constant(length, place), 64, _BYTE) for place in range(0, 1024, 64)]
    of_bytes = tables[0].type
    look_up = cgutils.get_or_insert_function(
        build.module, ir.FunctionType(of_bytes, [of_bytes] * 3), "llvm.x86.avx512.vpermi2var.qi.512"
    )

    row = make_array(signature.args[0])(context, build, values[0])
    count = build.udiv(cgutils.unpack_tuple(build, row.shape)[0], ir.Constant(length, 64))
    with cgutils.for_range(build, count, intp=length) as loop:
        first = build.mul(loop.index, ir.Constant(length, 64))
        codes = code.load(0, first, 64, _BYTE)

        # Vectors of bytes are woven within quarters of a register. In this order, even places are in two of the four
        # results, and odd ones in the other two.
        order = [
            32 * (k // 2) + 2 * (4 * quarter + m) + k % 2 for quarter in range(4) for k in range(4) for m in range(4)
        ]
        codes = code.pick(codes, codes, order)
        is_high = build.icmp_signed("<", codes, ir.Constant(of_bytes, [0] * 64))
        planes = []
        for k in range(0, 16, 4):
            low = build.call(look_up, [tables[k], codes, tables[k + 1]])
            high = build.call(look_up, [tables[k + 2], codes, tables[k + 3]])
            planes.append(build.select(is_high, high, low))

        halves = [code.weave(planes[0], planes[1]), code.weave(planes[2], planes[3])]
        of_halves = ir.VectorType(ir.IntType(16), 32)
        place = build.mul(loop.index, ir.Constant(length, 32))
        for k in range(2):
            woven = code.weave(build.bitcast(halves[0][k], of_halves), build.bitcast(halves[1][k], of_halves))
            for parity, numbers in enumerate(woven):
                code.store(numbers, 2 + parity, build.add(place, ir.Constant(length, 16 * k)))
    return build.mul(count, ir.Constant(length, 32))


@intrinsic
def blur_plane(context, lines, above, over, upper, lower, under, below, odd, a, b, c, out, first, step, count):  # type: ignore[no-untyped-def]
    """Blur ``16 count`` cells of two rows of one channel, between two rows above and two below.

    Args:
        lines: flat light, in which even places of a row are followed by its odd ones, ``odd`` numbers further. A row
            begins a cell before the first one, and has places for 16 cells more.
        above, over, upper, lower, under, below: the places in ``lines`` where the six rows begin.
        a, b, c: the taps.
        out: flat; even cells of the upper row go to ``first`` and further, then its odd ones, even ones of the lower
            row, and its odd ones, each ``step`` ahead.
    """
    types_of_all = (lines, above, over, upper, lower, under, below, odd, a, b, c, out, first, step, count)
    return types.void(*types_of_all), _emit_blur_plane


def _emit_blur_plane(context, build, signature: Signature, values):  # type: ignore[no-untyped-def]
    """Emit the code of :func:`blur_plane`: down the columns, 16 places ahead, and along the rows from there."""
    _, *rows, odd, a, b, c, _, first, step, count = values
    code = _Code(context, build, signature, values)
    taps = [code.spread(tap, 16) for tap in (a, b, c)]

    def weigh(here, before, after, far_before, far_after):  # type: ignore[no-untyped-def]
        near = code.multiply(taps[1], code.add(before, after))
        far = code.multiply(taps[2], code.add(far_before, far_after))
        return code.add(code.add(code.multiply(taps[0], here), near), far)

    def blur_down(place):  # type: ignore[no-untyped-def]
        """Blur 16 places of the upper row, and of the lower one."""
        above, over, upper, lower, under, below = [code.load(0, build.add(row, place), 16) for row in rows]
        return weigh(upper, over, lower, above, under), weigh(lower, upper, under, over, below)

    nothing = ir.Constant(count.type, 0)
    latest = []  # even places of the upper and the lower row, then odd places
    for place in (nothing, odd):
        for light in blur_down(place):
            latest.append(cgutils.alloca_once_value(build, light))

    with cgutils.for_range(build, count, intp=count.type) as loop:
        here = build.mul(loop.index, ir.Constant(count.type, 16))
        ahead = build.add(here, ir.Constant(count.type, 16))
        following = [*blur_down(ahead), *blur_down(build.add(ahead, odd))]
        out = build.add(first, here)
        for row in range(2):
            before, now, after = [], [], []
            for parity in (row, row + 2):
                begin, end = build.load(latest[parity]), following[parity]
                before.append(begin)
                now.append(code.pick(begin, end, range(1, 17)))
                after.append(code.pick(begin, end, range(2, 18)))
                build.store(end, latest[parity])
            code.store(weigh(now[0], before[1], now[1], before[0], after[0]), 11, out)
            code.store(weigh(now[1], now[0], after[0], before[1], after[1]), 11, build.add(out, step))
            out = build.add(out, build.add(step, step))
    return context.get_dummy_value()


_BYTE, _INDEX, _NUMBER = ir.IntType(8), ir.IntType(32), ir.FloatType()


class _Code:
    """Emits code on vectors; arrays are the arguments of the intrinsic, by number."""

    def __init__(self, context, build, signature, values):  # type: ignore[no-untyped-def]
        self.build = build
        self.data = {}
        for number, kind in enumerate(signature.args):
            if isinstance(kind, types.Array):
                self.data[number] = make_array(kind)(context, build, values[number]).data

    def address(self, array, place):  # type: ignore[no-untyped-def]
        return self.build.gep(self.data[array], [place])

    def load(self, array, place, lanes, kind=_NUMBER):  # type: ignore[no-untyped-def]
        pointer = ir.VectorType(kind, lanes).as_pointer()
        return self.build.load(self.build.bitcast(self.address(array, place), pointer), align=1 if kind is _BYTE else 4)

    def store(self, vector, array, place):  # type: ignore[no-untyped-def]
        vector = self.build.bitcast(vector, ir.VectorType(_NUMBER, 16))
        pointer = vector.type.as_pointer()
        self.build.store(vector, self.build.bitcast(self.address(array, place), pointer), align=4)

    def pick(self, one, other, lanes):  # type: ignore[no-untyped-def]
        """Take some lanes of two vectors, counted through both."""
        lanes = list(lanes)
        return self.build.shuffle_vector(one, other, ir.Constant(ir.VectorType(_INDEX, len(lanes)), lanes))

    def weave(self, one, other):  # type: ignore[no-untyped-def]
        """Take lanes of two vectors in turn, from the lower and from the upper halves of each quarter."""
        lanes = one.type.count
        quarter = lanes // 4
        lower = [lanes * (k % 2) + start + k // 2 for start in range(0, lanes, quarter) for k in range(quarter)]
        upper = [lane + quarter // 2 for lane in lower]
        return self.pick(one, other, lower), self.pick(one, other, upper)

    def spread(self, scalar, lanes):  # type: ignore[no-untyped-def]
        vector = self.build.insert_element(
            ir.Constant(ir.VectorType(_NUMBER, lanes), ir.Undefined), scalar, ir.Constant(_INDEX, 0)
        )
        return self.pick(vector, vector, [0] * lanes)

    def add(self, a, b):  # type: ignore[no-untyped-def]
        return self.build.fadd(a, b, flags=("contract",))

    def multiply(self, a, b):  # type: ignore[no-untyped-def]
        return self.build.fmul(a, b, flags=("contract",))
