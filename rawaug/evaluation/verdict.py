r"""The verdict of a comparison: which method to use, or why the test cannot say.

Two methods are compared frame by frame, since frames differ by tens of decibels and methods by tenths:

.. math:: d_{sn} = \mathrm{PSNR}_{sn} - \mathrm{PSNR}'_{n}, \qquad \bar d = \operatorname{mean}_{s, n} d_{sn}

for seeds s and frames n. :func:`paired_interval` gives the interval of the mean by bootstrap over the frames, with the
seeds inside (Efron and Tibshirani, "An introduction to the bootstrap", 1993), widened for few frames as Student's t is,
and for the choice among several arms on the same frames by Bonferroni's rule. An arm is recommended if all of its
interval is at least :data:`MATTERS`, a rival if all is below. The noisy input is always a rival.

A photograph that serves as the clean reference, :math:`r = x + m`, has its own noise m, of variance n. The test adds
noise w of variance v. A perfect denoiser returns x and scores n; a method that keeps some of m scores better than that,
down to

.. math:: \min_h \operatorname{E} (h (m + w) - m)^2 = \frac{n v}{n + v},

so that up to :math:`n - n v / (n + v) = n^2 / (n + v)` of any difference between two methods may be kept noise. If the
best method scores more than a perfect denoiser, or leads by less than that, the test decides nothing. Nor does it if
one method leads in RAW and the other after development.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from statistics import fmean
from typing import Any, NamedTuple

import numpy as np

from rawaug.errors import count_of

MATTERS = 0.05
"""Minimum gain in dB for preferring a trained arm to a method without training."""

CONFIDENCE = 0.95
"""Probability that an interval holds the mean difference over all such frames and seeds."""

_SSIM_MATTERS = 0.005
"""A recommended method whose SSIM is lower by this or more is reported to be so."""

_DRAWS = 4000
"""Number of resamples of the bootstrap."""

_INPUT = "the noisy input"
"""The name of the noisy input."""

CLEANER_TEST = "bin the references (bin 4), or add the noise of a higher ISO"
"""Advice for making a test less sensitive to the noise of its references."""

_MORE = "more test frames (data.test) or more seeds (seeds) would decide"

Summary = Mapping[str, Any]
"""The scores of one method, see :func:`rawaug.evaluation.scores.summary`."""


class Verdict(NamedTuple):
    """What a comparison recommends.

    Attributes:
        use: the name of the recommended method; empty if nothing is recommended.
        sentence: the recommendation or the reason why there is none; empty if no method has a PSNR.
    """

    use: str
    sentence: str


def paired_interval(differences: Any, confidence: float = CONFIDENCE) -> tuple[float, float]:
    """Compute the interval of the mean of paired differences, by bootstrap over frames with the seeds inside.

    Each resample draws as many frames and as many seeds as there are, with replacement; a seed belongs to a training
    and so to all frames.

    Args:
        differences: ``(N,)``, one method less the other on each frame, or ``(S, N)`` with a row for each seed.
        confidence: probability that the interval holds the mean.

    Returns:
        The ends of the interval; they are infinite for fewer than two frames, which say nothing about others.

    Raises:
        ValueError: if a difference is not finite.

    Example:
        >>> low, high = paired_interval([0.4, 0.5, 0.6, 0.5])
        >>> 0.3 < low < 0.5 < high < 0.7
        True
    """
    from scipy import stats

    differences = np.atleast_2d(np.asarray(differences, np.float64))
    if not np.isfinite(differences).all():
        raise ValueError("paired differences must be finite; leave out the frames on which a score is not")
    seeds, frames = differences.shape
    if frames < 2:
        return -math.inf, math.inf

    generator = np.random.default_rng(0)
    frame_shares = generator.multinomial(frames, np.full(frames, 1 / frames), size=_DRAWS) / frames
    seed_shares = generator.multinomial(seeds, np.full(seeds, 1 / seeds), size=_DRAWS) / seeds
    means = np.einsum("ds,sn,dn->d", seed_shares, differences, frame_shares, optimize=True)

    # Resamples of few frames spread too little: by the ratio of the t interval to the percentiles of a normal law.
    above = (1 + confidence) / 2
    widening = stats.t.ppf(above, frames - 1) / stats.norm.ppf(above) * math.sqrt(frames / (frames - 1))
    mean = differences.mean()
    low, high = mean + widening * (np.quantile(means, [1 - above, above]) - mean)
    return float(low), float(high)


def verdict(results: Mapping[str, Sequence[Mapping[str, Summary]]], others: Mapping[str, Summary]) -> Verdict:
    """Compare the arm with the highest mean PSNR with the best of the other methods, on the frames that all scored.

    Args:
        results: by arm, one entry per seed, with the summary ``plain``.
        others: summaries of methods that were not trained, by name. The noisy input, whose scores every summary holds,
            is one more.

    Returns:
        The recommendation, which names an arm, one of the others or :data:`_INPUT`, or nothing.
    """
    arms: dict[str, list[Summary]] = {}
    for name, arm_runs in results.items():
        for run in arm_runs:
            if "psnr" in run["plain"]:
                arms.setdefault(name, []).append(run["plain"])
    if not arms:
        return Verdict("", "")

    rivals: dict[str, list[Summary]] = {}
    for name, summary in others.items():
        if "psnr" in summary:
            rivals[name] = [summary]
    first = next(iter(arms.values()))[0]
    if "psnr_noisy" in first:
        rivals[_INPUT] = [input_summary(first)]
    if not rivals:
        return Verdict("", "No recommendation: there is no other method to compare with.")

    frames, left_out = _common_frames([*arms.values(), *rivals.values()])
    if not frames:
        return Verdict("", "No recommendation: there is no frame on which every method has a PSNR.")

    arm = max(arms, key=lambda name: _scores(arms[name], frames).mean())
    rival = max(rivals, key=lambda name: _scores(rivals[name], frames).mean())
    runs, [scores] = arms[arm], rivals[rival]
    differences = _scores(runs, frames) - _scores([scores], frames)
    low, high = paired_interval(differences, 1 - (1 - CONFIDENCE) / len(arms))
    gain = float(differences.mean())
    gain_srgb = _mean_gain(runs, scores, frames, "psnr_srgb")

    doubt = (
        _kept_noise(arm, runs, rival, scores)
        or _disagreement(arm, rival, gain, gain_srgb)
        or _too_few(arm, rival, gain, (low, high), differences.shape)
    )
    if doubt:
        return Verdict("", f"No recommendation: {doubt}.")

    use = arm
    reasons = [f"{gain:+.2f} dB over {rival}"]
    if high < MATTERS:
        use = rival
        reasons = [f"{arm}, the best arm, scores {abs(gain):.2f} dB {'more' if gain >= 0 else 'less'}"]
    reasons.append(_interval_in_words((low, high), differences.shape))
    if left_out:
        reasons.append(f"{count_of(left_out, 'frame')} without a score of every method left out")

    if use == arm:
        for other, other_runs in arms.items():
            if other != arm and not _is_above(runs, other_runs, frames):
                reasons.append(f"{other} is as good within the spread of frames and seeds")
    if gain_srgb is not None:
        reasons.append(f"{gain_srgb:+.2f} dB after development")

    gain_ssim = _mean_gain(runs, scores, frames, "ssim")
    if gain_ssim is not None and (gain_ssim if use == arm else -gain_ssim) <= -_SSIM_MATTERS:
        reasons.append(f"although its SSIM is {abs(gain_ssim):.3f} lower")

    return Verdict(use, f"Use {use}: {', '.join(reasons)}.")


def input_summary(summary: Summary) -> dict[str, Any]:
    """Make the summary of the noisy input, whose scores every summary holds beside its own."""
    scores = _scores_of_input(summary)
    scores["images"] = list(map(_scores_of_input, summary["images"]))
    return scores


def _scores_of_input(scores: Mapping[str, Any]) -> dict[str, Any]:
    return {key.replace("_noisy", ""): value for key, value in scores.items() if "_noisy" in key}


def _common_frames(methods: Sequence[Sequence[Summary]]) -> tuple[list[int], int]:
    """List the places of the frames on which every run of every method has a finite PSNR, and count the others."""
    scored_by_all: set[int] | None = None
    count = 0
    for runs in methods:
        for run in runs:
            scored = set()
            for index, image in enumerate(run["images"]):
                if math.isfinite(image.get("psnr", math.nan)):
                    scored.add(index)
            scored_by_all = scored if scored_by_all is None else scored_by_all & scored
            count = max(count, len(run["images"]))

    frames = sorted(scored_by_all or ())
    return frames, count - len(frames)


def _scores(runs: Sequence[Summary], frames: Sequence[int], key: str = "psnr") -> np.ndarray:
    """The scores of each run on these frames, ``(S, N)``; NaN where a frame has none."""
    return np.array([[run["images"][frame].get(key, math.nan) for frame in frames] for run in runs])


def _mean_gain(runs: Sequence[Summary], rival: Summary, frames: Sequence[int], key: str) -> float | None:
    """Compute the mean gain over the rival in another score; None unless both have it on all frames."""
    gain = float((_scores(runs, frames, key) - _scores([rival], frames, key)).mean())
    return gain if math.isfinite(gain) else None


def _is_above(runs: Sequence[Summary], other_runs: Sequence[Summary], frames: Sequence[int]) -> bool:
    """Tell whether an arm is above another beyond the spread of frames and seeds, which are paired where both have as
    many."""
    mine, other = _scores(runs, frames), _scores(other_runs, frames)
    if len(mine) != len(other):
        other = other.mean(axis=0, keepdims=True)
    return paired_interval(mine - other)[0] > 0


def _interval_in_words(interval: tuple[float, float], shape: tuple[int, ...]) -> str:
    seeds, frames = shape
    low, high = interval
    return f"between {low:+.2f} and {high:+.2f} by {count_of(frames, 'frame')} and {count_of(seeds, 'seed')}"


def _too_few(arm: str, rival: str, gain: float, interval: tuple[float, float], shape: tuple[int, ...]) -> str:
    """Explain why frames and seeds do not tell whether the gain matters; empty if they do."""
    low, high = interval
    if low >= MATTERS or high < MATTERS:
        return ""
    if shape[1] < 2:
        return f"one frame says nothing about others, on it {arm} gains {gain:+.2f} dB over {rival}; {_MORE}"
    return f"{arm} against {rival} gains {gain:+.2f} dB, {_interval_in_words(interval, shape)}; {_MORE}"


def _disagreement(arm: str, rival: str, gain: float, gain_srgb: float | None) -> str:
    """Explain why RAW and developed scores together decide nothing; empty if they agree."""
    if gain_srgb is None:
        return ""

    opposed = round(gain, 2) * round(gain_srgb, 2) < 0
    only_developed = abs(gain) < MATTERS <= gain_srgb
    if not (opposed or only_developed):
        return ""

    return f"{arm} against {rival} gains {gain:+.2f} dB in RAW but {gain_srgb:+.2f} dB after development; {_MORE}"


def _kept_noise(arm: str, runs: Sequence[Summary], rival: str, other: Summary) -> str:
    """Explain why the references' own noise leaves the comparison open; empty if it does not."""
    best = max(runs, key=lambda run: run["psnr"])
    name, scores = arm, best
    if other["psnr"] > best["psnr"]:
        name, scores = rival, other

    own_variances = []
    test_variances = []
    for image in scores["images"]:
        if "own_noise" not in image:
            continue
        own_variances.append(image["own_noise"] * _squared_error(image["psnr"]))
        if "psnr_noisy" in image:
            test_variances.append(_squared_error(image["psnr_noisy"]))
    if not own_variances:
        return ""

    own_noise = fmean(own_variances)
    decides = f"to decide, {CLEANER_TEST}, or test on noisy and clean captures (pairs:PATH)"
    if scores["own_noise"] > 1.0:
        return (
            f"{name} scores {scores['psnr']:.2f} dB and a perfect denoiser would score "
            f"{-10 * math.log10(own_noise):.1f} dB on these references, whose noise it has kept; {decides}"
        )

    if not test_variances:
        return ""

    gap = abs(_squared_error(best["psnr"]) - _squared_error(other["psnr"]))
    by_keeping = own_noise**2 / (own_noise + fmean(test_variances))
    if abs(best["psnr"] - other["psnr"]) >= MATTERS and gap <= by_keeping:
        return f"{arm} and {rival} differ by no more than a method gains by keeping the references' noise; {decides}"

    return ""


def _squared_error(psnr: float) -> float:
    """Compute the mean squared error at a PSNR in dB."""
    return float(10.0 ** (-psnr / 10.0))
