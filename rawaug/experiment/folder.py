"""The folder of a run, ``OUT/NAME``, which holds one run alone.

``run.json`` in it has the run's settings. The same settings resume it; others are refused, but for those that change
no result.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from rawaug.files import LOCK, require_writable, write_json
from rawaug.training.config import SAME_WEIGHTS

STAMP = "run.json"
"""The file with the settings of a run."""

_FREE = frozenset({"name", "out", "device", "devices", "seeds", "self_ensemble", "views"})
"""Keys that may change when a run is resumed, as they do not change its results."""

_FREE_ANYWHERE = SAME_WEIGHTS | {"memory_mb"}
"""Keys in parts of the recipe that may change when a run is resumed."""

_SHOWN = 3
"""Maximum number of changed keys that an error names."""


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
    if overwrite or not _holds_results(folder):
        return folder

    advice = "give this run another --name, or --overwrite to replace that one"
    stamp = folder / STAMP
    if not stamp.is_file():
        raise ValueError(f"{folder}: holds files, but not the settings of a run ({STAMP}); {advice}")

    try:
        before = dict(_flatten(json.loads(stamp.read_text())))
    except json.JSONDecodeError as error:
        raise ValueError(f"{stamp}: not valid JSON ({error.msg}); {advice}") from None

    now = dict(_flatten(json.loads(json.dumps(asdict(settings)))))
    changes = []
    for key in sorted(before | now):
        if before.get(key) == now.get(key) or key in _FREE or key.rpartition(".")[2] in _FREE_ANYWHERE:
            continue
        changes.append(f"{key} {before.get(key)}, now {now.get(key)}")

    if changes:
        texts = changes[:_SHOWN]
        if len(changes) > _SHOWN:
            texts.append(f"and {len(changes) - _SHOWN} more")
        raise ValueError(f"{folder}: holds a run with other settings ({', '.join(texts)}); {advice}")

    return folder


def _holds_results(folder: Path) -> bool:
    """Whether a folder has more than a run has as it begins, or left when it was killed there."""
    if not folder.is_dir():
        return False

    return any(not file.name.endswith((LOCK, ".partial")) for file in folder.iterdir())


def claim(settings: Any, overwrite: bool = False) -> Path:
    """The folder of a run with the run's settings in it; ValueError if it is another run's."""
    folder = require_free(settings, overwrite)
    write_json(asdict(settings), folder / STAMP)
    return folder


def _flatten(value: Mapping[str, Any], above: str = "") -> Iterator[tuple[str, Any]]:
    """Dotted keys, as on the command line, and their values; an empty mapping counts as none."""
    for key, inner in value.items():
        if not isinstance(inner, Mapping):
            yield f"{above}{key}", inner
        elif inner:
            yield from _flatten(inner, f"{above}{key}.")
        else:
            yield f"{above}{key}", None
