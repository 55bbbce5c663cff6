r"""Normal numbers by counting: number k of cell i is a function of (key, i, k) alone.

.. math:: (w_0, w_1, w_2, w_3) = \mathrm{Philox4x32\text{-}10}(i; key), \qquad
    n_{0, 1} = \sqrt{-2 \ln u(w_0)} \, (\cos, \sin)(2 \pi w_1 / 2^{32}), \quad u(w) = (w + 1/2) / 2^{32}

and likewise :math:`n_{2, 3}` from :math:`w_2, w_3` (Salmon et al., "Parallel random numbers: as easy as 1, 2, 3", SC
2011; Box and Muller 1958). One call makes the four normals of a Bayer cell, up to 6.7 standard deviations. As nothing
is carried from one cell to the next, pixels can be made in any order, on any number of threads.

This is the definition in PyTorch, for where nothing can be compiled; :mod:`rawaug.kernels.noise_numba` is fast.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

MULTIPLIERS = (0xD2511F53, 0xCD9E8D57)
INCREMENTS = (0x9E3779B9, 0xBB67AE85)
ROUNDS = 10

_LOW = 0xFFFFFFFF


def words(key: int, counters: Tensor) -> Tensor:
    """Philox4x32-10 of int64 ``counters`` ``(n,)`` below 2^32, under a key below 2^64: int64 ``(4, n)`` below 2^32.

    Example:
        >>> [hex(word) for word in words(0, torch.zeros(1, dtype=torch.int64))[:, 0].tolist()]
        ['0x6627e8d5', '0xe169c58d', '0xbc57ac4c', '0x9b00dbd8']
    """
    zero = torch.zeros_like(counters)
    a, b, c, d = counters, zero, zero, zero
    low, high = key & _LOW, key >> 32
    for _ in range(ROUNDS):
        (high_a, low_a), (high_c, low_c) = _product(a, MULTIPLIERS[0]), _product(c, MULTIPLIERS[1])
        a, b, c, d = high_c ^ b ^ low, low_c, high_a ^ d ^ high, low_a
        low, high = (low + INCREMENTS[0]) & _LOW, (high + INCREMENTS[1]) & _LOW
    return torch.stack([a, b, c, d])


def normals(key: int, height: int, width: int) -> Tensor:
    """Standard normal float32 ``(4, height, width)``: the four planes of a packed picture, cells counted row by row."""
    w = words(key, torch.arange(height * width))
    radius = (w[0::2].float() + 0.5).mul_(2.0**-32).log_().mul_(-2.0).sqrt_()
    turn = torch.where(w[1::2] < 2**31, w[1::2], w[1::2] - 2**32).double().mul_(2.0 * math.pi / 2**32)
    drawn = torch.stack([radius * turn.cos().float(), radius * turn.sin().float()], dim=1)
    return drawn.reshape(4, height, width)


def _product(x: Tensor, factor: int) -> tuple[Tensor, Tensor]:
    """High and low 32 bits of a product of 32-bit numbers: int64 has room for the halves' products alone."""
    upper, lower = (x >> 16) * factor, (x & 0xFFFF) * factor
    high = (upper + (lower >> 16)) >> 16
    return high, ((upper << 16) + lower) & _LOW
