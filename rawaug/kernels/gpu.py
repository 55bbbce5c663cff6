"""The passes of :mod:`rawaug.kernels.reference` as Triton kernels: a program works on a block of Bayer cells.

The pass to RAW reads every pixel once and writes clean, noisy and variance, with 3 bytes in and 12 out for each pixel.
The table, 4.4 MB at 65 nodes, stays in the GPU's cache. Triton's generator is Philox4x32-10 with the cell as its
counter, so the noise is that of a CPU, except for the rounding of logarithms. What is on the host of a pass's settings
crosses in one copy. The way back to sRGB is in :mod:`rawaug.kernels.gpu_srgb`.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
import triton
import triton.language as tl
from torch import Tensor

from rawaug.kernels.reference import Unprocessing
from rawaug.kernels.runtime import move_together

_RAW_BLOCK = 256
_NOISE_BLOCK = 512


def unprocess(srgb: Tensor, camera: Unprocessing, white: float) -> Tensor:
    """Convert sRGB ``(B, 3, H, W)``, uint8 or float32 in [0, 1], to packed RAW ``(B, 4, H/2, W/2)`` up to ``white``."""
    _, raw, _ = _convert(srgb, camera, white)
    return raw


def colours(srgb: Tensor, camera: Unprocessing, white: float) -> Tensor:
    """Convert sRGB ``(B, 3, H, W)`` to RAW of all three colours at every pixel, ``(B, 3, H, W)``, up to ``white``."""
    _, rgb, _ = _convert(srgb, camera, white, in_colour=True)
    return rgb


def raw_pairs(
    srgb: Tensor, camera: Unprocessing, levels: Tensor, keys: Sequence[int], white: float, in_colour: bool, mapped: bool
) -> tuple[Tensor, Tensor, Tensor]:
    """Convert sRGB ``(B, 3, H, W)`` to noisy and clean RAW and the variance map, in one pass.

    Args:
        srgb: uint8 or float32 in [0, 1].
        camera: the settings of the pass.
        levels, keys: as of :func:`shot_read`.
        white: the value to clip at.
        in_colour: whether clean RAW has all three colours at every pixel, ``(B, 3, H, W)``; packed otherwise.
        mapped: whether to compute the variance map; it is empty otherwise.

    Returns:
        Noisy, clean and variance, packed ``(B, 4, H/2, W/2)``.
    """
    return _convert(srgb, camera, white, in_colour, levels, keys, mapped)


def _convert(
    srgb: Tensor,
    camera: Unprocessing,
    white: float,
    in_colour: bool = False,
    levels: Tensor | None = None,
    keys: Sequence[int] = (),
    mapped: bool = False,
) -> tuple[Tensor, Tensor, Tensor]:
    """Convert sRGB to noisy RAW, clean RAW and the variance map; without levels there is no noise."""
    batch, _, height, width = srgb.shape
    h, w = height // 2, width // 2
    has_noise = levels is not None
    if levels is None:
        levels = camera.colour.new_empty(0)

    sites = [i + 2 * j + 4 * channel for i, j, channel in camera.sites]
    *parts, levels, seeds = move_together([*camera, levels, _signed(keys)], srgb.device)
    camera = Unprocessing(*parts)

    nodes = max(camera.table.shape[0], camera.attention.shape[0])
    entries = camera.curves.shape[1] if camera.curves.numel() else 0
    largest_code = 255.0 if srgb.dtype == torch.uint8 else 1.0
    scale = ((entries or nodes) - 1) / largest_code
    tables = (camera.table, camera.curves, camera.attention, camera.colour, camera.frame, camera.shading, camera.taps)
    tensors = [part.contiguous() for part in tables]
    source, is_linear = srgb.contiguous(), False
    blurs = camera.taps.numel() > 0

    shape = (batch, 3, height, width) if in_colour else (batch, 4, h, w)
    raw = torch.empty(shape, device=srgb.device, dtype=torch.float32)
    noisy = raw.new_empty(batch, 4, h, w) if has_noise else raw.new_empty(0)
    variance = torch.empty_like(noisy if mapped else noisy[:, :, :0]) if has_noise else noisy

    with torch.cuda.device_of(srgb):  # which need not be the current one
        if blurs and not entries:  # a table is read once for each pixel, not for each neighbour
            light = torch.empty(srgb.shape, device=srgb.device, dtype=torch.float32)
            _light[(triton.cdiv(height * width, _RAW_BLOCK), batch)](
                source, tensors[0], light, height * width, scale, NODES=nodes, BLOCK=_RAW_BLOCK, enable_fp_fusion=True
            )
            source, is_linear = light, True

        _raw_cells[(triton.cdiv(h * w, _RAW_BLOCK), batch)](
            source, *tensors, levels, seeds, raw, noisy, variance, h, w, scale, camera.knee, white, *sites,
            NODES=nodes, ENTRIES=entries, ATTENDS=camera.attention.numel() > 0, SHADES=camera.shading.numel() > 0,
            BLURS=blurs, LINEAR=is_linear, COLOURS=in_colour, NOISE=has_noise, MAP=mapped, BLOCK=_RAW_BLOCK,
            enable_fp_fusion=True,
        )  # fmt: skip
    return noisy, raw, variance


def _signed(keys: Sequence[int]) -> Tensor:
    """Keys below 2^64 as int64, bit by bit."""
    return torch.tensor([key - 2**64 if key >= 2**63 else key for key in keys], dtype=torch.int64)


@triton.jit
def _axis(x, NODES: tl.constexpr):  # type: ignore[no-untyped-def]
    """Find the node below a position on the table's axis, and the share of the next."""
    x = tl.minimum(tl.maximum(x, 0.0), NODES - 1.0)
    node = tl.minimum(x.to(tl.int32), NODES - 2)
    return node, x - node.to(tl.float32)


