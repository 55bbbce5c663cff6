r"""Trials: a frame with its frozen noise, read and drawn once, and everything that scoring it requires.

A test case is a captured noisy frame, or a clean frame with noise that is keyed by (seed, name). A denoiser is given
:attr:`Trial.input` alone; the clean image, and everything derived from it, stays with the trial.

A "clean" reference is a photograph, ``r = x + m``, with its own noise m. An error against it is ``|d - x|^2 + |m|^2``
as far as m is independent of the denoised d, so that even a perfect denoiser is left with the variance of m. References
binned K x K by colour site (:func:`rawaug.bayer.bin_mosaic`) have about 1 / K^2 of it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from statistics import fmean
from typing import Any, Literal, TypeVar

from torch import Tensor

from rawaug import bayer
from rawaug.bayer import CFA, crop_to_cfa, noise_variance
from rawaug.data.development import develop_packed, exposure_gain
from rawaug.data.frames import Cached, Frames, as_frames
from rawaug.data.pairs import Pair
from rawaug.denoising.denoiser import Levels, Noisy
from rawaug.evaluation.verdict import CLEANER_TEST
from rawaug.noise import NoiseModel, own_noise
from rawaug.seeding import keyed_generator

TEST_NOISE = "test noise"
"""The part of the key of test frames' noise that is the same for all of them."""

_CACHE_MB = 1024
"""How many megabytes of trials stay in memory; others are made again for each pass."""

_Case = TypeVar("_Case")


@dataclass(frozen=True, eq=False)
class Trial:
    """One frame at one strength of noise.

    Attributes:
        noisy: the input: packed RAW ``(1, 4, h, w)``, or sRGB ``(1, 3, H, W)`` in the domain ``srgb``.
        clean: the truth, in the form of ``domain``.
        variance: variance of the noise of each value at the noisy signal, in the shape of ``noisy``; None if unknown.
        frame: name of the frame.
        domain: the form in which results are compared with the truth: packed RAW ``(1, 4, h, w)``, linear camera RGB or
            sRGB ``(1, 3, H, W)``.
        condition: what the denoiser is told, or how the sensor behaves; rows carry it.
        strength: the name of the noise's strength; rows carry it.
        levels: (shot_var, read_var) that the denoiser is given, if the noise has any.
        cfa: the pattern of packed RAW, or of a mosaic ``(1, 1, H, W)`` in its place.
        develop: makes sRGB ``(3, H, W)`` of an image like ``noisy`` or ``clean``, the same way for both; None for
            images that are already developed.
        inputs: inputs for denoisers of other kinds of image, by the kind: for developed pictures, the RAW that
            they were developed from.
        ways: functions from denoised RAW to ``domain``, by name; a denoiser that gives RAW is scored once for each.
        own: the mean variance of the noise that the reference itself has, if it is known.
        levels_from_clean: whether the levels were measured against the clean frame.
    """

    noisy: Tensor
    clean: Tensor
    variance: Tensor | None = None
    frame: str = ""
    domain: Literal["raw", "rgb", "srgb"] = "raw"
    condition: str = ""
    strength: str = ""
    levels: Levels | None = None
    cfa: str = CFA.RGGB
    develop: Callable[[Tensor], Tensor] | None = None
    inputs: Mapping[str, Noisy] = field(default_factory=dict)
    ways: Mapping[str, Callable[[Tensor], Tensor]] = field(default_factory=dict)
    own: float | None = None
    levels_from_clean: bool = False

    @property
    def table(self) -> str:
        """The name of the table that its scores belong to; it is "" if there is only one."""
        return ", ".join(filter(None, [self.condition, self.strength]))

    @property
    def input(self) -> Noisy:
        """The input for a denoiser of this kind of image."""
        return Noisy(self.noisy, self.variance, self.levels, self.cfa)

    def takes(self, denoiser: Any) -> bool:
        """Tell whether a denoiser, as in :mod:`rawaug.evaluation.scores`, takes this kind of image and its pattern."""
        kind = "raw"
        if self.domain == "srgb":
            kind = "srgb"

        takes_pattern = getattr(denoiser, "takes_pattern", None)
        in_pattern = takes_pattern is None or bool(takes_pattern(self.cfa))
        return in_pattern and denoiser.takes in ("", kind, *self.inputs)

    def input_for(self, denoiser: Any) -> Noisy:
        """The input for this denoiser: a denoiser of RAW gets the RAW that a picture was developed from."""
        return self.inputs.get(denoiser.takes, self.input)

    def compared(self, image: Tensor) -> Tensor:
        """Convert an image in the form of ``domain`` for scores: packed RAW to the mosaic, others stay as they are."""
        return bayer.unpack_if_packed(image, self.cfa)


