"""What is read: pictures, RAW files, published datasets and the built-in demo data.

They come as datasets of sRGB pictures (:func:`open_pictures`) or as RAW-sRGB pairs (:func:`open_pairs`); what has no
clean version, the benchmarks of SIDD and DND, comes as noisy blocks with a writer for submissions.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Sequence
from typing import Any

from torch import Tensor

from rawaug.data.check import DataReport, check
from rawaug.data.demo.camera import DemoCamera
from rawaug.data.demo.dead_leaves import dead_leaves
from rawaug.data.demo.demo_pairs import demo_pairs, demo_photographs, demo_pictures
from rawaug.data.dnd import Dnd, DndCrop, check_dnd_submission, write_dnd_submission
from rawaug.data.fivek import fivek_pairs
from rawaug.data.pair import Pair
from rawaug.data.picture_folder import PictureFolder
from rawaug.data.raw_folder import RawFolder
from rawaug.data.rawir import Rawir
from rawaug.data.sidd.blocks import SiddBenchmark, SiddBlocks, SiddPlusBlocks
from rawaug.data.sidd.frames import SiddFrames
from rawaug.data.sidd.submission import check_submission, write_submission
from rawaug.data.zurich import Zurich
from rawaug.registry import DATASETS, PICTURES, Registry, nearest

__all__ = [
    "DataReport",
    "DemoCamera",
    "Dnd",
    "DndCrop",
    "Pair",
    "PictureFolder",
    "RawFolder",
    "Rawir",
    "SiddBenchmark",
    "SiddBlocks",
    "SiddFrames",
    "SiddPlusBlocks",
    "Zurich",
    "check",
    "check_dnd_submission",
    "check_submission",
    "dead_leaves",
    "demo_pairs",
    "demo_photographs",
    "demo_pictures",
    "fivek_pairs",
    "open_pairs",
    "open_pictures",
    "write_dnd_submission",
    "write_submission",
]

_SPLITS = ("train", "validation", "test")


def open_pairs(spec: str, split: str = "test") -> Sequence[Pair]:
    """Open RAW-sRGB pairs.

    Args:
        spec: a RAW file, a folder of RAW files, or ``kind:path`` for a known dataset: ``"demo:"``, ``"demo:train"``,
            ``"sidd:SIDD_Medium_Raw"``, ``"zurich:Zurich-RAW-to-DSLR:test"`` (with the split last).
        split: of a dataset that has splits, unless ``spec`` names one. A folder has none. ``sidd`` has ``train`` (the
            full frames) and ``test`` (the validation blocks), ``fivek`` and ``zurich`` have ``train`` and ``test``.

    Raises:
        FileNotFoundError, ValueError: if there is no such kind, split, file or folder.

    Example:
        >>> len(open_pairs("demo:validation"))
        4
    """
    kind, path = _kind_and_path(spec)
    if kind is None:
        return RawFolder(path)
    reader = _reader(DATASETS, spec, kind, path, "a RAW file or folder")
    path, named = _path_and_split(path)
    pairs: Sequence[Pair] = reader(path, named or split)
    return pairs


def open_pictures(spec: str, min_side: int = 2) -> Sequence[Tensor] | PictureFolder:
    """Open sRGB pictures, uint8 ``(3, H, W)``: a folder, or ``"demo:"``.

    Args:
        spec: ``"demo:"`` or the path of a folder.
        min_side: smaller pictures of a folder are skipped and reported; use the side of your crops.

    Raises:
        FileNotFoundError, ValueError: if there is no such kind or folder, or it holds no picture.
    """
    kind, path = _kind_and_path(spec)
    if kind is None:
        return PictureFolder(path, min_side)
    pictures: Sequence[Tensor] = _reader(PICTURES, spec, kind, path, "a folder")(path, min_side)
    return pictures


def _reader(kinds: Registry, spec: str, kind: str, path: str, other: str) -> Callable[[str, Any], Any]:
    if kind not in kinds:
        known = ", ".join(f"{name}:" for name in kinds)
        raise ValueError(f"{spec}: unknown {kinds.kind}; use {known} or the path of {other}{nearest(kind, kinds)}")
    reader: Callable[[str, Any], Any] = kinds[kind]
    if not path and inspect.signature(reader).parameters["path"].default is inspect.Parameter.empty:
        raise ValueError(f"{spec}: has no path; write {kind}:PATH")
    return reader


def _kind_and_path(spec: str) -> tuple[str | None, str]:
    """``"kind:path"`` taken apart; the kind of a bare path (``C:\\shots`` too) is None."""
    kind, colon, path = spec.partition(":")
    return (kind, path) if colon and len(kind) > 1 and kind.isidentifier() else (None, spec)


def _path_and_split(path: str) -> tuple[str, str | None]:
    """``"path:split"`` taken apart; demo's bare split is its path."""
    folder, colon, split = path.rpartition(":")
    return (folder, split) if colon and split in _SPLITS else (path, None)
