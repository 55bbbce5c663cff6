"""Which tone a fit takes, the network or a curve: that which is better on frames that it has not seen.

For every fold both are fitted without its frames and compared on these, by PSNR_r with the as-shot gains: blind, the
guess of the gains would decide, which is the same for both.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

from rawaug.isp.fit.fit_config import FitConfig
from rawaug.isp.fit.losses import decibels
from rawaug.isp.fit.samples import PixelSamples, Shot
from rawaug.isp.model import DictionaryISP

FOLDS = 4

Refit = Callable[[Sequence[int], str, FitConfig], DictionaryISP]
"""Fits an ISP without encoders to some frames alone; the text tells its stages from those of other fits."""


def with_better_tone(
    samples: PixelSamples, shots: Sequence[Shot], config: FitConfig, refit: Refit
) -> tuple[FitConfig, float | None]:
    """The settings with ``tone`` decided, and by how many dB the curve is better where it was asked for."""
    if config.tone != "auto":
        return config, None
    if len(shots) < 2:
        return replace(config, tone="learned"), None
    gain, folds = 0.0, min(FOLDS, len(shots))
    for fold in range(folds):
        out = list(range(fold, len(shots), folds))
        kept = [k for k in range(len(shots)) if k not in out]
        part = f" without part {fold + 1} of {folds}"
        learned = refit(kept, f", learned{part}", replace(config, tone="learned"))
        curve = refit(kept, f", curve{part}", replace(config, tone="curve"))
        better = decibels(curve, samples, shots, out, True) - decibels(learned, samples, shots, out, True)
        gain += len(out) * better / len(shots)
    return replace(config, tone="curve" if gain > 0 else "learned"), gain
