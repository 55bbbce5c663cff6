"""Cameras by the names that people use for them; published tables hold the names in the files' EXIF tags.

Two names are alike if they have the same letters and digits after these changes, which keep cameras apart:

- a mark is ``M2`` whether it is written ``Mark II``, ``MkII``, ``II`` or Nikon's ``_2``;
- Sony's ILCE, ILCA, SLT and DSLR are the line A, so that the A7 III is the ILCE-7M3; DSC, DMC and DC, and the words EOS
  and Lumix, are left out;
- a maker is named once, without what its files add: NIKON CORPORATION NIKON D5000, OLYMPUS IMAGING CORP. E-M1;
- a camera that Canon sells under three names goes by its number: the Rebel T4i and the Kiss X6i are the 650D.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable
from functools import lru_cache

_CANON = """
100D Rebel SL1, Kiss X7; 200D Rebel SL2, Kiss X9; 250D 200D II, Rebel SL3, Kiss X10; 300D Rebel, Kiss;
350D Rebel XT, Kiss N; 400D Rebel XTi, Kiss X; 450D Rebel XSi, Kiss X2; 500D Rebel T1i, Kiss X3;
550D Rebel T2i, Kiss X4; 600D Rebel T3i, Kiss X5; 650D Rebel T4i, Kiss X6i; 700D Rebel T5i, Kiss X7i;
750D Rebel T6i, Kiss X8i; 760D Rebel T6s, 8000D; 77D 9000D; 800D Rebel T7i, Kiss X9i; 850D Rebel T8i, Kiss X10i;
1000D Rebel XS, Kiss F; 1100D Rebel T3, Kiss X50; 1200D Rebel T5, Kiss X70; 1300D Rebel T6, Kiss X80;
2000D Rebel T7, Kiss X90; 4000D Rebel T100; M50 Kiss M
"""
"""EOS cameras, each with its names on other continents, without "Digital". Source: LibRaw's list of cameras."""

_MARKS = {"i": 1, "ii": 2, "iii": 3, "iv": 4, "v": 5, "vi": 6, "vii": 7}
_ROMAN = r"(i{1,3}|iv|v|vii?)(a?)\b"
_MARK = re.compile(rf"(?:mark|mk)\s*(?:(\d)\b|{_ROMAN})|_(\d)\b|\b{_ROMAN}|(?:(?<=\d)|(?<=\d[rs]))(iii?|iv)\b")
_LINES = (
    (r"\b(corporation|corp|imaging|optical|company|co|ltd|camera ag)\b[.,]*", ""),
    (r"^(\w+)\s+(?=\1\b)|^ricoh\s+(?=pentax\b)", ""),
    (r"[\u03b1\u0251]|\balpha\b", "a"),
    (r"\b(ilce|ilca|slt|dslr)-a?", "a"),
    (r"\b(dsc|dmc|dc)-|\b(eos|lumix)\b", ""),
)


@lru_cache(maxsize=8192)
def camera_key(name: str) -> str:
    """Reduce a name to a key that all names of one camera share.

    Example:
        >>> camera_key("Sony A7 III") == camera_key("Sony ILCE-7M3"), camera_key("Canon EOS 5D Mark II")
        (True, 'canon5dm2')
        >>> camera_key("Nikon Z 6_2"), camera_key("NIKON CORPORATION NIKON D5000")
        ('nikonz6m2', 'nikond5000')
    """
    text = " ".join(name.casefold().split())
    for pattern, instead in _LINES:
        text = re.sub(pattern, instead, text)
    text = _MARK.sub(_mark_in_digits, text)

    key = _letters_and_digits(text)
    return _canon_keys().get(key.replace("digital", ""), key)


def _mark_in_digits(match: re.Match[str]) -> str:
    """Write a mark as ``m2``, however it was written."""
    mark = "m"
    for part in match.groups(default=""):
        mark += str(_MARKS.get(part, part))
    return mark


def _letters_and_digits(text: str) -> str:
    return re.sub(r"[\W_]", "", text)


@lru_cache(maxsize=1)
def _canon_keys() -> dict[str, str]:
    """Map the keys of the other names of EOS cameras to the keys of the cameras."""
    keys = {}
    for row in _CANON.split(";"):
        number, names = row.split(maxsplit=1)
        for name in names.split(","):
            other = _letters_and_digits(name.casefold().replace(" ii", "m2"))
            keys[f"canon{other}"] = f"canon{number.casefold()}"
    return keys


def similar_cameras(part: str, known: Iterable[str]) -> list[str]:
    """List the known cameras that have ``part`` in their names, or all of its words.

    Example:
        >>> similar_cameras("a7 iii", ["Sony ILCE-7M3", "Sony SLT-A77"])
        ['Sony ILCE-7M3']
        >>> similar_cameras("mark ii canon", ["Canon EOS 5D Mark II"])
        ['Canon EOS 5D Mark II']
    """
    key, words = camera_key(part), part.casefold().split()

    similar = []
    for name in known:
        if key in camera_key(name) or all(word in name.casefold() for word in words):
            similar.append(name)
    return similar


def find_camera(name: str, known: Iterable[str]) -> str:
    """Find the known camera, maker and model, that goes by ``name``; if there are several, take the first.

    Raises:
        ValueError: if there is no such name; similar ones are suggested.

    Example:
        >>> find_camera("nikon  d750", ["Nikon D750", "Nikon D7500"]), find_camera("Sony a7 III", ["Sony ILCE-7M3"])
        ('Nikon D750', 'Sony ILCE-7M3')
    """
    candidates = list(dict.fromkeys(known))
    exact = " ".join(name.casefold().split())
    by_key: dict[str, str] = {}
    for candidate in candidates:
        if " ".join(candidate.casefold().split()) == exact:
            return candidate
        by_key.setdefault(camera_key(candidate), candidate)

    key = camera_key(name)
    if key in by_key:
        return by_key[key]

    similar = similar_cameras(name, candidates)[:3]
    if not similar:
        similar = [by_key[near] for near in difflib.get_close_matches(key, by_key, 3, 0.8)]
    hint = f"; similar: {', '.join(similar)}" if similar else ""
    raise ValueError(f"camera {name!r} is not listed{hint}; rawaug info cameras lists all")
