"""What a run will use: its data, opened and divided but not yet read, and its folder; and the dry run.

The folder ``OUT/NAME`` holds one run alone. ``run.json`` in it has the run's settings. The same settings resume it;
others are refused, but for those that change no result.
"""

from __future__ import annotations

import io
import json
from collections import deque
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import redirect_stdout
from dataclasses import asdict, dataclass, replace
from pathlib import Path
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
    select_pairs,
    shared_frame,
)
from rawaug.data.picture_pairs import PicturePairs, is_picture_pairs, open_picture_pairs
from rawaug.evaluation.trials import Measured
from rawaug.experiment.recipe import EXPERIMENTS, HELD_OUT, DataConfig, Recipe
from rawaug.files import LOCK, find_weights, require_writable, write_json
from rawaug.isp.model import DictionaryISP
from rawaug.training.config import SAME_WEIGHTS
from rawaug.training.estimators import ESTIMATORS
from rawaug.training.noisy_frames import noise_of

MOST_HELD_OUT = 16
"""Largest number of frames that are held out for validation: a fifth of them, but at least one."""
GIVEN = "given pairs"
"""The value of ``data.pairs``, ``data.validation`` or ``data.test`` in the results of pairs given from Python."""
_NAMED = 6
STAMP = "run.json"
FREE = frozenset({"name", "out", "device", "devices", "seeds", "self_ensemble", "views"})
"""Keys of a run that may change when it is resumed: they say where it runs, or only add to its results."""
FREE_ANYWHERE = SAME_WEIGHTS | {"memory_mb"}
"""Such keys in parts of the recipe."""


@dataclass(frozen=True)
class Plan:
    """The data of a run.

    Attributes:
        pairs: what the ISP is fitted to, and real training frames.
        validation: what chooses the weights.
        test: what the result is scored on.
        pictures: sRGB pictures to make RAW of.
        available: the number of frames that ``pairs``, ``validation`` and ``test`` were taken from.
        held_out: whether ``validation`` is a part of ``pairs``.
    """

    pairs: Sequence[Pair]
    validation: Sequence[Pair]
    test: Sequence[Pair]
    pictures: Any
    available: tuple[int, int, int]
    held_out: bool

    def lines(self, recipe: Recipe) -> list[str]:
        """The number and the names of the frames of each part of the run, a line each, for the user to check."""
        data, (pairs, validation, test) = recipe.data, self.available
        part = f"{data.pairs}, held out" if self.held_out else data.validation
        fitted = f"fitted to {len(self.pairs)} frame{'s' * (len(self.pairs) != 1)}"
        watched = "no frames: monitored on RAW made from the pictures; the final weights are kept"
        found = {
            "train": listing(self.pairs, pairs, data.pairs) if self.pairs else "no RAW frames",
            "validate": listing(self.validation, validation, part, MOST_HELD_OUT) if self.validation else watched,
            "test": listing(self.test, test, data.test),
            "pictures": f"{len(self.pictures)} of {data.pictures}",
            "ISP": fitted if recipe.camera is None else f"{recipe.camera}, unchanged",
        }
        return [f"{what:<10}{said}" for what, said in found.items()]

    def read(self) -> tuple[Plan, list[str]]:
        """The plan without the frames that cannot be read, and lines that name these.

        All frames are read once: a damaged one is better found now than after the training.
        """
        parts = {key: Readable(getattr(self, key)) for key in ("pairs", "validation", "test")}
        found = list(parts["pairs"])
        for key in ("validation", "test"):
            deque(parts[key], maxlen=0)
        lines = [line for key, part in parts.items() for line in left_out(part, f"data.{key}")]
        return replace(self, pairs=found, validation=parts["validation"].kept(), test=parts["test"].kept()), lines


def use_all_pairs(recipe: Recipe, content: Mapping[str, Any], given: Collection[str]) -> Recipe:
    """The recipe with all of the pairs that replace its own, a part of which is held out to validate on.

    What its file says of ``data.count`` and ``data.validation`` is about its own pairs; a validation of null stays.
    ``content`` is what the file says, and ``given`` the keys that the user has set.
    """
    usual = (content.get("data") or {}).get("pairs", DataConfig.pairs)
    if "data.pairs" not in given or recipe.data.pairs is None or _kind(recipe.data.pairs) == _kind(usual):
        return recipe
    reset: dict[str, Any] = {"count": None} | ({} if recipe.data.validation is None else {"validation": HELD_OUT})
    changes = {key: value for key, value in reset.items() if f"data.{key}" not in given}
    return replace(recipe, data=replace(recipe.data, **changes))


