"""PSNR and SSIM of denoisers on trials: a row for each denoiser on each trial, and their means as JSON.

Scores are those of the whole mosaic, and also those of sRGB after one fixed development of result and clean frame:
bilinear demosaic, the frame's white balance and colour matrix, one exposure taken from the clean frame, the sRGB curve
of IEC 61966-2-1. Images that are already developed are compared as they are.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple, Protocol

from torch import Tensor

from rawaug.denoising.denoiser import Noisy
from rawaug.evaluation.trials import Trial
from rawaug.metrics import psnr, ssim, worst_and_best_quarter
from rawaug.progress import progress

METRICS = ("psnr", "ssim", "psnr_srgb", "ssim_srgb")
"""The scores of a row: PSNR in dB and SSIM, in the trial's domain and after development."""

_QUARTER_OF = 4
"""Minimum number of images for reporting quartiles."""

_SHOWN_FAULTS = 5
"""Maximum number of infinite or NaN scores that an error names."""


class ScoredDenoiser(Protocol):
    """A denoiser that can be scored: :class:`rawaug.RawDenoiser`, and anything that gives developed pictures in [0, 1].

    Attributes:
        name: its name in tables.
        takes: ``"raw"`` or ``"srgb"``, or ``""`` for any image.
    """

    @property
    def name(self) -> str:
        """Its name in tables."""

    @property
    def takes(self) -> str:
        """The kind of image that it takes."""

    def __call__(self, noisy: Noisy) -> Tensor: ...


class NoisyInput:
    """The input itself, as a denoiser that changes nothing, by the ``name`` that it has in tables."""

    takes = ""

    def __init__(self, name: str = "noisy input") -> None:
        self.name = name

    def __call__(self, noisy: Noisy) -> Tensor:
        return noisy.image


NOISY = NoisyInput()
"""The row of the noisy input."""


class Row(NamedTuple):
    """One denoiser on one trial.

    Attributes:
        denoiser: its name, with the way that follows it if there is one.
        frame: frame of the trial; ``condition``, ``strength`` and ``domain`` are the trial's as well.
        psnr: in dB in the trial's domain.
        ssim: in the trial's domain.
        psnr_srgb: in dB after development; None for images that are already developed.
        ssim_srgb: after development; None for images that are already developed.
        own_noise: the reference's own noise as a share of the squared error, if it is known.
        levels: (shot_var, read_var) that the denoiser was given, if any.
        levels_from_clean: whether these were measured against the clean frame.
        seconds: time that the denoiser took for each megapixel of its input.
    """

    denoiser: str
    frame: str
    condition: str
    strength: str
    domain: str
    psnr: float
    ssim: float | None = None
    psnr_srgb: float | None = None
    ssim_srgb: float | None = None
    own_noise: float | None = None
    levels: tuple[float, float] | None = None
    levels_from_clean: bool = False
    seconds: float = 0.0

    @property
    def table(self) -> str:
        """The name of the trial's table."""
        return ", ".join(filter(None, [self.condition, self.strength]))


def score(denoisers: Sequence[ScoredDenoiser], trials: Iterable[Trial], label: str = "") -> Iterator[Row]:
    """Score every denoiser on every trial, with one trial in memory at a time.

    Args:
        denoisers: the denoisers to compare, see :meth:`rawaug.RawDenoiser.of`; :data:`NOISY` is the input itself.
        trials: see :func:`rawaug.evaluation.trials.make_trial`.
        label: label of the progress bar.

    Example:
        >>> from rawaug import RawDenoiser
        >>> from rawaug.data import demo_pairs
        >>> from rawaug.evaluation.trials import make_trial
        >>> from rawaug.noise import noise_model
        >>> trial = make_trial(demo_pairs("test", count=1)[0].middle(64), noise_model("cycleisp_sidd"))
        >>> noisy, denoised = score([NOISY, RawDenoiser.of("NonLocalMeans")], [trial])
        >>> denoised.psnr > noisy.psnr
        True
    """
    if label:
        trials = progress(trials, label=label, unit="image")

    for trial in trials:
        for denoiser in denoisers:
            noisy = trial.input_for(denoiser)

            start = time.perf_counter()
            denoised = denoiser(noisy)
            seconds = (time.perf_counter() - start) / (noisy.image.numel() / 1e6)

            for name, image in to_domain(denoiser.name, denoised, trial):
                metrics = compare_images(image, trial)
                error = 10.0 ** (-metrics[0] / 10.0)
                share = None
                if trial.own is not None and error > 0:
                    share = trial.own / error

                yield Row(
                    name,
                    trial.frame,
                    trial.condition,
                    trial.strength,
                    trial.domain,
                    *metrics,
                    own_noise=share,
                    levels=noisy.levels,
                    levels_from_clean=trial.levels_from_clean,
                    seconds=seconds,
                )


