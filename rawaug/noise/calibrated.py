r"""Noise levels scaled so that noisy/clean pairs have a stated mean PSNR.

A picture of mean signal m has noise of mean square ``shot_var m + read_var``, before the clip at white. A factor s on
both variances shifts every pair's PSNR by ``-10 log10(s)``, so that the factor follows without a search:

    s = 10^((P_0 - P) / 10),        P_0 = mean(-10 log10(shot_var m + read_var))

over draws of the law and the pictures' m. Conde et al., AAAI 2022, state P = 41.18 dB for their training pairs.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from rawaug.noise.by_name import noise_levels
from rawaug.noise.levels import NoiseLevels
from rawaug.noise.models import ShotReadNoise
from rawaug.registry import NOISE
from rawaug.seeding import keyed_generator

_DRAWS = 2**14

TYPICAL_SIGNAL = 0.06
"""Geometric mean of the mean signals of photographs that the ISP ``universal`` made RAW."""


class ScaledLevels:
    """The levels of a law, both variances times a factor.

    Example:
        >>> from rawaug.noise import FixedLevels
        >>> shot_var, read_var = ScaledLevels(FixedLevels(1e-3, 1e-5), 0.5).sample(1, torch.Generator())
        >>> round(shot_var.item(), 6)
        0.0005
    """

    def __init__(self, law: NoiseLevels, factor: float) -> None:
        self.law, self.factor = law, factor

    def sample(self, batch: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        shot_var, read_var = self.law.sample(batch, generator)
        return shot_var * self.factor, read_var * self.factor


def expected_pair_psnr(law: NoiseLevels, signal: Sequence[float]) -> float:
    """P_0: mean PSNR in dB of pairs whose clean pictures have these mean signals; the same at every call."""
    shot_var, read_var = law.sample(_DRAWS, keyed_generator(0, "pair_psnr"))
    square = torch.outer(torch.tensor(signal, dtype=torch.float64), shot_var.double()) + read_var.double()
    return -10.0 * float(square.log10().mean())


@NOISE.register("CalibratedNoise")
class CalibratedNoise(ShotReadNoise):
    """Shot and read noise at a stated mean PSNR of the pairs; the ratio of read to shot noise is that of the law.

    In recipes ``noise: {pair_psnr: 41.18}``.

    Args:
        pair_psnr: in dB, over all pairs; a single one scatters as the law and the pictures do.
        signal: mean signal of the clean RAW, a number or one for each of some pictures; by default that of photographs
            made RAW by ``universal``.
        levels: the law that is scaled, as :func:`rawaug.noise.noise_levels` knows it.

    Raises:
        ValueError: if the PSNR is not finite, a signal is not in (0, 1], or the law has no noise.

    Example:
        >>> round(CalibratedNoise(41.18, 0.1, (1e-3, 0.0)).levels.factor, 4)
        0.7621
    """

    levels: ScaledLevels

    def __init__(
        self,
        pair_psnr: float,
        signal: float | Sequence[float] = TYPICAL_SIGNAL,
        levels: str | Sequence[float] | Sequence[str] = "cycleisp_sidd",
    ) -> None:
        signals = list(signal) if isinstance(signal, Sequence) else [signal]
        if not math.isfinite(pair_psnr):
            raise ValueError(f"pair_psnr must be finite, got {pair_psnr}")
        if not signals or not all(0.0 < mean <= 1.0 for mean in signals):
            raise ValueError(f"signal: mean signals must be above 0 and at most 1, got {signal}")
        law = noise_levels(levels)
        uncalibrated = expected_pair_psnr(law, signals)
        if not math.isfinite(uncalibrated):
            raise ValueError(f"levels {levels!r} have no noise, which no factor brings to {pair_psnr:g} dB")
        super().__init__(ScaledLevels(law, 10.0 ** ((uncalibrated - pair_psnr) / 10.0)))