@triton.jit
def _plane(table, at, u, v, NODES: tl.constexpr):  # type: ignore[no-untyped-def]
    """Interpolate along two axes; ``at`` is the nearer corner."""
    low = tl.load(table + at) * (1.0 - u) + tl.load(table + at + 4) * u
    high = tl.load(table + at + 4 * NODES) * (1.0 - u) + tl.load(table + at + 4 * NODES + 4) * u
    return low * (1.0 - v) + high * v


@triton.jit
def _read(table, at, u, v, t, NODES: tl.constexpr):  # type: ignore[no-untyped-def]
    """Interpolate along all three axes."""
    near = _plane(table, at, u, v, NODES)
    return near * (1.0 - t) + _plane(table, at + 4 * NODES * NODES, u, v, NODES) * t


@triton.jit
def _curve(curve, x, ENTRIES: tl.constexpr):  # type: ignore[no-untyped-def]
    """Interpolate a picture's curve."""
    node, share = _axis(x, ENTRIES)
    low = tl.load(curve + node)
    return low + (tl.load(curve + node + 1) - low) * share


@triton.jit
def _linear(  # type: ignore[no-untyped-def]
    srgb, table, curve, pixel, size, inside, scale, NODES: tl.constexpr, ENTRIES: tl.constexpr, LINEAR: tl.constexpr
):
    """Read pixels of planes of ``size`` as linear light, through a curve or the table, or as they are."""
    r = tl.load(srgb + pixel, mask=inside, other=0).to(tl.float32)
    g = tl.load(srgb + size + pixel, mask=inside, other=0).to(tl.float32)
    b = tl.load(srgb + 2 * size + pixel, mask=inside, other=0).to(tl.float32)

    if not LINEAR:
        r, g, b = r * scale, g * scale, b * scale
        if ENTRIES:
            r, g, b = _curve(curve, r, ENTRIES), _curve(curve, g, ENTRIES), _curve(curve, b, ENTRIES)
        else:
            red, u = _axis(r, NODES)
            green, v = _axis(g, NODES)
            blue, t = _axis(b, NODES)
            at = ((blue * NODES + green) * NODES + red) * 4
            r = _read(table, at, u, v, t, NODES)
            g = _read(table, at + 1, u, v, t, NODES)
            b = _read(table, at + 2, u, v, t, NODES)
    return r, g, b


