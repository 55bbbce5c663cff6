r"""The noise that "clean" references have themselves, as a share of a denoiser's squared error.

A reference is a photograph, ``r = x + m``, with noise m of its own. An error against it is ``|d - x|^2 + |m|^2`` as
far as m is independent of the denoised d, so that even a perfect denoiser has the variance of m left. Binned K x K by
colour site (:func:`rawaug.bayer.bin_mosaic`) the references have about 1 / K^2 of it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from statistics import fmean
from typing import Any, NamedTuple

from rawaug.bayer import noise_variance
from rawaug.data.pairs import Binned, Pair
from rawaug.evaluation.scores import frozen_sample
from rawaug.noise import NoiseModel, own_noise
from rawaug.progress import progress

MUCH = 0.1
"""Share of an error above which a line says so."""
MOST_MEASURED = 12
"""Frames measured, evenly spaced: seconds for each of 12 megapixels."""
SHOWN = 4
ADVICE = "bin the references (bin 4), or add the noise of a higher ISO"


class OwnNoise(NamedTuple):
    """Mean variances over a reference: of its own noise, and of the noise that was added to it."""

    own: float
    added: float


def own_variances(
    whole: Sequence[Pair], scored: Sequence[Pair], noise: NoiseModel, seed: int = 0, factor: int = 1
) -> dict[str, OwnNoise]:
    """The own noise of references, by name, where it is stated or can be measured (:func:`rawaug.noise.own_noise`)."""
    found, binned = {}, Binned(whole, factor)
    count = min(MOST_MEASURED, len(scored))
    chosen = [scored[k * len(scored) // count] for k in range(count)]
    for pair in progress(chosen, label="own noise of the references", unit="frame"):
        if (levels := own_noise(binned, binned.names.index(pair.name))) is not None:
            own = noise_variance(pair.raw, *levels).mean().item()
            found[pair.name] = OwnNoise(own, frozen_sample(pair, noise, pair.cfa, seed).variance.mean().item())
    return found


def with_own_noise(summary: dict[str, Any], found: Mapping[str, OwnNoise]) -> dict[str, Any]:
    """A summary with ``own_noise``, the references' share of the squared error, of measured images and of all."""
    errors, own = [], []
    for image in summary["images"]:
        if image["name"] in found and "psnr" in image:
            errors.append(10.0 ** (-image["psnr"] / 10.0))
            own.append(found[image["name"]].own)
            image["own_noise"] = own[-1] / errors[-1]
    return summary | ({"own_noise": sum(own) / sum(errors)} if own else {})


def own_noise_note(summaries: Mapping[str, Mapping[str, Any]]) -> str:
    """A line on scores that the references' own noise makes up much of; empty if there are none."""
    shares = {name: scores.get("own_noise", 0.0) for name, scores in summaries.items()}
    much = sorted((name for name, share in shares.items() if share > MUCH), key=lambda name: -shares[name])
    named = ", ".join(f"{name} {shares[name]:.0%}" for name in much[:SHOWN])
    kept = " (more than 100%: it keeps that noise)" if any(shares[name] > 1.0 for name in much) else ""
    return f"own noise of the references as a share of the squared error: {named}{kept}; {ADVICE}" if much else ""


def added_noise_note(found: Mapping[str, OwnNoise]) -> str:
    """A line on a test whose noise is hardly stronger than that of its references; empty if it is much stronger."""
    if not found:
        return ""
    own, added = (fmean(values) for values in zip(*found.values(), strict=True))
    if own <= MUCH * added:
        return ""
    return (
        f"the test frames' own noise has {own / added:.0%} of the variance of the noise added to them: a perfect "
        f"denoiser would score {-10.0 * math.log10(own):.1f} dB; {ADVICE}"
    )
