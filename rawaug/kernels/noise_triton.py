"""Shot and read noise as one kernel, drawn on the device: the pass of :mod:`rawaug.kernels.noise_numba` for a GPU.

Triton's generator is the Philox4x32-10 of :mod:`rawaug.kernels.philox`, with the cell as its counter: the noise is that
of a CPU, but for the rounding of logarithms.
"""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

_BLOCK = 512


def shot_read(
    clean: Tensor, levels: Tensor, keys: list[int], white: float, with_variance: bool
) -> tuple[Tensor, Tensor]:
    """Noisy RAW and its variance map, ``(B, 4, h, w)``; arguments of :func:`rawaug.kernels.noise_numba.shot_read`."""
    clean = clean.detach().contiguous()
    batch, _, height, width = clean.shape
    noisy = torch.empty_like(clean)
    variance = torch.empty_like(noisy if with_variance else noisy[:, :, :0])
    signed = torch.tensor([key - 2**64 if key >= 2**63 else key for key in keys], device=clean.device)
    variances = levels.to(clean.device, torch.float32).contiguous()
    grid = (triton.cdiv(height * width, _BLOCK), batch)
    with torch.cuda.device_of(clean):  # which need not be the current one
        _cells[grid](
            clean,
            variances,
            signed,
            noisy,
            variance,
            height * width,
            white,
            with_variance,
            BLOCK=_BLOCK,
            enable_fp_fusion=True,
        )
    return noisy, variance


@triton.jit
def _sine(turn):  # type: ignore[no-untyped-def]
    """As in :mod:`rawaug.kernels.noise_numba`: folded to a quarter turn about 0, then an odd polynomial."""
    folded = tl.where(turn > 1073741824, 2147483647 - turn + 1, turn)
    folded = tl.where(turn < -1073741824, -2147483647 - turn - 1, folded)
    x = folded.to(tl.float32) * 9.313225746154785e-10
    s = x * x
    return x * ((((1.5167854e-4 * s - 4.6741581e-3) * s + 0.079689927) * s - 0.64596379) * s + 1.57079637)


@triton.jit
def _pair(u, turn):  # type: ignore[no-untyped-def]
    """Two normals of two words (Box and Muller)."""
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
def _cells(clean, levels, keys, noisy, variance, cells, white, MAP: tl.constexpr, BLOCK: tl.constexpr):  # type: ignore[no-untyped-def]
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
