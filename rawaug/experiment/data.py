"""The data of a run: opened and divided before anything is read, so that everything missing is found at once."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from operator import attrgetter
from typing import Any

from rawaug.data import open_pairs, open_pictures
from rawaug.data.frames import OWN_PICTURES, Cached, Frames, Readable, as_frames, left_out, shared_frame
from rawaug.data.pairs import Pair
from rawaug.data.selection import select_pairs
from rawaug.errors import count_of
from rawaug.evaluation.trials import measure_own_noise
from rawaug.experiment.settings import HELD_OUT, DataConfig, Recipe
from rawaug.training.estimators import ESTIMATORS
from rawaug.training.noisy_frames import drop_clean, frame_levels

_MOST_HELD_OUT = 16
"""Largest number of frames held out for validation: a fifth of them, and at least one."""

_GIVEN = "given pairs"
"""The name, in results, of pairs that a caller gives in place of ``data.pairs``, ``validation`` or ``test``."""

_MARGIN = 6
"""Number of pixels by which a frame is larger than its crops, as they are turned and shifted to a pattern."""

_NAMED = 6


def _listing(frames: Sequence[Pair], available: int, source: Any, most: int = _NAMED) -> str:
    """Say which frames of a dataset are used, as in ``"2 of 8 of demo:train: a, b"``.

    Args:
        frames: the frames that are used.
        available: the number of frames that they are taken from.
        source: name of the dataset.
        most: largest number of frames that are named.
    """
    names = as_frames(frames).names
    text = ", ".join(names[:most])
    if len(names) > most:
        text += f" and {len(names) - most} more"

    return f"{len(names)} of {available} of {source}: {text}"


# -- opening -----------------------------------------------------------------------------------------------------------


def open_frames(recipe: Recipe, given: Mapping[str, Sequence[Pair]]) -> tuple[dict[str, Any], list[str]]:
    """Open and divide the data that a recipe names, or those in ``given`` instead; no frame is read.

    Returns:
        The sequences by part, and a line on each for the user to check. ``pairs`` are the frames that the ISP is fitted
        to and that are real training frames; ``more`` are all frames that these were chosen from; ``validation`` are
        the frames that choose the weights, and ``test`` those that the result is scored on; ``pictures`` are the sRGB
        pictures to make RAW of.

    Raises:
        FileNotFoundError: if there are no such data.
        ValueError: if they are not what the recipe needs, or a test frame is also among the others.
    """
    data = recipe.data
    clean = not recipe.self_supervised

    test = _open_pairs(recipe, given.get("test", data.test), "test", clean=True)
    every = _open_pairs(recipe, given.get("pairs", data.pairs), "train", clean)
    _require_unseen(test, every, "pairs")

    # Training frames; the last ones are held out if the recipe says so.
    count = len(every)
    source = given.get("validation", data.validation)
    held_out = isinstance(source, str) and source == HELD_OUT
    if held_out and len(every) > 1:
        count -= min(max(1, len(every) // 5), _MOST_HELD_OUT)
    pairs = every.some(select_pairs(every, count, data.count, data.select))
    if data.crop is not None:
        pairs = pairs.middles(data.crop)

    if held_out:
        validation = every.some(range(count, len(every)))
        of_validation = len(every)
    else:
        validation = _open_pairs(recipe, source, "validation", clean)
        of_validation = len(validation)
        _require_unseen(test, validation, "validation")

    pictures: Any = pairs.map(attrgetter("srgb"))
    if data.pictures != OWN_PICTURES:
        pictures = open_pictures(data.pictures, recipe.train.crop + _MARGIN, data.max_pixels)
    if data.memory_mb:
        pictures = Cached(pictures, data.memory_mb)

    frames = {
        "pairs": pairs,
        "more": every.some(range(count)).kept(megabytes=2048),
        "validation": _prepare(recipe, validation, "validation"),
        "test": _prepare(recipe, test, "test"),
        "pictures": pictures,
    }

    # What is used of what.
    train = "no RAW frames"
    if frames["pairs"]:
        train = _listing(pairs, len(every), data.pairs)
    validate = "no frames: monitored on RAW made from the pictures; the final weights are kept"
    if frames["validation"]:
        name = data.validation
        if held_out:
            name = f"{data.pairs}, held out"
        validate = _listing(frames["validation"], of_validation, name, _MOST_HELD_OUT)

    isp = f"fitted to {count_of(len(pairs), 'frame')}"
    if recipe.isp is not None:
        isp = f"{recipe.isp.name}, unchanged"
        if recipe.isp.camera is not None:
            isp = f"{recipe.isp.name} as {recipe.isp.camera}"

    lines = [
        f"train     {train}",
        f"validate  {validate}",
        f"test      {_listing(frames['test'], len(test), data.test)}",
        f"pictures  {len(pictures)} of {data.pictures}",
        f"ISP       {isp}",
    ]
    return frames, lines


def _open_pairs(recipe: Recipe, spec: str | Sequence[Pair] | None, split: str, clean: bool) -> Frames[Any]:
    """Open the frames that a key of ``data`` names, or a sequence of them; frames of a bare folder may be ``clean``."""
    if spec is None:
        return as_frames([])

    data = recipe.data
    developed = recipe.target == "srgb"
    return open_pairs(spec, split, clean, data.max_pixels, developed=developed, **data.pair_settings(spec))


def _prepare(recipe: Recipe, frames: Frames[Any], part: str) -> Frames[Any]:
    """Count, bin and crop the frames of a part, "validation" or "test", as the recipe says; each is read once.

    The test frames' own noise is measured on whole frames; binning removes most of it.
    """
    data = recipe.data
    count, crop = data.validation_count, data.validation_crop
    if part == "test":
        count, crop = data.test_count, data.test_crop

    frames = frames.some(range(len(frames))[:count])
    if part == "test":
        frames = measure_own_noise(frames)
    if data.bin > 1 or recipe.full_colour:
        frames = frames.binned(data.bin, recipe.full_colour)
    if crop is not None:
        frames = frames.middles(crop)

    return frames.kept()


def _require_unseen(test: Sequence[Any], frames: Sequence[Any], part: str) -> None:
    """Raise ValueError if a test frame is also in another part."""
    shared = shared_frame(test, frames)
    if shared is not None:
        raise ValueError(f"data.test: {shared} is also in data.{part}; test on unseen frames")


def read_frames(recipe: Recipe, frames: dict[str, Any]) -> tuple[dict[str, Any], list[str]]:
    """Leave out the frames that cannot be read; return the others, and lines that name those left out.

    All frames are read once, since it is better to find a damaged one now than after the training. If no arm sees clean
    frames, only the test knows any from here on.
    """
    pairs, validation, test = (Readable(frames[part]) for part in ("pairs", "validation", "test"))
    readable_pairs = list(pairs)
    for readable in (validation, test):
        for _ in readable:
            pass

    lines = left_out(pairs, "data.pairs") + left_out(validation, "data.validation") + left_out(test, "data.test")
    kept: Sequence[Any] = validation.readable()
    if recipe.self_supervised:
        readable_pairs = list(map(drop_clean, readable_pairs))
        kept = list(map(drop_clean, kept))

    pictures = frames["pictures"]
    if recipe.data.pictures == OWN_PICTURES:
        pictures = as_frames(readable_pairs).map(attrgetter("srgb"))

    read = {"pairs": readable_pairs, "validation": kept, "test": test.readable(), "pictures": pictures}
    return {**frames, **read}, lines


# -- data in place of the recipe's -------------------------------------------------------------------------------------


def use_all_pairs(recipe: Recipe, content: Mapping[str, Any], keys: Collection[str]) -> Recipe:
    """Let the recipe use all of the pairs that replace its own; some of them are held out for validation.

    ``data.count`` and ``data.validation`` in its file are about its own pairs; a validation of null stays.

    Args:
        recipe: the recipe with the user's values.
        content: the content of its file.
        keys: the dotted keys that the user has set.
    """
    data = recipe.data
    usual = (content.get("data") or {}).get("pairs", DataConfig.pairs)
    if "data.pairs" not in keys or data.pairs is None or _dataset(data.pairs) == _dataset(usual):
        return recipe

    if "data.count" not in keys:
        data = replace(data, count=None)
    if "data.validation" not in keys and data.validation is not None:
        data = replace(data, validation=HELD_OUT)

    return replace(recipe, data=data)


def _dataset(spec: str | None) -> str | None:
    """Find the dataset that a spec names; each folder counts as a dataset."""
    kind, colon, _ = (spec or "").partition(":")
    if colon and len(kind) > 1 and kind != "pairs":  # one letter is a Windows drive
        return kind

    return spec


def name_given_pairs(recipe: Recipe, frames: Mapping[str, Sequence[Pair]]) -> Recipe:
    """Name given data :data:`_GIVEN` in the recipe; if only pairs are given, some of them are held out."""
    names: dict[str, Any] = dict.fromkeys(frames, _GIVEN)
    if "pairs" in frames and "validation" not in frames and recipe.data.validation is not None:
        names["validation"] = HELD_OUT

    return replace(recipe, data=replace(recipe.data, **names))


# -- what the frames must have -----------------------------------------------------------------------------------------


def require_usable(recipe: Recipe, pairs: Sequence[Pair], validation: Sequence[Pair]) -> None:
    """Raise ValueError unless the frames, as they were read, have what the fit and the arms need."""
    real = {name: arm for name, arm in recipe.arms.items() if arm.augmented < 1.0}

    for pair in pairs:
        if recipe.isp is None and not (pair.clean.color_known or pair.balance_known):
            raise ValueError(
                f"{pair.name}: its white balance and colour matrix are unknown, so no ISP can be fitted to it; "
                "use a shipped one: isp: universal"
            )
        if real and min(pair.clean.mosaic.shape[-2:]) < recipe.train.crop + _MARGIN:
            size = f"{pair.clean.mosaic.shape[-2]} x {pair.clean.mosaic.shape[-1]}"
            raise ValueError(f"{pair.name}: a frame of {size} is too small for train.crop={recipe.train.crop}")

    if not recipe.self_supervised:
        return

    for name, arm in real.items():
        shots = ESTIMATORS.make(arm.estimator).shots
        if shots > 1:
            raise ValueError(f"arms.{name}: needs {shots} shots of a scene, frames have 1; set its augmented to 1")

    if recipe.noise == "camera":
        return

    levels = None
    if recipe.isp is not None:
        levels = recipe.isp.load().info.get("noise")

    noisy_frames = list(validation)
    if real:
        noisy_frames += pairs
    for pair in noisy_frames:
        frame_levels(pair, levels)
