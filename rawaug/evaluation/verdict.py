r"""The verdict of a comparison: which method to use, or why the test cannot say.

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
from statistics import fmean, stdev
from typing import Any, NamedTuple

from rawaug.errors import count_of

_MATTERS = 0.05
"""Minimum gain in dB for preferring a trained arm to a method without training."""

_INPUT = "the noisy input"
"""The name of the noisy input, which is used if no other method was scored."""

CLEANER_TEST = "bin the references (bin 4), or add the noise of a higher ISO"
"""Advice for making a test less sensitive to the noise of its references."""

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


def verdict(results: Mapping[str, Sequence[Mapping[str, Summary]]], others: Mapping[str, Summary]) -> Verdict:
    """Compare the arm with the highest mean PSNR with the best of the other methods.

    Args:
        results: by arm, one entry per seed, with the summary ``plain``.
        others: summaries of methods that were not trained, by name. Without any, the arm is compared with the noisy
            input.

    Returns:
        The recommendation, which names an arm, one of the others or :data:`_INPUT`, or nothing.
    """
    runs_by_arm: dict[str, list[Summary]] = {}
    for arm, runs in results.items():
        for run in runs:
            if "psnr" in run["plain"]:
                runs_by_arm.setdefault(arm, []).append(run["plain"])

    if not runs_by_arm:
        return Verdict("", "")

    arm = max(runs_by_arm, key=lambda name: _mean(runs_by_arm[name], "psnr"))
    runs = runs_by_arm[arm]

    rival, scores = _best_rival(others)
    if not rival:
        rival, scores = _INPUT, _of_input(runs[0])

    gain = _mean(runs, "psnr") - scores["psnr"]
    gain_srgb = _gain_srgb(runs, scores)

    doubt = _kept_noise(arm, runs, rival, scores) or _disagreement(arm, rival, gain, gain_srgb)
    if doubt:
        return Verdict("", f"No recommendation: {doubt}.")

    if gain >= _MATTERS:
        use = arm
        reasons = [f"{gain:+.2f} dB over {rival}"]
    elif gain >= 0:
        use = rival
        reasons = [f"{arm}, the best arm, scores {gain:.2f} dB more"]
    else:
        use = rival
        reasons = [f"{arm}, the best arm, scores {-gain:.2f} dB less"]

    reasons.append(_how_sure(runs, scores, gain))
    if use == arm:
        for other in _arms_as_good(arm, runs_by_arm):
            reasons.append(f"{other} is as good within the noise of the seeds")
    if gain_srgb is not None:
        reasons.append(f"{gain_srgb:+.2f} dB after development")

    return Verdict(use, f"Use {use}: {', '.join(reasons)}.")


def _mean(runs: Sequence[Summary], key: str) -> float:
    return fmean(run[key] for run in runs)


def _best_rival(others: Mapping[str, Summary]) -> tuple[str, Summary]:
    """Find the name and scores of the method with the highest PSNR; an empty name if none has one."""
    rival = ""
    for name, summary in others.items():
        if "psnr" in summary and (not rival or summary["psnr"] > others[rival]["psnr"]):
            rival = name

    return rival, others.get(rival, {})


def _of_input(summary: Summary) -> dict[str, Any]:
    """The scores of the noisy input, which every summary holds beside its own."""
    scores: dict[str, Any] = {}
    for key, value in summary.items():
        if key.endswith("_noisy"):
            scores[key.removesuffix("_noisy")] = value

    scores["images"] = [{"psnr": image.get("psnr_noisy")} for image in summary["images"]]
    return scores


def _gain_srgb(runs: Sequence[Summary], rival: Summary) -> float | None:
    """Compute the mean gain over the rival after development; None if something was not developed."""
    if not all("psnr_srgb" in scores for scores in (*runs, rival)):
        return None

    return _mean(runs, "psnr_srgb") - float(rival["psnr_srgb"])


def _how_sure(runs: Sequence[Summary], rival: Summary, gain: float) -> str:
    """Compare the gain with the spread of the seeds in a clause, or count frames if there is one seed."""
    if len(runs) > 1:
        spread = stdev(run["psnr"] for run in runs)
        relation = "more than"
        if abs(gain) <= spread:
            relation = "within"
        return f"{relation} the noise of the seeds (± {spread:.2f} dB)"

    frames = 0
    higher = 0
    for image, other in zip(runs[0]["images"], rival["images"], strict=False):
        frames += 1
        if (image.get("psnr") or 0.0) > (other.get("psnr") or 0.0):
            higher += 1
    return f"higher on {higher} of {count_of(frames, 'frame')}, one seed"


def _arms_as_good(arm: str, runs_by_arm: Mapping[str, Sequence[Summary]]) -> list[str]:
    """List the other arms whose mean is below that of ``arm`` by no more than the larger deviation of the seeds."""
    scores = {}
    for name, runs in runs_by_arm.items():
        if len(runs) > 1:
            scores[name] = [run["psnr"] for run in runs]
    if arm not in scores:
        return []

    best = scores.pop(arm)
    as_good = []
    for name, others in scores.items():
        spread = max(stdev(best), stdev(others))
        if fmean(best) - fmean(others) <= spread:
            as_good.append(name)

    return as_good


def _disagreement(arm: str, rival: str, gain: float, gain_srgb: float | None) -> str:
    """Explain why RAW and developed scores together decide nothing; empty if they agree."""
    if gain_srgb is None:
        return ""

    opposed = round(gain, 2) * round(gain_srgb, 2) < 0
    only_developed = abs(gain) < _MATTERS <= gain_srgb
    if not (opposed or only_developed):
        return ""

    return (
        f"{arm} against {rival} gains {gain:+.2f} dB in RAW but {gain_srgb:+.2f} dB after development; "
        "more test frames (data.test) or seeds (seeds: 3) would decide"
    )


def _kept_noise(arm: str, runs: Sequence[Summary], rival: str, other: Summary) -> str:
    """Explain why the references' own noise leaves the comparison open; empty if it does not."""
    best = max(runs, key=lambda run: run["psnr"])
    name, scores = arm, best
    if other["psnr"] > best["psnr"]:
        name, scores = rival, other

    own, test_noise = _noise_of_references(scores)
    if own is None:
        return ""

    decides = f"to decide, {CLEANER_TEST}, or test on noisy and clean captures (pairs:PATH)"
    if scores["own_noise"] > 1.0:
        return (
            f"{name} scores {scores['psnr']:.2f} dB and a perfect denoiser would score {-10 * math.log10(own):.1f} dB "
            f"on these references, whose noise it has kept; {decides}"
        )

    if test_noise is None:
        return ""

    gap = abs(_squared_error(best["psnr"]) - _squared_error(other["psnr"]))
    by_keeping = own**2 / (own + test_noise)
    if abs(best["psnr"] - other["psnr"]) >= _MATTERS and gap <= by_keeping:
        return f"{arm} and {rival} differ by no more than a method gains by keeping the references' noise; {decides}"

    return ""


def _noise_of_references(summary: Summary) -> tuple[float | None, float | None]:
    """Get the mean variance of the references' own noise and of the noise added to them; None if not known."""
    own_variances = []
    test_variances = []
    for image in summary["images"]:
        if "own_noise" not in image:
            continue
        own_variances.append(image["own_noise"] * _squared_error(image["psnr"]))
        if "psnr_noisy" in image:
            test_variances.append(_squared_error(image["psnr_noisy"]))

    return _mean_or_none(own_variances), _mean_or_none(test_variances)


def _squared_error(psnr: float) -> float:
    """Compute the mean squared error at a PSNR in dB."""
    return float(10.0 ** (-psnr / 10.0))


def _mean_or_none(values: Sequence[float]) -> float | None:
    if not values:
        return None

    return fmean(values)