def _kind(spec: str | None) -> str | None:
    """The dataset that a spec names; each folder counts as a dataset."""
    kind, colon, _ = (spec or "").partition(":")
    return kind if colon and len(kind) > 1 and kind != "pairs" else spec


def name_given_pairs(recipe: Recipe, given: Mapping[str, Sequence[Pair]]) -> Recipe:
    """The recipe with :data:`GIVEN` as the name of data that are given; if pairs alone are, some are held out."""
    named: dict[str, Any] = dict.fromkeys(given, GIVEN)
    if "pairs" in given and "validation" not in given and recipe.data.validation is not None:
        named["validation"] = HELD_OUT
    return replace(recipe, data=replace(recipe.data, **named))


def plan_data(recipe: Recipe, given: Mapping[str, Sequence[Pair]]) -> Plan:
    """Open and divide the data that a recipe names, or that are ``given`` in their place; no frame is read.

    Raises:
        FileNotFoundError: if there are no such data.
        ValueError: if they are not what the recipe needs, or a test frame is also among the others.
    """
    data, clean = recipe.data, not recipe.self_supervised
    if recipe.target != "srgb" and (wrong := next(filter(is_picture_pairs, (data.validation or "", data.test)), "")):
        raise ValueError(f"data: {wrong} is pairs of developed pictures, for rawaug run srgb; give RAW frames")
    test = _open(data, given.get("test", data.test), "test", True)
    pairs = _open(data, given.get("pairs", data.pairs), "train", clean)
    named = given.get("validation", data.validation)
    held_out = isinstance(named, str) and named == HELD_OUT
    count = min(max(1, len(pairs) // 5), MOST_HELD_OUT) if held_out and len(pairs) > 1 else 0
    kept = len(pairs) - count
    validation = SomePairs(pairs, range(kept, len(pairs))) if held_out else _open(data, named, "validation", clean)
    for part, frames in {"pairs": pairs, "validation": [] if held_out else validation}.items():
        if (seen := shared_frame(test, frames)) is not None:
            raise ValueError(f"data.test: {seen} is also in data.{part}; test on unseen frames")
    chosen = SomePairs(pairs, select_pairs(pairs, kept, data.count, data.select))
    pictures: Any = PairPictures(chosen) if data.pictures == OWN_PICTURES else None
    if pictures is None:
        pictures = open_pictures(data.pictures, recipe.train.crop + 6, data.max_pixels)
    return Plan(
        pairs=chosen,
        validation=_part_in_use(recipe, "validation", validation),
        test=_part_in_use(recipe, "test", test),
        pictures=Cached(pictures, data.memory_mb) if data.memory_mb else pictures,
        available=(len(pairs), len(pairs) if held_out else len(validation), len(test)),
        held_out=held_out,
    )


def _part_in_use(recipe: Recipe, part: str, pairs: Sequence[Pair]) -> Sequence[Pair]:
    """The pairs of a part, "validation" or "test", as the recipe counts, bins and crops them; each is read once."""
    data = recipe.data
    count, crop = getattr(data, f"{part}_count"), getattr(data, f"{part}_crop")
    chosen = pairs if count is None else SomePairs(pairs, range(len(pairs))[:count])
    if isinstance(pairs, PicturePairs):  # neither measured nor binned
        return Kept(chosen if crop is None else Middles(chosen, crop))
    measured = Measured(chosen) if part == "test" else chosen  # whole frames: binning takes most of their noise
    binned = Binned(measured, data.bin, recipe.together) if data.bin > 1 or recipe.together else measured
    return Kept(binned if crop is None else Middles(binned, crop))


def _open(data: DataConfig, spec: str | Sequence[Pair] | None, split: str, clean: bool) -> Sequence[Pair]:
    if isinstance(spec, str) and is_picture_pairs(spec):
        return open_picture_pairs(spec)
    return [] if spec is None else open_pairs(spec, split, clean, data.max_pixels, **data.settings_of(spec))


def listing(frames: Sequence[Pair], available: int, source: Any, most: int = _NAMED) -> str:
    """Tell which frames of a dataset are used, as in ``"2 of 8 of demo:train: a, b"``.

    Args:
        frames: what is used.
        available: the number of frames that they are taken from.
        source: its name.
        most: the number of frames that are named.
    """
    names = names_of(frames)
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return f"{len(names)} of {available} of {source}: {', '.join(names[:most])}{more}"


def require_usable(recipe: Recipe, pairs: Sequence[Pair], validation: Sequence[Pair]) -> None:
    """Raise ValueError unless the frames, as they were read, have what the fit and the arms need of them."""
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
    """The dataclass with the keys of a kind of experiment, which is the type of its function's first argument."""
    settings: type[Any] = next(iter(get_type_hints(EXPERIMENTS[kind]).values()))
    return settings


def dry_run(kind: str, settings: Any, overwrite: bool = False) -> None:
    """Print what data a training would use, and try the run in its shortest form in a temporary folder.

    ``kind`` names the experiment, and ``settings`` are its recipe; ``overwrite`` as for the run itself.
    """
    folder = require_free(settings, overwrite)
    if isinstance(settings, Recipe):
        print("\n".join(plan_data(settings, {}).lines(settings)))
    with TemporaryDirectory() as elsewhere, redirect_stdout(io.StringIO()) as said:
        EXPERIMENTS[kind](replace(settings.shortest(), out=elsewhere))
    notes = [line for line in said.getvalue().splitlines() if line.startswith("note: ")]
    found = "it runs, but see the note above" if notes else "no problems found"
    print("\n".join([*notes, f"Dry run: {found}, nothing written to {folder}"]))


# -- the folder of a run -----------------------------------------------------------------------------------------------


def run_folder(settings: Any) -> Path:
    """``OUT/NAME`` of a recipe; ValueError if the name leads out of OUT."""
    out, name = Path(settings.out), Path(settings.name)
    if name.is_absolute() or ".." in name.parts or not name.parts:
        raise ValueError(
            f"name {settings.name!r}: must be a folder within {out}; give a name without .. and not beginning with /"
        )
    return out / name


def require_free(settings: Any, overwrite: bool = False) -> Path:
    """The folder of a run; ValueError unless it can be written, and is empty, this run's, or to be replaced."""
    folder = run_folder(settings)
    require_writable(folder, folder=True)
    rests = (LOCK, ".partial")  # what a run has as it begins, or left when it was killed there
    if overwrite or not folder.is_dir() or all(file.name.endswith(rests) for file in folder.iterdir()):
        return folder
    advice = "give this run another --name, or --overwrite to replace that one"
    stamp = folder / STAMP
    if not stamp.is_file():
        raise ValueError(f"{folder}: holds files, but not the settings of a run ({STAMP}); {advice}")
    try:
        known = dict(_flatten(json.loads(stamp.read_text())))
    except json.JSONDecodeError as error:
        raise ValueError(f"{stamp}: not valid JSON ({error.msg}); {advice}") from None
    asked = dict(_flatten(json.loads(json.dumps(asdict(settings)))))
    changed = [key for key in sorted(known | asked) if known.get(key) != asked.get(key)]
    changed = [key for key in changed if key not in FREE and key.rpartition(".")[2] not in FREE_ANYWHERE]
    if changed:
        differences = ", ".join(f"{key} {known.get(key)}, now {asked.get(key)}" for key in changed[:3])
        more = f", and {len(changed) - 3} more" if len(changed) > 3 else ""
        raise ValueError(f"{folder}: holds a run with other settings ({differences}{more}); {advice}")
    return folder


def claim(settings: Any, overwrite: bool = False) -> Path:
    """The folder of a run with the run's settings in it; ValueError if it is another run's."""
    folder = require_free(settings, overwrite)
    write_json(asdict(settings), folder / STAMP)
    return folder


def _flatten(value: Mapping[str, Any], above: str = "") -> Iterator[tuple[str, Any]]:
    """Dotted keys, as on the command line, and their values."""
    for key, inner in value.items():
        if isinstance(inner, Mapping) and inner:
            yield from _flatten(inner, f"{above}{key}.")
        else:
            yield f"{above}{key}", inner or None if isinstance(inner, Mapping) else inner