@triton.jit
def _light(srgb, table, light, size, scale, NODES: tl.constexpr, BLOCK: tl.constexpr):  # type: ignore[no-untyped-def]
    """Convert every pixel to linear light by the table."""
    pixel = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside = pixel < size
    plane = size.to(tl.int64)
    picture = tl.program_id(1).to(tl.int64) * 3 * plane
    r, g, b = _linear(srgb + picture, table, table, pixel, plane, inside, scale, NODES, 0, False)
    tl.store(light + picture + pixel, r, mask=inside)
    tl.store(light + picture + plane + pixel, g, mask=inside)
    tl.store(light + picture + 2 * plane + pixel, b, mask=inside)


@triton.jit
def _tap(taps, distance):  # type: ignore[no-untyped-def]
    """The weight of a pixel at a distance of -2 to 2."""
    return tl.load(taps + tl.where(distance < 0, -distance, distance))


@triton.jit
def _row(colour, k, r, g, b):  # type: ignore[no-untyped-def]
    """Multiply row ``k`` of the matrix (3: the mean of its rows) by a colour."""
    return tl.load(colour + 3 * k) * r + tl.load(colour + 3 * k + 1) * g + tl.load(colour + 3 * k + 2) * b


@triton.jit
def _channel(colour, k, r, g, b, m, shade):  # type: ignore[no-untyped-def]
    """Compute channel ``k`` of x4 times the mask; ``m`` is 1 in the highlights that the gains spare."""
    return _row(colour, k, r, g, b) * (tl.load(colour + 12 + k) + m * tl.load(colour + 15 + k)) * shade


@triton.jit
def _shade(frame, shading, row, column):  # type: ignore[no-untyped-def]
    """Compute the mask at a pixel."""
    i, j = row.to(tl.float32), column.to(tl.float32)
    y = tl.load(frame) + i * tl.load(frame + 2) + j * tl.load(frame + 4)
    x = tl.load(frame + 1) + i * tl.load(frame + 3) + j * tl.load(frame + 5)
    vertical = tl.load(shading) * y * y
    return tl.exp2(-(vertical + (tl.load(shading + 1) * y + tl.load(shading + 2) * x) * x))


@triton.jit
def _attention(attention, r, g, b, NODES: tl.constexpr):  # type: ignore[no-untyped-def]
    """Look up the gain of a colour."""
    red, u = _axis(r * (NODES - 1.0), NODES)
    green, v = _axis(g * (NODES - 1.0), NODES)
    blue, t = _axis(b * (NODES - 1.0), NODES)
    return _read(attention, ((blue * NODES + green) * NODES + red) * 4, u, v, t, NODES)