def make_trial(pair: Pair, noise: NoiseModel, cfa: CFA | str | None = None, seed: int = 0, **about: Any) -> Trial:
    """Make a test case of a frame in the domain ``raw``, with its captured noise or noise keyed by (seed, name).

    Args:
        pair: the frame; if its capture states no levels, they are measured against its clean version.
        noise: the noise to draw for frames without a noisy capture.
        cfa: the pattern to pack by, if it is not the frame's.
        seed: seed of the drawn noise.
        about: other attributes, such as ``condition``.
    """
    pair = pair.with_levels()
    cfa = CFA(cfa or pair.cfa)
    clean = bayer.pack(crop_to_cfa(pair.clean.mosaic, pair.cfa, cfa)[None], cfa)
    if pair.noisy is not None and pair.noisy.noise_profile is not None:
        packed = bayer.pack(crop_to_cfa(pair.noisy.mosaic, pair.cfa, cfa)[None], cfa)
        noisy, variance, levels, _ = Noisy.of(packed, pair.noisy.noise_profile, cfa)
    else:
        noisy, variance, levels = freeze_noise(clean, noise, seed, TEST_NOISE, pair.name)
    assert variance is not None
    return raw_trial(pair, noisy, clean, variance, levels, cfa, levels_from_clean=pair.levels_from_clean, **about)


def freeze_noise(clean: Tensor, noise: NoiseModel, seed: int, *key: str) -> tuple[Tensor, Tensor, Levels | None]:
    """Add noise to a clean frame, the same for the same seed and key.

    Args:
        clean: packed RAW ``(1, 4, h, w)``.
        noise: the noise to draw.
        seed: seed of the test.
        key: the purpose of the noise, and the name of the frame.

    Returns:
        Noisy RAW and the variance of its noise, both ``(1, 4, h, w)``, and (shot_var, read_var) if the noise has any.
    """
    params = noise.sample(1, keyed_generator(seed, *key))
    noisy = noise.apply(clean, params)
    levels = None
    if "shot_var" in params:
        levels = params["shot_var"].item(), params["read_var"].item()

    return noisy, noise.variance(noisy, params), levels


def raw_trial(
    pair: Pair, noisy: Tensor, clean: Tensor, variance: Tensor, levels: Levels | None, cfa: CFA, **about: Any
) -> Trial:
    """Make a trial, developed with the frame's colours, of packed RAW of the frame.

    Args:
        pair: the frame.
        noisy: ``(1, 4, h, w)``.
        clean: ``(1, 4, h, w)``.
        variance: variance of the noise, ``(1, 4, h, w)``.
        levels: (shot_var, read_var) of the noise, if it has any.
        cfa: the pattern by which all three are packed.
        about: other attributes of the trial.
    """
    develop = partial(develop_packed, cfa=cfa, pair=pair, exposure=exposure_gain(clean, pair))
    own_variance = None
    if pair.clean.noise_profile is not None:
        own_variance = noise_variance(clean, *pair.clean.noise_profile).mean().item()

    return Trial(noisy, clean, variance, pair.name, levels=levels, cfa=cfa, develop=develop, own=own_variance, **about)


def make_trials(cases: Sequence[_Case], make: Callable[[_Case], Trial]) -> Sequence[Trial]:
    """Make the trial ``make(case)`` of every case at its first use, and keep up to a gigabyte of them in memory."""
    trials: Any = Cached(cases, _CACHE_MB, make)
    return trials


