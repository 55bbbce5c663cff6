r"""The noise that "clean" references have themselves, as a share of a denoiser's squared error.

A reference is a photograph, ``r = x + m``, with noise m of its own. An error against it is ``|d - x|^2 + |m|^2`` as
far as m is independent of the denoised d, so that even a perfect denoiser has the variance of m left. Binned K x K by
colour site (:func:`rawaug.bayer.bin_mosaic`) the references have about 1 / K^2 of it.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from statistics import fmean
from typing import Any

from rawaug.data.pairs import Pair, SomePairs
from rawaug.evaluation.trials import Trial
from rawaug.noise import own_noise

MUCH = 0.1
"""Share of an error above which a line says so."""
MOST_MEASURED = 12
"""Frames measured, evenly spaced: seconds for each of 12 megapixels."""
SHOWN = 4
ADVICE = "bin the references (bin 4), or add the noise of a higher ISO"


class Measured(SomePairs):
    """Whole references whose own noise is measured as they are read, where they do not state it: of ``most`` of them,
    evenly spaced, since each takes seconds.
    """

    def __init__(self, pairs: Sequence[Pair], most: int = MOST_MEASURED) -> None:
        super().__init__(pairs)
        count = min(most, len(pairs))
        self.measured = {k * len(pairs) // count for k in range(count)}

    def read(self, index: int) -> Pair:
        pair = super().read(index)
        if pair.own_noise is not None or index not in self.measured:
            return pair
        return replace(pair, own_noise=own_noise(pair.raw, pair.cfa))


def own_noise_note(summaries: Mapping[str, Mapping[str, Any]]) -> str:
    """A line on scores that the references' own noise makes up much of; empty if there are none."""
    shares = {name: scores.get("own_noise", 0.0) for name, scores in summaries.items()}
    much = sorted((name for name, share in shares.items() if share > MUCH), key=lambda name: -shares[name])
    named = ", ".join(f"{name} {shares[name]:.0%}" for name in much[:SHOWN])
    kept = " (more than 100%: it keeps that noise)" if any(shares[name] > 1.0 for name in much) else ""
    return f"own noise of the references as a share of the squared error: {named}{kept}; {ADVICE}" if much else ""


def added_noise_note(trials: Iterable[Trial]) -> str:
    """A line on a test whose noise is hardly stronger than that of its references; empty if it is much stronger."""
    known = [
        (one.own, one.variance.mean().item()) for one in trials if one.own is not None and one.variance is not None
    ]
    own, added = (fmean(values) for values in zip(*known, strict=True)) if known else (0.0, 1.0)
    if own <= MUCH * added:
        return ""
    return (
        f"the test frames' own noise has {own / added:.0%} of the variance of the noise added to them: a perfect "
        f"denoiser would score {-10.0 * math.log10(own):.1f} dB; {ADVICE}"
    )
