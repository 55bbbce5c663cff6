r"""Noise at a stated PSNR of the pairs.

A picture of mean signal m has noise of mean square ``shot_var m + read_var`` before the clip at white, and multiplying
both variances by s shifts the PSNR of every pair by ``-10 log10(s)``. So a mean PSNR of P requires the factor

    s = 10^((P_0 - P) / 10),        P_0 = mean(-10 log10(shot_var m + read_var))

over draws of the law and the pictures' m. Conde et al., AAAI 2022, state P = 41.18 dB for their training pairs.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from rawaug.noise.levels import NoiseLevels
from rawaug.noise.models import NOISE, ShotReadNoise
from rawaug.noise.names import noise_levels
from rawaug.seeding import keyed_generator

TYPICAL_SIGNAL = 0.104
"""Geometric mean of the mean signals of 137 photographs, each made RAW by four draws of the ISP ``universal``."""

_DRAWS = 2**14
"""Number of draws of the law over which the uncalibrated PSNR is averaged."""


class ScaledLevels:
    """The levels of a law, with both variances multiplied by a factor."""

    def __init__(self, law: NoiseLevels, factor: float) -> None:
        self.law, self.factor = law, factor

    def sample(self, batch: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """Draw levels from the law and multiply them, ``(batch,)``."""
        shot_var, read_var = self.law.sample(batch, generator)
        return shot_var * self.factor, read_var * self.factor


@NOISE.register("CalibratedNoise")
class CalibratedNoise(ShotReadNoise):
    """Shot and read noise at a stated mean PSNR of the pairs; the ratio of read to shot noise is that of the law.

    A recipe writes it as ``noise: {pair_psnr: 41.18}``.

    Args:
        pair_psnr: mean PSNR over all pairs, in dB; single pairs scatter around it as the law and the pictures do.
        signal: mean signal of the clean RAW, a number or one for each of some pictures. A recipe measures it on crops
            of its pictures through its ISP; elsewhere :meth:`rawaug.RawAugment.measure_signals` does so. The default is
            that of photographs made RAW by ``universal``.
        levels: the law to scale, as :func:`rawaug.noise.noise_levels` knows it.

    Raises:
        ValueError: if the PSNR is not finite, a signal is not in (0, 1], or the law has no noise.
    """

    levels: ScaledLevels

    def __init__(
        self,
        pair_psnr: float,
        signal: float | Sequence[float] | None = None,
        levels: str | Sequence[float] | Sequence[str] = "cycleisp_sidd",
    ) -> None:
        if not math.isfinite(pair_psnr):
            raise ValueError(f"pair_psnr must be finite, got {pair_psnr}")

        self.pair_psnr, self.levels_to_scale = pair_psnr, levels
        self.is_typical = signal is None
        """Whether the signal is only that of typical pictures, which :meth:`at_signals` replaces."""

        if signal is None:
            signal = TYPICAL_SIGNAL
        signals = list(signal) if isinstance(signal, Sequence) else [signal]
        if not signals or not all(0.0 < mean <= 1.0 for mean in signals):
            raise ValueError(f"signal: mean signals must be above 0 and at most 1, got {signal}")

        law = noise_levels(levels)
        uncalibrated = _mean_psnr(law, signals)
        if not math.isfinite(uncalibrated):
            raise ValueError(f"levels {levels!r} have no noise, which no factor brings to {pair_psnr:g} dB")

        factor = 10.0 ** ((uncalibrated - pair_psnr) / 10.0)
        super().__init__(ScaledLevels(law, factor))

    def at_signals(self, signals: Sequence[float]) -> CalibratedNoise:
        """Make the same noise for pictures of these mean signals."""
        return CalibratedNoise(self.pair_psnr, signals, self.levels_to_scale)


def _mean_psnr(law: NoiseLevels, signals: list[float]) -> float:
    """Compute P_0 of the module, in dB; it is infinite without noise."""
    shot_var, read_var = law.sample(_DRAWS, keyed_generator(0, "pair_psnr"))
    shot_noise = torch.outer(torch.tensor(signals, dtype=torch.float64), shot_var.double())
    mean_square = shot_noise + read_var.double()
    return -10.0 * float(mean_square.log10().mean())
