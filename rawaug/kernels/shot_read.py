"""Shot and read noise by counting, as in :mod:`rawaug.kernels.reference`, as loops for the CPU, compiled by Numba."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from rawaug.kernels.reference import INCREMENTS, MULTIPLIERS, ROUNDS
from rawaug.kernels.runtime import compile_loop, compile_part, run_over_rows
from rawaug.kernels.vectors import at_least, clip

_TILE = 512
"""A tile has this many cells of noise."""

_ZERO, _ONE = np.float32(0), np.float32(1)
_M0, _M1 = np.uint64(MULTIPLIERS[0]), np.uint64(MULTIPLIERS[1])
_K0, _K1 = np.uint32(INCREMENTS[0]), np.uint32(INCREMENTS[1])
_32 = np.uint64(32)
_QUARTER_TURN = np.int32(2**30)


def _polynomial(*coefficients: float) -> tuple[np.float32, ...]:
    """Store the coefficients of a polynomial, in falling powers."""
    return tuple(np.float32(coefficient) for coefficient in coefficients)


_LOG = _polynomial(
    0.08960108, -0.14482562, 0.14917466, -0.16543691, 0.19958405, -0.25002947, 0.3333416, -0.49999979, 1.0
)
"""This approximates ln(1 + m) / m, within 2.6e-8 for 1 + m between sqrt(1/2) and sqrt(2)."""

_SINE = _polynomial(1.5167854e-4, -4.6741581e-3, 0.079689927, -0.64596379, 1.57079637)
"""This approximates sin(pi / 2 sqrt(s)) / sqrt(s), within 6.7e-9 on [0, 1]."""


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
    settings = (
        clean.detach().contiguous().numpy(),
        levels.detach().to("cpu", torch.float32).numpy(),
        np.array([(key & 0xFFFFFFFF, key >> 32) for key in keys], dtype=np.uint32),
        np.float32(white),
        noisy.numpy(),
        variance.numpy() if mapped else None,
    )

    def add_noise(start: int, stop: int) -> None:
        scratch = np.empty((4, _TILE), np.uint32), np.empty((4, _TILE), np.float32)
        _noise_rows(*settings, *scratch, start, stop)

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
            radius = np.sqrt(at_least(np.float32(-2) * _log(u), _ZERO))
            turn = np.int32(words[pair + 1, i])
            normals[pair, i] = radius * _sine(np.int32(turn + _QUARTER_TURN))
            normals[pair + 1, i] = radius * _sine(turn)


@compile_part
def _disturb(signal, normals, shot_var, read_var, white, noisy):  # type: ignore[no-untyped-def]
    """Add noise to a row of one plane."""
    for j in range(len(signal)):
        light = at_least(signal[j], _ZERO)
        deviation = np.sqrt(shot_var * light + read_var)
        noisy[j] = clip(signal[j] + deviation * normals[j], white)


@compile_part
def _law(noisy, shot_var, read_var, variance):  # type: ignore[no-untyped-def]
    """Compute the variance of a row of one plane."""
    for j in range(len(noisy)):
        variance[j] = shot_var * at_least(noisy[j], _ZERO) + read_var


@compile_loop
def _noise_rows(clean, levels, keys, white, noisy, variance, words, normals, start, stop):  # type: ignore[no-untyped-def]
    """Add noise to rows ``start`` to ``stop`` of all pictures' rows of cells, counted through the batch."""
    height, width = clean.shape[2], clean.shape[3]

    for row in range(start, stop):
        b, i = divmod(row, height)
        shot_var, read_var = levels[b, 0], levels[b, 1]
        for first in range(0, width, _TILE):
            count = min(_TILE, width - first)
            cells = slice(first, first + count)
            _words(keys[b], i * width + first, count, words)
            _normals(words, count, normals)

            for k in range(4):
                _disturb(clean[b, k, i, cells], normals[k], shot_var, read_var, white, noisy[b, k, i, cells])
                if variance is not None:
                    _law(noisy[b, k, i, cells], shot_var, read_var, variance[b, k, i, cells])
