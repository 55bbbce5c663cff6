"""The folder of a run, ``OUT/NAME``, which holds only that run.

Its file ``run.json`` has the run's settings. The same settings resume the run; others are refused, except for those
that change no result.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from rawaug.files import LOCK, require_folder, write_json
from rawaug.training.config import SAME_WEIGHTS

STAMP = "run.json"
"""Name of the file with the settings of a run."""

_FREE = frozenset({"name", "out", "device", "devices", "seeds", "self_ensemble", "views"})
"""Keys that may change when a run is resumed, as they do not change its results."""

_FREE_ANYWHERE = SAME_WEIGHTS | {"memory_mb"}
"""Keys in parts of the recipe that may change when a run is resumed."""

_MOST_NAME_BYTES = 200
"""Largest length of a name in a recipe that becomes a folder."""

_SHOWN = 3
"""Largest number of changed keys that an error names."""


def require_folder_name(name: str, key: str) -> None:
    """Refuse a name in a recipe, perhaps a stranger's, that would not become a single folder inside another one.

    Args:
        name: the name.
        key: the key of the recipe, which heads the message.

    Raises:
        ValueError: if it is empty, ``.`` or ``..``, has a slash, a backslash or what a terminal cannot print, or is too
            long for the name of a file.
    """
    is_one_folder = name not in ("", ".", "..") and not set(name) & set("/\\")
    if not is_one_folder or not name.isprintable() or len(os.fsencode(name)) > _MOST_NAME_BYTES:
        raise ValueError(f"{key}: {name[:80]!r} cannot be the name of a folder; use letters, digits, - and _")


def run_folder(settings: Any) -> Path:
    """Return ``OUT/NAME`` of a recipe; raise ValueError if the name, or a part between slashes, is no folder's."""
    parts = settings.name.split("/")
    for part in parts:
        require_folder_name(part, "name")

    return Path(settings.out, *parts)


def require_free(settings: Any, overwrite: bool = False) -> Path:
    """Return a run's folder; raise ValueError unless it is writable, and empty, this run's or to be replaced."""
    folder = run_folder(settings)
    require_folder(folder)
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
    """Tell whether a folder has more in it than a run has when it begins, or leaves if it is killed then."""
    if not folder.is_dir():
        return False

    return any(not file.name.endswith((LOCK, ".partial")) for file in folder.iterdir())


def claim(settings: Any, overwrite: bool = False) -> Path:
    """Return the folder of a run, with its settings written there; raise ValueError if it is another run's."""
    folder = require_free(settings, overwrite)
    write_json(asdict(settings), folder / STAMP)
    return folder


def _flatten(value: Mapping[str, Any], above: str = "") -> Iterator[tuple[str, Any]]:
    """Yield dotted keys, as on the command line, and their values; an empty mapping counts as none."""
    for key, inner in value.items():
        if not isinstance(inner, Mapping):
            yield f"{above}{key}", inner
        elif inner:
            yield from _flatten(inner, f"{above}{key}.")
        else:
            yield f"{above}{key}", None
