r"""Tone without a network: inverse tone curves by name, mixtures of them, and the stage that applies them.

A camera's engine maps linear light l to linear display light d = t(l), monotonically, and encodes it as sRGB. The
inverse is kept as a table over the sRGB code s,

.. math:: T(s) = t^{-1}(\mathrm{EOTF}(s)), \qquad s = 0, \tfrac{1}{4 \cdot 255}, \dots, 1,

of which every fourth entry is an 8-bit code, without interpolation (EOTF: IEC 61966-2-1). A convex combination of
tables is monotone like the tables themselves.

The stage :class:`ToneCurve` is ``x2 = T(x)`` with ``T = sum_k v_k T_k``; it replaces the paper's tone network and
gamma. The forward pass looks the code up on the same curve; if the curve is flat, it takes the lowest code. A fit bends
a standard's curve :math:`T_0` by scaling its slope on each of 51 pieces of five codes:

.. math:: T(s) = \int_0^s e^{l(u)} T_0'(u) \, du \Big/ \int_0^1 e^{l(u)} T_0'(u) \, du .
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor, nn

from rawaug.camera.samplers import sparse_shares
from rawaug.isp.config import ISPConfig, ISPParams
from rawaug.isp.stages import STAGES, BatchParams, Stage
from rawaug.kernels.reference import apply_curves
from rawaug.seeding import Generators

STEPS = 4
"""Number of entries of a table for each 8-bit level."""
NODES = 255 * STEPS + 1
PIECES = 51
"""Number of pieces of a curve whose slopes a fit scales."""
_TONES_MIXED = 3


def srgb_to_linear(code: Tensor) -> Tensor:
    """The sRGB transfer function: codes in [0, 1], of any shape, to linear display light in [0, 1]."""
    return torch.where(code <= 0.04045, code / 12.92, ((code + 0.055) / 1.055).clamp_min(0.0) ** 2.4)


def to_linear(srgb: Tensor, tables: Tensor) -> Tensor:
    """Map pictures ``(B, C, H, W)``, uint8 or float in [0, 1], each by its own table ``(B, 1021)``, to linear light."""
    if srgb.dtype == torch.uint8:
        tables = tables[:, ::STEPS]
    return apply_curves(tables, srgb)


def to_code(linear: Tensor, tables: Tensor) -> Tensor:
    """Invert :func:`to_linear`: linear light ``(B, C, H, W)``, held to [0, 1], to sRGB codes in [0, 1], float32."""
    light = linear.clamp(0.0, 1.0).flatten(1).to(tables)
    right = torch.searchsorted(tables, light).clamp(1, NODES - 1)

    low, high = tables.gather(1, right - 1), tables.gather(1, right)
    share = ((light - low) / (high - low).clamp_min(1e-12)).clamp(0.0, 1.0)
    return ((right - 1 + share) / (NODES - 1)).reshape(linear.shape)


class ToneDictionary(nn.Module):
    """K inverse tone curves, sRGB code to linear light; at first all are the curve of sRGB itself."""

    curves: Tensor
    typical: Tensor

    def __init__(self, atoms: int) -> None:
        super().__init__()
        standard = srgb_to_linear(torch.linspace(0.0, 1.0, NODES))
        self.register_buffer("curves", standard.repeat(atoms, 1))
        self.register_buffer("typical", torch.full((atoms,), 1.0 / atoms))

    @classmethod
    def from_curves(cls, curves: Tensor, typical: Tensor | None = None) -> ToneDictionary:
        """Make a dictionary of curves ``(K, 1021)`` and their typical weights ``(K,)``, by default equal ones."""
        tone = cls(len(curves))
        tone.curves.copy_(curves)
        if typical is not None:
            tone.typical.copy_(typical)
        return tone

    def draw(self, batch: int, generator: Generators) -> Tensor:
        """Draw weights ``(batch, K)``: mixtures of up to three curves, most of them near one curve."""
        atoms, shares = sparse_shares(batch, len(self.curves), _TONES_MIXED, generator)
        weights = np.zeros((batch, len(self.curves)))
        rows = np.arange(batch)
        for atom, share in zip(atoms.T, shares.T, strict=True):
            weights[rows, atom] += share
        return torch.from_numpy(weights).to(self.curves)

    def combine(self, weights: Tensor) -> Tensor:
        """Mix the curves by weights ``(B, K)`` into tables ``(B, 1021)``, with the same bits in a batch of any size."""
        # Weights of 0 are skipped on a CPU, unless they are being fitted. On a GPU looking for them would stall it, and
        # an exported pass has no values to look at.
        if weights.device.type != "cpu" or weights.requires_grad or torch.compiler.is_compiling():
            table = weights.new_zeros(len(weights), self.curves.shape[1])
            for weight, curve in zip(weights.unbind(1), self.curves, strict=True):
                table += weight[:, None] * curve
            return table

        shares, curves = weights.numpy(), self.curves.numpy()  # NumPy's calls cost a fifth of PyTorch's
        tables = np.zeros((len(shares), curves.shape[1]), shares.dtype)
        for table, share in zip(tables, shares, strict=True):
            for atom in np.flatnonzero(share):
                table += share[atom] * curves[atom]
        return torch.from_numpy(tables)


@STAGES.register("curve")
class ToneCurve(Stage):
    """f1 and f2 in one: each picture's inverse tone curve, or the typical one if no setting is chosen yet."""

    name, makes = "curve", 2

    def __init__(self, config: ISPConfig) -> None:
        super().__init__(config)
        if {"tone", "gamma"} & set(config.stages):
            raise ValueError(f"stages: 'curve' replaces tone and gamma, got {' '.join(config.stages)}")

        self.dictionary = ToneDictionary(config.tone_atoms)
        self.slopes: Tensor | None = None
        """l, the logarithms of the slopes on each piece, ``(K, PIECES)``, during a fit; None else."""

    def reverse(self, x: Tensor, params: ISPParams | None, coordinates: Tensor | None = None) -> Tensor:
        """Compute x2 from sRGB, both ``(B, 3, H, W)``, by each picture's curve."""
        return to_linear(x, self._curves(len(x), params))

    def forward(self, x: Tensor, params: ISPParams | None, coordinates: Tensor | None = None) -> Tensor:
        """Compute sRGB from x2, both ``(B, 3, H, W)``, by the inverse of each picture's curve."""
        return to_code(x, self._curves(len(x), params))

    def adjust(self, batch: BatchParams, params: ISPParams, place: Tensor | None, size: tuple[int, int]) -> BatchParams:
        """Put the curves ``(B, 1021)`` of ``params`` into ``batch``; ``place`` and ``size`` do not matter."""
        weights = params.tone_weights.to(batch.matrix)
        return batch._replace(curves=self.dictionary.combine(weights))

    def extra_repr(self) -> str:
        """Describe the number of curves, and their light at code 128."""
        light = self.dictionary.curves[:, 128 * STEPS].tolist()
        values = " ".join(f"{value:.3f}" for value in light)
        return f"{self.config.tone_atoms} curves, at code 128 {values}"

    def bend(self) -> Tensor:
        """The curves ``(K, 1021)``, bent by the slopes of a fit."""
        if self.slopes is None:
            return self.dictionary.curves

        factors = self.slopes.exp().repeat_interleave((NODES - 1) // PIECES, dim=1)
        rises = self.dictionary.curves.diff(dim=1) * factors
        heights = torch.nn.functional.pad(rises.cumsum(dim=1), (1, 0))
        return heights / heights[:, -1:]

    def _curves(self, batch: int, params: ISPParams | None) -> Tensor:
        """Get a curve for each picture; the typical one if none is chosen."""
        weights = self.dictionary.typical[None]
        if params is not None and params.tone_weights.shape[1]:
            weights = params.tone_weights.to(weights)
        weights = weights.expand(batch, -1)

        if self.slopes is not None:
            return weights @ self.bend()
        return self.dictionary.combine(weights)
