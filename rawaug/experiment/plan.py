"""What a run will use: its frames, opened and divided but not yet read, the lines that say so, and the dry run."""

from __future__ import annotations

import io
from collections import deque
from collections.abc import Collection, Mapping, Sequence
from contextlib import redirect_stdout
from dataclasses import dataclass, replace
from tempfile import TemporaryDirectory
from typing import Any, get_type_hints

from rawaug.data import open_pairs, open_pictures
from rawaug.data.folders import Cached, Kept, Readable, left_out
from rawaug.data.pairs import (
    OWN_PICTURES,
    Binned,
    Middles,
    Pair,
    PairPictures,
    SomePairs,
    names_of,
    selected,
    shared_frame,
)
from rawaug.evaluation.trials import Measured
from rawaug.experiment.recipe import HELD_OUT, DataConfig, Recipe
from rawaug.experiment.run_folder import require_free
from rawaug.files import find_weights
from rawaug.isp.model import DictionaryISP
from rawaug.registry import ESTIMATORS, EXPERIMENTS
from rawaug.training.noisy_frames import noise_of

MOST_HELD_OUT = 16
"""Largest number of frames that are held out for validation: a fifth of them, but at least one."""
GIVEN = "given pairs"
"""What ``data.pairs``, ... say in results of pairs that were given from Python."""
_NAMED = 6


@dataclass(frozen=True)
class Plan:
    """The data of a run: what is fitted and trained on, what chooses the weights, what the result is scored on.

    ``available`` is the number of frames that
    ``pairs``, ``validation`` and ``test`` were taken from; with ``held_out``, ``validation`` is a part of ``pairs``.
    """

    pairs: Sequence[Pair]
    validation: Sequence[Pair]
    test: Sequence[Pair]
    pictures: Any
    available: tuple[int, int, int]
    held_out: bool

    def lines(self, recipe: Recipe) -> list[str]:
        """What is used of what, a line each."""
        data, (pairs, validation, test) = recipe.data, self.available
        part = f"{data.pairs}, held out" if self.held_out else data.validation
        fitted = f"fitted to {len(self.pairs)} frame{'s' * (len(self.pairs) != 1)}"
        watched = "no frames: monitored on RAW made from the pictures; the final weights are kept"
        found = {
            "train": used(self.pairs, pairs, data.pairs) if self.pairs else "no RAW frames",
            "validate": used(self.validation, validation, part, MOST_HELD_OUT) if self.validation else watched,
            "test": used(self.test, test, data.test),
            "pictures": f"{len(self.pictures)} of {data.pictures}",
            "ISP": fitted if recipe.camera is None else f"{recipe.camera}, unchanged",
        }
        return [f"{what:<10}{said}" for what, said in found.items()]

    def read(self) -> tuple[Plan, list[str]]:
        """The plan without the frames that cannot be read, those of ``pairs`` in memory; and lines that name them.

        All are read once: a damaged frame is better found now than after the training.
        """
        parts = {key: Readable(getattr(self, key)) for key in ("pairs", "validation", "test")}
        found = list(parts["pairs"])
        for key in ("validation", "test"):
            deque(parts[key], maxlen=0)
        lines = [line for key, part in parts.items() for line in left_out(part, f"data.{key}")]
        return replace(self, pairs=found, validation=parts["validation"].kept(), test=parts["test"].kept()), lines


def with_own_pairs(recipe: Recipe, content: Mapping[str, Any], given: Collection[str]) -> Recipe:
    """A recipe whose pairs were replaced uses all of them, and holds out a part of them to validate on.

    What its file says of ``data.count`` and ``data.validation`` is about its own pairs; a validation of null stays.
    """
    usual = (content.get("data") or {}).get("pairs", DataConfig.pairs)
    if "data.pairs" not in given or recipe.data.pairs is None or _kind(recipe.data.pairs) == _kind(usual):
        return recipe
    reset: dict[str, Any] = {"count": None} | ({} if recipe.data.validation is None else {"validation": HELD_OUT})
    changes = {key: value for key, value in reset.items() if f"data.{key}" not in given}
    return replace(recipe, data=replace(recipe.data, **changes))


def _kind(spec: str | None) -> str | None:
    """The dataset of a spec; a folder is one of its own."""
    kind, colon, _ = (spec or "").partition(":")
    return kind if colon and len(kind) > 1 and kind != "pairs" else spec


def with_given_pairs(recipe: Recipe, given: Mapping[str, Sequence[Pair]]) -> Recipe:
    """The recipe whose data are named :data:`GIVEN` where they are given; with pairs alone, some are held out."""
    named: dict[str, Any] = dict.fromkeys(given, GIVEN)
    if "pairs" in given and "validation" not in given and recipe.data.validation is not None:
        named["validation"] = HELD_OUT
    return replace(recipe, data=replace(recipe.data, **named))


