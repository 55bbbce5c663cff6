"""Shot and read noise in one pass over the picture, compiled: draw, scale, add, clip, and the variance map.

``noisy = min(y + sqrt(shot_var max(y, 0) + read_var) n, white)`` with the normals n of :mod:`rawaug.kernels.philox`;
the logarithm and the sine that these take are polynomials here, within 1e-6 of the definition.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from rawaug.kernels.compiled import compiled, over_rows, part
from rawaug.kernels.philox import INCREMENTS, MULTIPLIERS, ROUNDS

_TILE = 512
"""Cells that are worked on at a time: what is kept of them stays in the fastest cache."""

_M0, _M1 = (np.uint64(m) for m in MULTIPLIERS)
_K0, _K1 = (np.uint32(k) for k in INCREMENTS)
_32 = np.uint64(32)
_QUARTER_TURN = np.int32(2**30)

# Least greatest error, in falling powers: ln(1 + m) / m within 2.6e-8 on sqrt(1/2) - 1 <= m <= sqrt(2) - 1, and
# sin(pi / 2 sqrt(s)) / sqrt(s) within 6.7e-9 on [0, 1].
_LOG = tuple(
    np.float32(c)
    for c in (0.08960108, -0.14482562, 0.14917466, -0.16543691, 0.19958405, -0.25002947, 0.3333416, -0.49999979, 1.0)
)
_SINE = tuple(np.float32(c) for c in (1.5167854e-4, -4.6741581e-3, 0.079689927, -0.64596379, 1.57079637))


def shot_read(
    clean: Tensor, levels: Tensor, keys: list[int], white: float, with_variance: bool
) -> tuple[Tensor, Tensor]:
    """Noisy RAW and its variance map, float32 ``(B, 4, h, w)`` on the CPU.

    Args:
        clean: float32 ``(B, 4, h, w)`` on the CPU.
        levels: ``(B, 2)`` shot_var and read_var.
        keys: one per picture, below 2^64.
        white: where the noisy signal is clipped; infinity for nowhere.
        with_variance: without it, the second result is empty.
    """
    noisy = torch.empty_like(clean, memory_format=torch.contiguous_format)
    variance = torch.empty_like(noisy if with_variance else noisy[:, :, :0])
    signal, out = clean.detach().contiguous().numpy(), noisy.numpy()
    if not noisy.numel():
        return noisy, variance
    var = variance.numpy() if with_variance else None  # then no code is compiled for it
    variances = levels.detach().to("cpu", torch.float32).numpy()
    key = np.array([(k & 0xFFFFFFFF, k >> 32) for k in keys], dtype=np.uint32)
    ceiling = np.float32(white)
    batch, _, height, width = clean.shape
    over_rows(batch * height, 4 * width, lambda a, b: _rows(signal, variances, key, ceiling, out, var, a, b))
    return noisy, variance


@part
def _words(key, first, count, words):  # type: ignore[no-untyped-def]
    for i in range(count):
        a, b, c, d = np.uint32(first + i), np.uint32(0), np.uint32(0), np.uint32(0)
        low, high = key[0], key[1]
        for _ in range(ROUNDS):
            p, q = np.uint64(a) * _M0, np.uint64(c) * _M1
            a, b = np.uint32(q >> _32) ^ b ^ low, np.uint32(q)
            c, d = np.uint32(p >> _32) ^ d ^ high, np.uint32(p)
            low, high = np.uint32(low + _K0), np.uint32(high + _K1)
        words[0, i], words[1, i], words[2, i], words[3, i] = a, b, c, d


@part
def _log(x):  # type: ignore[no-untyped-def]
    """Natural logarithm of a positive, normal float32: exponent, and a polynomial in the mantissa about 1."""
    bits = np.float32(x).view(np.int32)
    exponent = (bits - np.int32(0x3F3504F3)) >> np.int32(23)  # mantissa in [1 / sqrt(2), sqrt(2))
    m = np.int32(bits - (exponent << np.int32(23))).view(np.float32) - np.float32(1)
    p = _LOG[0]
    for k in range(1, len(_LOG)):
        p = p * m + _LOG[k]
    return np.float32(exponent) * np.float32(math.log(2)) + m * p


@part
def _sine(turn):  # type: ignore[no-untyped-def]
    """Sine of an angle in units of 2^-32 turns: folded to a quarter turn about 0, then an odd polynomial."""
    folded = turn
    if turn > _QUARTER_TURN or turn < -_QUARTER_TURN:
        folded = np.int32(np.int32(-(2**31)) - turn)
    x = np.float32(folded) * np.float32(2.0**-30)
    square = x * x
    p = _SINE[0]
    for k in range(1, len(_SINE)):
        p = p * square + _SINE[k]
    return x * p


@part
def _normals(words, count, normals):  # type: ignore[no-untyped-def]
    for pair in (0, 2):
        for i in range(count):
            u = (np.float32(words[pair, i]) + np.float32(0.5)) * np.float32(2.0**-32)
            square = np.float32(-2) * _log(u)
            radius = np.sqrt(square if square > np.float32(0) else np.float32(0))
            turn = np.int32(words[pair + 1, i])
            normals[pair, i] = radius * _sine(np.int32(turn + _QUARTER_TURN))
            normals[pair + 1, i] = radius * _sine(turn)


@part
def _disturb(signal, normals, shot, read, white, noisy):  # type: ignore[no-untyped-def]
    for j in range(len(signal)):
        y = signal[j]
        light = y if y > np.float32(0) else np.float32(0)
        value = y + np.sqrt(shot * light + read) * normals[j]
        noisy[j] = white if value > white else value


@part
def _law(noisy, shot, read, variance):  # type: ignore[no-untyped-def]
    for j in range(len(noisy)):
        light = noisy[j] if noisy[j] > np.float32(0) else np.float32(0)
        variance[j] = shot * light + read


@compiled
def _rows(clean, levels, keys, white, noisy, variance, start, stop):  # type: ignore[no-untyped-def]
    """Rows ``start`` to ``stop`` of the batch's rows of cells, one picture's after the other's."""
    height, width = clean.shape[2], clean.shape[3]
    words, normals = np.empty((4, _TILE), np.uint32), np.empty((4, _TILE), np.float32)
    for row in range(start, stop):
        b, i = divmod(row, height)
        shot, read = levels[b, 0], levels[b, 1]
        for left in range(0, width, _TILE):
            count = min(_TILE, width - left)
            right = left + count
            _words(keys[b], i * width + left, count, words)
            _normals(words, count, normals)
            for k in range(4):
                _disturb(clean[b, k, i, left:right], normals[k], shot, read, white, noisy[b, k, i, left:right])
                if variance is not None:
                    _law(noisy[b, k, i, left:right], shot, read, variance[b, k, i, left:right])
