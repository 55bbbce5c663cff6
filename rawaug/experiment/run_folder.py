"""The folder of a run: ``OUT/NAME``, which holds one run alone.

``run.json`` holds its settings. The same ones resume it; others are refused, but for those that change no result.
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
FREE = frozenset({"name", "out", "device", "devices", "seeds", "self_ensemble", "views"})
"""Keys of a run that may change when it is resumed: where it runs, and what only adds to its results."""
FREE_ANYWHERE = SAME_WEIGHTS | {"memory_mb"}
"""Such keys of its parts."""


def run_folder(settings: Any) -> Path:
    out, name = Path(settings.out), Path(settings.name)
    if name.is_absolute() or ".." in name.parts or not name.parts:
        raise ValueError(
            f"name {settings.name!r}: must be a folder within {out}; give a name without .. and not beginning with /"
        )
    return out / name


def require_free(settings: Any, overwrite: bool = False) -> Path:
    """The folder of a run, checked: it can be written, and is empty or this run's."""
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
        known = dict(_flat(json.loads(stamp.read_text())))
    except json.JSONDecodeError as error:
        raise ValueError(f"{stamp}: not valid JSON ({error.msg}); {advice}") from None
    asked = dict(_flat(json.loads(json.dumps(asdict(settings)))))
    changed = [key for key in sorted(known | asked) if known.get(key) != asked.get(key)]
    changed = [key for key in changed if key not in FREE and key.rpartition(".")[2] not in FREE_ANYWHERE]
    if changed:
        differences = ", ".join(f"{key} {known.get(key)}, now {asked.get(key)}" for key in changed[:3])
        more = f", and {len(changed) - 3} more" if len(changed) > 3 else ""
        raise ValueError(f"{folder}: holds a run with other settings ({differences}{more}); {advice}")
    return folder


def claim(settings: Any, overwrite: bool = False) -> Path:
    folder = require_free(settings, overwrite)
    write_json(asdict(settings), folder / STAMP)
    return folder


def _flat(value: Mapping[str, Any], above: str = "") -> Iterator[tuple[str, Any]]:
    """Dotted keys, as on the command line, and their values."""
    for key, inner in value.items():
        if isinstance(inner, Mapping) and inner:
            yield from _flat(inner, f"{above}{key}.")
        else:
            yield f"{above}{key}", inner or None if isinstance(inner, Mapping) else inner
