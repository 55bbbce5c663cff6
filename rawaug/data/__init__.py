"""What is read: pictures, RAW files and the built-in demo data, as datasets of sRGB pictures or of RAW-sRGB pairs."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from torch import Tensor

from rawaug.data.dead_leaves import dead_leaves
from rawaug.data.demo import demo_pairs, demo_photographs, demo_pictures
from rawaug.data.demo_camera import DemoCamera
from rawaug.data.pairs import Pair
from rawaug.data.picture_folder import PictureFolder
from rawaug.data.raw_folder import RawFolder

__all__ = [
    "DemoCamera",
    "Pair",
    "PictureFolder",
    "RawFolder",
    "dead_leaves",
    "demo_pairs",
    "demo_photographs",
    "demo_pictures",
    "open_pairs",
    "open_pictures",
]

_PAIR_KINDS: dict[str, Callable[[str, str], Sequence[Pair]]] = {
    "demo": lambda path, split: demo_pairs(path or split),
}


def open_pairs(spec: str, split: str = "test") -> Sequence[Pair]:
    """Open RAW-sRGB pairs.

    Args:
        spec: a RAW file, a folder of RAW files, or ``kind:path`` for a known dataset: ``"demo:"``, ``"demo:train"``.
        split: of a dataset that has splits, unless ``spec`` names one. A folder has none.

    Raises:
        FileNotFoundError, ValueError: if there is no such kind, split, file or folder.

    Example:
        >>> len(open_pairs("demo:validation"))
        4
    """
    kind, path = _kind_and_path(spec)
    if kind is None:
        return RawFolder(path)
    if kind not in _PAIR_KINDS:
        known = ", ".join(f"{name}:" for name in _PAIR_KINDS)
        raise ValueError(f"{spec}: no such kind of data; there are {known} or the path of a RAW file or folder")
    return _PAIR_KINDS[kind](path, split)


def open_pictures(spec: str) -> list[Tensor] | PictureFolder:
    """Open sRGB pictures, uint8 ``(3, H, W)``: a folder, or ``"demo:"``.

    Raises:
        FileNotFoundError, ValueError: if there is no such kind or folder, or it holds no picture.
    """
    kind, path = _kind_and_path(spec)
    if kind is None:
        return PictureFolder(path)
    if kind != "demo" or path:
        raise ValueError(f"{spec}: no such kind of pictures; there are demo: or the path of a folder")
    return demo_pictures()


def _kind_and_path(spec: str) -> tuple[str | None, str]:
    """``"kind:path"`` taken apart; the kind of a bare path (``C:\\shots`` too) is None."""
    kind, colon, path = spec.partition(":")
    return (kind, path) if colon and len(kind) > 1 and kind.isidentifier() else (None, spec)