@triton.jit
def _site(  # type: ignore[no-untyped-def]
    srgb, table, curve, attention, colour, frame, shading, taps, raw, cell, h, w, scale, knee, white,
    SITE: tl.constexpr, PLANE: tl.constexpr, NODES: tl.constexpr, ENTRIES: tl.constexpr, ATTENDS: tl.constexpr,
    SHADES: tl.constexpr, BLURS: tl.constexpr, LINEAR: tl.constexpr, COLOURS: tl.constexpr,
):  # fmt: skip
    """Convert a site of the cells and return its signal; SITE is row + 2 column + 4 colour.

    The signal is written to plane PLANE of packed RAW, or, with COLOURS, all three colours are to RAW of full size.
    """
    size = h.to(tl.int64) * w
    inside = cell < h * w
    row, column = cell // w * 2 + SITE % 2, cell % w * 2 + SITE // 2 % 2
    here = row.to(tl.int64) * (2 * w) + column

    if BLURS:
        zero = (cell * 0).to(tl.float32)
        r, g, b = zero, zero, zero
        for i in range(-2, 3):
            line = tl.minimum(tl.maximum(row + i, 0), 2 * h - 1).to(tl.int64) * (2 * w)
            r_line, g_line, b_line = zero, zero, zero
            for j in range(-2, 3):
                pixel = line + tl.minimum(tl.maximum(column + j, 0), 2 * w - 1)
                red, green, blue = _linear(srgb, table, curve, pixel, 4 * size, inside, scale, NODES, ENTRIES, LINEAR)
                weight = _tap(taps, j)
                r_line, g_line, b_line = r_line + weight * red, g_line + weight * green, b_line + weight * blue
            weight = _tap(taps, i)
            r, g, b = r + weight * r_line, g + weight * g_line, b + weight * b_line
    else:
        r, g, b = _linear(srgb, table, curve, here, 4 * size, inside, scale, NODES, ENTRIES, LINEAR)

    m = tl.minimum(tl.maximum((_row(colour, 3, r, g, b) - knee) / (1.0 - knee), 0.0), 1.0)
    shade = 1.0
    if SHADES:
        shade = _shade(frame, shading, row, column)

    gain = 1.0
    if ATTENDS:
        red = _channel(colour, 0, r, g, b, m * m, shade)
        green = _channel(colour, 1, r, g, b, m * m, shade)
        blue = _channel(colour, 2, r, g, b, m * m, shade)
        gain = _attention(attention, red, green, blue, NODES)

    x4 = tl.minimum(_channel(colour, SITE // 4, r, g, b, m * m, shade) * gain, white)
    if COLOURS:
        for k in tl.static_range(3):
            value = tl.minimum(_channel(colour, k, r, g, b, m * m, shade) * gain, white)
            tl.store(raw + 4 * k * size + here, value, mask=inside)
    else:
        tl.store(raw + PLANE * size + cell, x4, mask=inside)
    return x4


@triton.jit
def _raw_cells(  # type: ignore[no-untyped-def]
    srgb, table, curves, attention, colour, frame, shading, taps, levels, keys, raw, noisy, variance,
    h, w, scale, knee, white, S0: tl.constexpr, S1: tl.constexpr, S2: tl.constexpr, S3: tl.constexpr,
    NODES: tl.constexpr, ENTRIES: tl.constexpr, ATTENDS: tl.constexpr, SHADES: tl.constexpr, BLURS: tl.constexpr,
    LINEAR: tl.constexpr, COLOURS: tl.constexpr, NOISE: tl.constexpr, MAP: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    picture = tl.program_id(1).to(tl.int64)
    cell = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    size = h.to(tl.int64) * w
    planes = 12 if COLOURS else 4
    x, y = srgb + picture * 12 * size, raw + picture * planes * size
    c, f, curve, t = colour + picture * 18, frame + picture * 6, curves + picture * ENTRIES, taps + picture * 3
    red = _site(x, table, curve, attention, c, f, shading, t, y, cell, h, w, scale, knee, white,
                S0, 0, NODES, ENTRIES, ATTENDS, SHADES, BLURS, LINEAR, COLOURS)  # fmt: skip
    green_r = _site(x, table, curve, attention, c, f, shading, t, y, cell, h, w, scale, knee, white,
                    S1, 1, NODES, ENTRIES, ATTENDS, SHADES, BLURS, LINEAR, COLOURS)  # fmt: skip
    green_b = _site(x, table, curve, attention, c, f, shading, t, y, cell, h, w, scale, knee, white,
                    S2, 2, NODES, ENTRIES, ATTENDS, SHADES, BLURS, LINEAR, COLOURS)  # fmt: skip
    blue = _site(x, table, curve, attention, c, f, shading, t, y, cell, h, w, scale, knee, white,
                 S3, 3, NODES, ENTRIES, ATTENDS, SHADES, BLURS, LINEAR, COLOURS)  # fmt: skip
    if NOISE:
        at = picture * 4 * size + cell
        _add_noise(red, green_r, green_b, blue, levels + 2 * picture, tl.load(keys + picture), noisy, variance,
                   cell, at, size, cell < h * w, white, MAP)  # fmt: skip


def shot_read(clean: Tensor, levels: Tensor, keys: Sequence[int], white: float, mapped: bool) -> tuple[Tensor, Tensor]:
    """Add shot and read noise to clean RAW, as :func:`rawaug.kernels.cpu.shot_read` does, on a GPU.

    Args:
        clean: packed ``(B, 4, h, w)``, float32.
        levels: ``(B, 2)``, shot_var and read_var of each picture.
        keys: one number below 2^64 for each picture.
        white: the value to clip at.
        mapped: whether to compute the variance map; it is empty otherwise.
    """
    clean = clean.detach().contiguous()
    batch, _, height, width = clean.shape
    noisy = torch.empty_like(clean)
    variance = torch.empty_like(noisy if mapped else noisy[:, :, :0])
    levels, seeds = move_together([levels.float().contiguous(), _signed(keys)], clean.device)

    grid = (triton.cdiv(height * width, _NOISE_BLOCK), batch)
    with torch.cuda.device_of(clean):  # which need not be the current one
        _noise_cells[grid](
            clean, levels, seeds, noisy, variance, height * width, white, mapped,
            BLOCK=_NOISE_BLOCK, enable_fp_fusion=True,
        )  # fmt: skip
    return noisy, variance


@triton.jit
def _sine(turn):  # type: ignore[no-untyped-def]
    """Compute the sine as on the CPU: fold the angle to a quarter turn about 0, then an odd polynomial."""
    folded = tl.where(turn > 1073741824, 2147483647 - turn + 1, turn)
    folded = tl.where(turn < -1073741824, -2147483647 - turn - 1, folded)
    x = folded.to(tl.float32) * 9.313225746154785e-10
    s = x * x
    return x * ((((1.5167854e-4 * s - 4.6741581e-3) * s + 0.079689927) * s - 0.64596379) * s + 1.57079637)


@triton.jit
def _pair(u, turn):  # type: ignore[no-untyped-def]
    """Turn two words into two normals (Box and Muller)."""
    radius = tl.sqrt(-2.0 * tl.log((u.to(tl.float32) + 0.5) * 2.3283064365386963e-10))
    turn = turn.to(tl.int32, bitcast=True)
    return radius * _sine(turn + 1073741824), radius * _sine(turn)


@triton.jit
def _disturb(y, normal, noisy, variance, at, inside, shot, read, white, MAP: tl.constexpr):  # type: ignore[no-untyped-def]
    value = tl.minimum(y + tl.sqrt(shot * tl.maximum(y, 0.0) + read) * normal, white)
    tl.store(noisy + at, value, mask=inside)
    if MAP:
        tl.store(variance + at, shot * tl.maximum(value, 0.0) + read, mask=inside)


@triton.jit
def _add_noise(  # type: ignore[no-untyped-def]
    red, green_r, green_b, blue, levels, key, noisy, variance, cell, at, size, inside, white, MAP: tl.constexpr
):
    """Add noise to the four signals of cells, and write them from ``at`` on."""
    shot, read = tl.load(levels), tl.load(levels + 1)
    a, b, c, d = tl.randint4x(key, cell)
    n0, n1 = _pair(a, b)
    n2, n3 = _pair(c, d)
    _disturb(red, n0, noisy, variance, at, inside, shot, read, white, MAP)
    _disturb(green_r, n1, noisy, variance, at + size, inside, shot, read, white, MAP)
    _disturb(green_b, n2, noisy, variance, at + 2 * size, inside, shot, read, white, MAP)
    _disturb(blue, n3, noisy, variance, at + 3 * size, inside, shot, read, white, MAP)


@triton.jit
def _noise_cells(clean, levels, keys, noisy, variance, cells, white, MAP: tl.constexpr, BLOCK: tl.constexpr):  # type: ignore[no-untyped-def]
    picture = tl.program_id(1).to(tl.int64)
    cell = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside = cell < cells
    size = cells.to(tl.int64)
    at = picture * 4 * size + cell

    red = tl.load(clean + at, mask=inside, other=0.0)
    green_r = tl.load(clean + at + size, mask=inside, other=0.0)
    green_b = tl.load(clean + at + 2 * size, mask=inside, other=0.0)
    blue = tl.load(clean + at + 3 * size, mask=inside, other=0.0)
    _add_noise(red, green_r, green_b, blue, levels + 2 * picture, tl.load(keys + picture), noisy, variance,
               cell, at, size, inside, white, MAP)  # fmt: skip
