"""The passes of :mod:`rawaug.kernels.reference` as Triton kernels: a program works on a block of Bayer cells.

The pass to RAW reads every pixel once and writes every site once, with 3 bytes in and 4 out for each pixel. The table,
4.4 MB at 65 nodes, stays in the GPU's cache. Triton's generator is Philox4x32-10 with the cell as its counter, so the
noise is that of a CPU, except for the rounding of logarithms.
"""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

from rawaug.kernels.reference import Unprocessing

_RAW_BLOCK = 256
_NOISE_BLOCK = 512


def unprocess(srgb: Tensor, camera: Unprocessing, white: float) -> Tensor:
    """Convert sRGB ``(B, 3, H, W)``, uint8 or float32 in [0, 1], to packed RAW ``(B, 4, H/2, W/2)`` up to ``white``."""
    batch, _, height, width = srgb.shape
    h, w = height // 2, width // 2
    raw = torch.empty(batch, 4, h, w, device=srgb.device, dtype=torch.float32)

    nodes = max(camera.table.shape[0], camera.attention.shape[0])
    entries = camera.curves.shape[1] if camera.curves.numel() else 0
    largest_code = 255.0 if srgb.dtype == torch.uint8 else 1.0
    scale = ((entries or nodes) - 1) / largest_code
    sites = [i + 2 * j + 4 * channel for i, j, channel in camera.sites.tolist()]
    parts = (camera.table, camera.curves, camera.attention, camera.colour, camera.frame, camera.shading, camera.taps)
    tensors = [part.contiguous() for part in parts]
    source, is_linear = srgb.contiguous(), False
    blurs = camera.taps.numel() > 0

    with torch.cuda.device_of(srgb):  # which need not be the current one
        if blurs and not entries:  # a table is read once for each pixel, not for each neighbour
            light = torch.empty(srgb.shape, device=srgb.device, dtype=torch.float32)
            _light[(triton.cdiv(height * width, _RAW_BLOCK), batch)](
                source, tensors[0], light, height * width, scale, NODES=nodes, BLOCK=_RAW_BLOCK, enable_fp_fusion=True
            )
            source, is_linear = light, True

        _raw_cells[(triton.cdiv(h * w, _RAW_BLOCK), batch)](
            source, *tensors, raw, h, w, scale, camera.knee, white, *sites,
            NODES=nodes, ENTRIES=entries, ATTENDS=camera.attention.numel() > 0, SHADES=camera.shading.numel() > 0,
            BLURS=blurs, LINEAR=is_linear, BLOCK=_RAW_BLOCK, enable_fp_fusion=True,
        )  # fmt: skip
    return raw


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
def _site(  # type: ignore[no-untyped-def]
    srgb, table, curve, attention, colour, frame, shading, taps, raw, cell, h, w, scale, knee, white,
    SITE: tl.constexpr, NODES: tl.constexpr, ENTRIES: tl.constexpr, ATTENDS: tl.constexpr, SHADES: tl.constexpr,
    BLURS: tl.constexpr, LINEAR: tl.constexpr,
):  # fmt: skip
    """Convert one plane of the cells; SITE is row + 2 column + 4 colour of its sites."""
    size = h.to(tl.int64) * w
    inside = cell < h * w
    row, column = cell // w * 2 + SITE % 2, cell % w * 2 + SITE // 2 % 2

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
        pixel = row.to(tl.int64) * (2 * w) + column
        r, g, b = _linear(srgb, table, curve, pixel, 4 * size, inside, scale, NODES, ENTRIES, LINEAR)

    m = tl.minimum(tl.maximum((_row(colour, 3, r, g, b) - knee) / (1.0 - knee), 0.0), 1.0)
    shade = 1.0
    if SHADES:
        i, j = row.to(tl.float32), column.to(tl.float32)
        y = tl.load(frame) + i * tl.load(frame + 2) + j * tl.load(frame + 4)
        x = tl.load(frame + 1) + i * tl.load(frame + 3) + j * tl.load(frame + 5)
        vertical = tl.load(shading) * y * y
        shade = tl.exp2(-(vertical + (tl.load(shading + 1) * y + tl.load(shading + 2) * x) * x))

    x4 = _channel(colour, SITE // 4, r, g, b, m * m, shade)
    if ATTENDS:
        last = NODES - 1.0
        red, u = _axis(_channel(colour, 0, r, g, b, m * m, shade) * last, NODES)
        green, v = _axis(_channel(colour, 1, r, g, b, m * m, shade) * last, NODES)
        blue, t = _axis(_channel(colour, 2, r, g, b, m * m, shade) * last, NODES)
        x4 = x4 * _read(attention, ((blue * NODES + green) * NODES + red) * 4, u, v, t, NODES)
    tl.store(raw + cell, tl.minimum(x4, white), mask=inside)


@triton.jit
def _raw_cells(  # type: ignore[no-untyped-def]
    srgb, table, curves, attention, colour, frame, shading, taps, raw, h, w, scale, knee, white,
    S0: tl.constexpr, S1: tl.constexpr, S2: tl.constexpr, S3: tl.constexpr,
    NODES: tl.constexpr, ENTRIES: tl.constexpr, ATTENDS: tl.constexpr, SHADES: tl.constexpr,
    BLURS: tl.constexpr, LINEAR: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    picture = tl.program_id(1).to(tl.int64)
    cell = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    size = h.to(tl.int64) * w
    x, y = srgb + picture * 12 * size, raw + picture * 4 * size
    c, f, curve, t = colour + picture * 18, frame + picture * 6, curves + picture * ENTRIES, taps + picture * 3
    _site(x, table, curve, attention, c, f, shading, t, y, cell, h, w, scale, knee, white,
          S0, NODES, ENTRIES, ATTENDS, SHADES, BLURS, LINEAR)  # fmt: skip
    _site(x, table, curve, attention, c, f, shading, t, y + size, cell, h, w, scale, knee, white,
          S1, NODES, ENTRIES, ATTENDS, SHADES, BLURS, LINEAR)  # fmt: skip
    _site(x, table, curve, attention, c, f, shading, t, y + 2 * size, cell, h, w, scale, knee, white,
          S2, NODES, ENTRIES, ATTENDS, SHADES, BLURS, LINEAR)  # fmt: skip
    _site(x, table, curve, attention, c, f, shading, t, y + 3 * size, cell, h, w, scale, knee, white,
          S3, NODES, ENTRIES, ATTENDS, SHADES, BLURS, LINEAR)  # fmt: skip


def shot_read(clean: Tensor, levels: Tensor, keys: list[int], white: float, mapped: bool) -> tuple[Tensor, Tensor]:
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
    signed = [key - 2**64 if key >= 2**63 else key for key in keys]
    seeds = torch.tensor(signed, device=clean.device)
    variances = levels.to(clean.device, torch.float32).contiguous()

    grid = (triton.cdiv(height * width, _NOISE_BLOCK), batch)
    with torch.cuda.device_of(clean):  # which need not be the current one
        _noise_cells[grid](
            clean, variances, seeds, noisy, variance, height * width, white, mapped,
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
def _disturb(clean, normal, noisy, variance, at, inside, shot, read, white, MAP: tl.constexpr):  # type: ignore[no-untyped-def]
    y = tl.load(clean + at, mask=inside, other=0.0)
    value = tl.minimum(y + tl.sqrt(shot * tl.maximum(y, 0.0) + read) * normal, white)
    tl.store(noisy + at, value, mask=inside)
    if MAP:
        tl.store(variance + at, shot * tl.maximum(value, 0.0) + read, mask=inside)


@triton.jit
def _noise_cells(clean, levels, keys, noisy, variance, cells, white, MAP: tl.constexpr, BLOCK: tl.constexpr):  # type: ignore[no-untyped-def]
    picture = tl.program_id(1)
    cell = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside = cell < cells
    shot, read = tl.load(levels + 2 * picture), tl.load(levels + 2 * picture + 1)

    a, b, c, d = tl.randint4x(tl.load(keys + picture), cell)
    red, green_r = _pair(a, b)
    green_b, blue = _pair(c, d)

    size = cells.to(tl.int64)
    at = picture * 4 * size + cell
    _disturb(clean, red, noisy, variance, at, inside, shot, read, white, MAP)
    _disturb(clean, green_r, noisy, variance, at + size, inside, shot, read, white, MAP)
    _disturb(clean, green_b, noisy, variance, at + 2 * size, inside, shot, read, white, MAP)
    _disturb(clean, blue, noisy, variance, at + 3 * size, inside, shot, read, white, MAP)
