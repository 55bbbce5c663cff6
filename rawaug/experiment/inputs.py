"""The data of a run. It is opened and divided, but not yet read, so that everything missing is found at once."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from rawaug.data import open_pictures
from rawaug.data.folders import Cached, Kept, Readable, left_out
from rawaug.data.pairs import OWN_PICTURES, Middles, Pair, PairPictures, SomePairs, names_of, shared_frame
from rawaug.data.selection import select_pairs
from rawaug.errors import count_of
from rawaug.tasks.base import TASKS, Task
from rawaug.tasks.settings import HELD_OUT, DataConfig, Recipe
from rawaug.training.estimators import ESTIMATORS
from rawaug.training.noisy_frames import noise_of

_MOST_HELD_OUT = 16
"""At most this many frames are held out for validation: a fifth of them, and at least one."""

_GIVEN = "given pairs"
"""``data.pairs``, ``data.validation`` and ``data.test`` have this value in the results of pairs given from Python."""

_MARGIN = 6
"""A frame is larger than its crops by this many pixels, as they are turned and shifted to a pattern."""

_NAMED = 6


@dataclass(frozen=True)
class Inputs:
    """The data of a run.

    Attributes:
        pairs: the frames that the ISP is fitted to and that are real training frames.
        more: all frames that ``pairs`` were chosen from.
        validation: the frames that choose the weights.
        test: the frames that the result is scored on.
        pictures: sRGB pictures to make RAW of.
        available: the number of frames that ``pairs``, ``validation`` and ``test`` were taken from.
        held_out: whether ``validation`` is a part of ``pairs``.
    """

    pairs: Sequence[Pair]
    more: Sequence[Pair]
    validation: Sequence[Any]
    test: Sequence[Any]
    pictures: Any
    available: tuple[int, int, int]
    held_out: bool

    def lines(self, recipe: Recipe) -> list[str]:
        """List the number and the names of the frames of each part of the run, a line each, for the user to check."""
        data = recipe.data
        of_pairs, of_validation, of_test = self.available

        train = "no RAW frames"
        if self.pairs:
            train = _listing(self.pairs, of_pairs, data.pairs)

        validate = "no frames: monitored on RAW made from the pictures; the final weights are kept"
        if self.validation:
            source = data.validation
            if self.held_out:
                source = f"{data.pairs}, held out"
            validate = _listing(self.validation, of_validation, source, _MOST_HELD_OUT)

        isp = f"fitted to {count_of(len(self.pairs), 'frame')}"
        if recipe.isp_source is not None:
            isp = f"{recipe.isp_source.name}, unchanged"
            if recipe.isp_source.camera is not None:
                isp = f"{recipe.isp_source.name} as {recipe.isp_source.camera}"

        return [
            f"train     {train}",
            f"validate  {validate}",
            f"test      {_listing(self.test, of_test, data.test)}",
            f"pictures  {len(self.pictures)} of {data.pictures}",
            f"ISP       {isp}",
        ]

    def read(self) -> tuple[Inputs, list[str]]:
        """Leave out the frames that cannot be read; return the data without them, and lines that name them.

        All frames are read once, since it is better to find a damaged one now than after the training.
        """
        pairs, validation, test = Readable(self.pairs), Readable(self.validation), Readable(self.test)
        readable_pairs = list(pairs)
        for frames in (validation, test):
            for _ in frames:
                pass

        lines = left_out(pairs, "data.pairs") + left_out(validation, "data.validation") + left_out(test, "data.test")
        inputs = replace(self, pairs=readable_pairs, validation=validation.kept(), test=test.kept())
        return inputs, lines


def _listing(frames: Sequence[Pair], available: int, source: Any, most: int = _NAMED) -> str:
    """Say which frames of a dataset are used, as in ``"2 of 8 of demo:train: a, b"``.

    Args:
        frames: the frames that are used.
        available: the number of frames that they are taken from.
        source: name of the dataset.
        most: largest number of frames that are named.
    """
    names = names_of(frames)
    text = ", ".join(names[:most])
    if len(names) > most:
        text += f" and {len(names) - most} more"

    return f"{len(names)} of {available} of {source}: {text}"


# -- opening -----------------------------------------------------------------------------------------------------------


def open_inputs(recipe: Recipe, frames: Mapping[str, Sequence[Pair]], task: Task | None = None) -> Inputs:
    """Open and divide the data that a recipe names, or those in ``frames`` instead; no frame is read.

    Raises:
        FileNotFoundError: if there are no such data.
        ValueError: if they are not what the recipe needs, or a test frame is also among the others.
    """
    data = recipe.data
    task = task or TASKS[recipe.kind](recipe)
    clean = not recipe.self_supervised

    test = task.open(frames.get("test", data.test), "test", True)
    pairs = task.open(frames.get("pairs", data.pairs), "train", clean)
    _require_unseen(test, pairs, "pairs")

    validation_source = frames.get("validation", data.validation)
    held_out = isinstance(validation_source, str) and validation_source == HELD_OUT
    if held_out:
        count = len(pairs) - _number_held_out(len(pairs))
        validation: Sequence[Any] = SomePairs(pairs, range(count, len(pairs)))
        available = len(pairs)
    else:
        count = len(pairs)
        validation = task.open(validation_source, "validation", clean)
        available = len(validation)
        _require_unseen(test, validation, "validation")

    training_pairs: Sequence[Pair] = SomePairs(pairs, select_pairs(pairs, count, data.count, data.select))
    if data.crop is not None:
        training_pairs = Middles(training_pairs, data.crop)

    return Inputs(
        pairs=training_pairs,
        more=Kept(SomePairs(pairs, range(count)), megabytes=2048),
        validation=task.prepare(validation, "validation"),
        test=task.prepare(test, "test"),
        pictures=_open_pictures(data, training_pairs, recipe.train.crop),
        available=(len(pairs), available, len(test)),
        held_out=held_out,
    )


def _number_held_out(available: int) -> int:
    """Compute how many of the available frames are held out; of a single one, none is."""
    if available < 2:
        return 0

    return min(max(1, available // 5), _MOST_HELD_OUT)


def _require_unseen(test: Sequence[Any], frames: Sequence[Any], part: str) -> None:
    """Raise ValueError if a test frame is also in another part."""
    shared = shared_frame(test, frames)
    if shared is not None:
        raise ValueError(f"data.test: {shared} is also in data.{part}; test on unseen frames")


def _open_pictures(data: DataConfig, pairs: Sequence[Pair], crop: int) -> Any:
    """Open the pictures to make RAW of, from the pairs or elsewhere, cached as far as the recipe says."""
    pictures: Any = PairPictures(pairs)
    if data.pictures != OWN_PICTURES:
        pictures = open_pictures(data.pictures, crop + _MARGIN, data.max_pixels)

    if data.memory_mb:
        pictures = Cached(pictures, data.memory_mb)

    return pictures


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
        if recipe.isp is None and not pair.color_known:
            raise ValueError(
                f"{pair.name}: its white balance and colour matrix are unknown, so no ISP can be fitted to it; "
                "use a shipped one: isp: universal"
            )
        if real and min(pair.raw.shape[-2:]) < recipe.train.crop + _MARGIN:
            size = f"{pair.raw.shape[-2]} x {pair.raw.shape[-1]}"
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
    if recipe.isp_source is not None:
        levels = recipe.isp_source.load().info.get("noise")

    noisy_frames = list(validation)
    if real:
        noisy_frames += pairs
    for pair in noisy_frames:
        noise_of(pair, levels)
