"""The settings that the files of an output folder were made with, so that it never holds files of two settings."""

from __future__ import annotations

import json
from pathlib import Path

from rawaug.files import write_json


def require_same_settings(path: Path, settings: dict[str, object], overwrite: bool = False) -> None:
    """Write the settings of a folder's files to ``path``, or compare them with those in it, unless ``overwrite``.

    Raises:
        ValueError: if the existing files were made with other settings.
    """
    if path.is_file() and not overwrite:
        try:
            known = json.loads(path.read_text())
        except json.JSONDecodeError as error:
            raise ValueError(f"{path}: not valid JSON ({error.msg}); choose another folder") from None
        for key in known | settings:
            value, asked = known.get(key), settings.get(key)
            if asked != value:
                raise ValueError(f"{path}: made with {key} {value}, not {asked}; choose another folder")
        return
    write_json(settings, path)