def evenly_spaced(length: int, most: int) -> list[int]:
    """Choose at most ``most`` indices of a sequence of this length, evenly spaced from the first.

    Example:
        >>> evenly_spaced(10, 4)
        [0, 2, 5, 7]
    """
    count = min(most, length)
    return [k * length // count for k in range(count)]


# -- the references' own noise -----------------------------------------------------------------------------------------

_MUCH = 0.1
"""Threshold for warning of the references' own noise, as a share of the squared error."""

_MOST_MEASURED = 12
"""Maximum number of frames whose own noise is measured; a frame of 12 megapixels takes seconds."""

_MOST_TARGETS = 3
"""Maximum number of training frames whose own noise is measured."""

_SHOWN = 4
"""Maximum number of methods that a line names."""


def measure_own_noise(pairs: Sequence[Pair], most: int = _MOST_MEASURED) -> Frames[Pair]:
    """Measure the own noise of whole references as they are read, unless they state it.

    Only ``most`` of them are measured, evenly spaced, since each takes seconds.
    """
    return as_frames(pairs).map(lambda pair: pair.with_own_noise(own_noise), only=evenly_spaced(len(pairs), most))


def own_noise_note(summaries: Mapping[str, Mapping[str, Any]]) -> str:
    """Make a note on scores of which the references' own noise is a large part; empty if there are none."""
    shares = {}
    for name, scores in summaries.items():
        share = scores.get("own_noise", 0.0)
        if share > _MUCH:
            shares[name] = share

    if not shares:
        return ""

    names = sorted(shares, key=lambda name: -shares[name])[:_SHOWN]
    text = ", ".join(f"{name} {shares[name]:.0%}" for name in names)
    if max(shares.values()) > 1.0:
        text += " (more than 100%: it keeps that noise)"

    return f"own noise of the references as a share of the squared error: {text}; {CLEANER_TEST}"


def added_noise_note(trials: Iterable[Trial]) -> str:
    """Make a warning of noise hardly stronger than that of the references; empty if it is much stronger."""
    own_variances = []
    test_variances = []
    for trial in trials:
        if trial.own is not None and trial.variance is not None:
            own_variances.append(trial.own)
            test_variances.append(trial.variance.mean().item())

    if not own_variances:
        return ""

    own_variance = fmean(own_variances)
    share = own_variance / fmean(test_variances)
    if share <= _MUCH:
        return ""

    return (
        f"the test frames' own noise has {share:.0%} of the variance of the noise added to them: "
        f"a perfect denoiser would score {-10.0 * math.log10(own_variance):.1f} dB; {CLEANER_TEST}"
    )


def training_noise_note(pairs: Sequence[Pair], noise: NoiseModel, arms: Sequence[str]) -> str:
    """Make a warning of clean training frames with much noise of their own, which a network learns to keep.

    Args:
        pairs: the training frames. Frames with a noisy capture are left out, since their noise is different.
        noise: the noise that is added to the others.
        arms: the names of the arms that train on them.

    Returns:
        The warning; empty if there are no such frames or arms, or their noise is weak or cannot be measured.
    """
    if not arms:
        return ""

    targets = [pair for pair in pairs if pair.noisy is None]
    shares = []
    for k in evenly_spaced(len(targets), _MOST_TARGETS):
        pair = targets[k]
        levels = pair.clean.noise_profile or own_noise(pair.clean.mosaic, pair.cfa)
        if levels is None:
            continue
        clean = bayer.pack(pair.clean.mosaic[None], pair.cfa)
        params = noise.sample(1, keyed_generator(0, "training noise", pair.name))
        shares.append((noise_variance(clean, *levels).mean() / noise.variance(clean, params).mean()).item())

    if not shares or fmean(shares) <= _MUCH:
        return ""

    return (
        f"the clean training frames' own noise has {fmean(shares):.0%} of the variance of the noise added to them: "
        f"training on them ({', '.join(arms)}) teaches to keep it; use noisy and clean captures (pairs:PATH), or "
        "augmented: 1"
    )