def planned(recipe: Recipe, given: Mapping[str, Sequence[Pair]]) -> Plan:
    data, clean = recipe.data, not recipe.self_supervised
    test = _opened(data, given.get("test", data.test), "test", True)
    pairs = _opened(data, given.get("pairs", data.pairs), "train", clean)
    named = given.get("validation", data.validation)
    held_out = isinstance(named, str) and named == HELD_OUT
    count = min(max(1, len(pairs) // 5), MOST_HELD_OUT) if held_out and len(pairs) > 1 else 0
    kept = len(pairs) - count
    validation = SomePairs(pairs, range(kept, len(pairs))) if held_out else _opened(data, named, "validation", clean)
    for part, frames in {"pairs": pairs, "validation": [] if held_out else validation}.items():
        if (seen := shared_frame(test, frames)) is not None:
            raise ValueError(f"data.test: {seen} is also in data.{part}; test on unseen frames")
    chosen = SomePairs(pairs, selected(pairs, kept, data.count, data.select))
    pictures: Any = PairPictures(chosen) if data.pictures == OWN_PICTURES else None
    if pictures is None:
        pictures = open_pictures(data.pictures, recipe.train.crop + 6, data.max_pixels)
    together = recipe.together
    return Plan(
        pairs=chosen,
        validation=some(validation, data.validation_count, data.validation_crop, data.bin, together),
        test=some(test, data.test_count, data.test_crop, data.bin, together, measure=True),
        pictures=Cached(pictures, data.memory_mb) if data.memory_mb else pictures,
        available=(len(pairs), len(pairs) if held_out else len(validation), len(test)),
        held_out=held_out,
    )


def some(
    pairs: Sequence[Pair],
    count: int | None,
    crop: int | None,
    factor: int = 1,
    together: bool = False,
    measure: bool = False,
) -> Sequence[Pair]:
    """The first ``count`` pairs, binned by ``factor``, the middle of each, read once; None for all, or whole frames.

    With ``together``, as for a truth of full colour, the sites of a cell are brought to one centre even if ``factor``
    is 1. With ``measure`` the frames' own noise is measured before they are binned.
    """
    chosen = pairs if count is None else SomePairs(pairs, range(len(pairs))[:count])
    measured = Measured(chosen) if measure else chosen
    binned = Binned(measured, factor, together) if factor > 1 or together else measured
    return Kept(binned if crop is None else Middles(binned, crop))


def _opened(data: DataConfig, spec: str | Sequence[Pair] | None, split: str, clean: bool) -> Sequence[Pair]:
    return [] if spec is None else open_pairs(spec, split, clean, data.max_pixels, **data.settings_of(spec))


def used(frames: Sequence[Pair], available: int, source: Any, most: int = _NAMED) -> str:
    names = names_of(frames)
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return f"{len(names)} of {available} of {source}: {', '.join(names[:most])}{more}"


def require_usable(recipe: Recipe, pairs: Sequence[Pair], validation: Sequence[Pair]) -> None:
    """Check that frames, as they were read, have what fit and arms need of them."""
    real = {name: arm for name, arm in recipe.arms.items() if arm.augmented < 1.0}
    for pair in pairs:
        if recipe.camera is None and not pair.color_known:
            raise ValueError(
                f"{pair.name}: its white balance and colour matrix are unknown, so no ISP can be fitted to it; "
                "use a shipped one: camera: universal"
            )
        if real and min(pair.raw.shape[-2:]) < recipe.train.crop + 6:
            size = f"{pair.raw.shape[-2]} x {pair.raw.shape[-1]}"
            raise ValueError(f"{pair.name}: a frame of {size} is too small for train.crop={recipe.train.crop}")
    if not recipe.self_supervised:
        return
    for name, arm in real.items():
        if (shots := ESTIMATORS.make(arm.estimator).shots) > 1:
            raise ValueError(f"arms.{name}: needs {shots} shots of a scene, frames have 1; set its augmented to 1")
    if recipe.noise != "camera":
        isp = None if recipe.camera is None else DictionaryISP.from_pretrained(find_weights(recipe.camera))
        levels = None if isp is None else isp.info.get("noise")
        for pair in [*(pairs if real else []), *validation]:
            noise_of(pair, levels)


def settings_of(kind: str) -> type[Any]:
    """The dataclass of the keys of a kind of experiment: the type of its function's first argument."""
    settings: type[Any] = next(iter(get_type_hints(EXPERIMENTS[kind]).values()))
    return settings


def dry_run(kind: str, settings: Any, overwrite: bool = False) -> None:
    """Print what data a training would use, and do the run in its shortest form in a temporary folder."""
    folder = require_free(settings, overwrite)
    if isinstance(settings, Recipe):
        print("\n".join(planned(settings, {}).lines(settings)))
    with TemporaryDirectory() as elsewhere, redirect_stdout(io.StringIO()) as said:
        EXPERIMENTS[kind](replace(settings.shortest(), out=elsewhere))
    notes = [line for line in said.getvalue().splitlines() if line.startswith("note: ")]
    found = "it runs, but see the note above" if notes else "no problems found"
    print("\n".join([*notes, f"Dry run: {found}, nothing written to {folder}"]))