def to_domain(name: str, denoised: Tensor, trial: Trial) -> Iterator[tuple[str, Tensor]]:
    """Convert a denoiser's result to the trial's domain, and yield it by name.

    RAW ``(1, 4, h, w)`` is converted in all of the trial's ways, whose names, if any, follow that of the denoiser.
    """
    if denoised.shape[1] == trial.clean.shape[1]:
        yield name, denoised
        return

    for development, follow in trial.ways.items():
        yield ", ".join(filter(None, [name, development])), follow(denoised)


def compare_images(image: Tensor, trial: Trial) -> tuple[float, float, float | None, float | None]:
    """Compute PSNR in dB and SSIM of an image against the clean one of its shape, and both again after development.

    ``image`` has the form of the trial's domain: ``(1, 4, h, w)`` or ``(1, 3, H, W)``.
    """
    result, clean = trial.compared(image), trial.compared(trial.clean)
    in_domain = psnr(result, clean).item(), ssim(result, clean).item()
    if trial.develop is None:
        return *in_domain, None, None

    result, clean = trial.develop(image)[None], trial.develop(trial.clean)[None]
    return *in_domain, psnr(result, clean).item(), ssim(result, clean).item()


# -- means as JSON -----------------------------------------------------------------------------------------------------


def group_rows(rows: Iterable[Row], key: str = "denoiser") -> dict[str, list[Row]]:
    """Group rows by their denoiser, or by another of their attributes, in their order."""
    groups: dict[str, list[Row]] = {}
    for row in rows:
        groups.setdefault(getattr(row, key), []).append(row)

    return groups


def summary(rows: Iterable[Row], noisy: Iterable[Row] = ()) -> dict[str, Any]:
    """Summarise the scores of one denoiser as JSON.

    Args:
        rows: one row per trial.
        noisy: the rows of the input on the same trials, in the same order.

    Returns:
        ``images``, the scores of each; the mean of each of :data:`METRICS`, and of its worst and best 25%; the same for
        the noisy input; ``own_noise``; ``levels_from_clean``, the number of images whose noise levels were
        measured against the clean frame; and ``no_numbers``, which names scores that are infinite or NaN, such as the
        PSNR of two equal frames. Entries that do not apply are left out.
    """
    rows, noisy = list(rows), list(noisy)
    images: list[dict[str, Any]] = []
    for row in rows:
        image: dict[str, Any] = {"name": row.frame}
        if row.levels is not None:
            image["shot_var"], image["read_var"] = row.levels
        if row.levels_from_clean:
            image["levels_from_clean"] = True
        images.append(image)
    result: dict[str, Any] = {"images": images}

    flagged = sum(row.levels_from_clean for row in rows)
    if flagged:
        result["levels_from_clean"] = flagged

    faults: list[str] = []
    for metric in METRICS:
        faults += _add_means(result, metric, rows, metric)
    for metric in METRICS:
        faults += _add_means(result, f"{metric}_noisy", noisy, metric)

    result |= _own_noise(rows, images)
    if faults:
        result["no_numbers"] = faults

    return result


def _add_means(result: dict[str, Any], key: str, rows: Sequence[Row], metric: str) -> list[str]:
    """Add a metric of the rows to each image and its means to the result, as ``key``; return the faults."""
    values = []
    faults = []
    for image, row in zip(result["images"], rows, strict=False):
        value = getattr(row, metric)
        if value is None:
            continue
        if math.isfinite(value):
            image[key] = value
            values.append(value)
        else:
            faults.append(f"{row.frame}: {key} is {value}")

    if values:
        result[key] = sum(values) / len(values)
    if len(values) >= _QUARTER_OF:
        result[f"{key}_worst25"], result[f"{key}_best25"] = worst_and_best_quarter(values)

    return faults


def _own_noise(rows: Sequence[Row], images: Sequence[dict[str, Any]]) -> dict[str, float]:
    """Compute the references' own noise as a share of the squared error: of each image, in place, and overall."""
    errors = []
    energies = []
    for row, image in zip(rows, images, strict=True):
        if row.own_noise is None or "psnr" not in image:
            continue
        error = 10.0 ** (-row.psnr / 10.0)
        errors.append(error)
        energies.append(row.own_noise * error)
        image["own_noise"] = row.own_noise

    if not energies:
        return {}

    return {"own_noise": sum(energies) / sum(errors)}


def require_numbers(summaries: Iterable[Mapping[str, Any]]) -> None:
    """Raise ValueError if summaries left out scores; this is called after everything else is printed and written."""
    faults: list[str] = []
    for scores in summaries:
        faults += [*scores.get("broken", ()), *scores.get("no_numbers", ())]

    if not faults:
        return

    texts = faults[:_SHOWN_FAULTS]
    hidden = len(faults) - len(texts)
    if hidden:
        texts.append(f"and {hidden} more")
    raise ValueError(f"left out of the means: {'; '.join(texts)}")
