"""Names of cameras, as published tables spell them: maker and model. Look-up ignores case and spaces."""

from __future__ import annotations

import difflib
from collections.abc import Iterable


def spelled(name: str, known: Iterable[str]) -> str:
    """The one of ``known`` that ``name`` is; of several the first.

    Raises:
        ValueError: if there is no such name; similar ones are suggested.

    Example:
        >>> spelled("nikon  d750", ["Nikon D750", "Nikon D7500"])
        'Nikon D750'
    """
    by_key: dict[str, str] = {}
    for candidate in known:
        by_key.setdefault(_key(candidate), candidate)
    if _key(name) in by_key:
        return by_key[_key(name)]
    similar = difflib.get_close_matches(_key(name), by_key, n=3)
    hint = f"; similar: {', '.join(by_key[key] for key in similar)}" if similar else ""
    raise ValueError(f"camera {name!r} is not listed{hint}")


def _key(name: str) -> str:
    return " ".join(name.casefold().split())
