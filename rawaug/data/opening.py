"""Pairs and pictures by name: a path, or ``kind:path`` for a dataset with a registered reader."""

from __future__ import annotations

import inspect
import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from torch.utils.data import ConcatDataset

from rawaug.data.folders import PictureFolder, RawFolder
from rawaug.data.frames import OWN_PICTURES, Frames, as_frames
from rawaug.data.pair_folder import require_no_pairs
from rawaug.data.pairs import DATASETS, PICTURES, Pair
from rawaug.data.picture_pairs import is_picture_pairs, open_picture_pairs
from rawaug.files import fingerprint
from rawaug.io.content import list_pictures
from rawaug.io.pictures import MAX_PIXELS
from rawaug.registry import Registry, check_settings, suggest

_SPLITS = ("train", "validation", "test")


def open_pairs(
    spec: str | Path | Sequence[Pair],
    split: str = "test",
    as_clean: bool = True,
    max_pixels: int | None = None,
    bin: int = 1,
    developed: bool = False,
    **settings: Any,
) -> Frames[Any]:
    """Open RAW-sRGB pairs: a sequence of :class:`rawaug.data.Pair` that are read on access.

    Args:
        spec: a RAW file, a folder of RAW files, or ``kind:path`` for a known dataset: ``"pairs:MY_PAIRS"``,
            ``"demo:"``, ``"demo:train"``, ``"sidd:SIDD_Medium_Raw"``, ``"zurich:Zurich-RAW-to-DSLR:test"`` (with the
            split last). A sequence of pairs is taken as it is.
        split: the split of a dataset that has splits, unless ``spec`` names one. A folder has none. ``sidd`` has
            ``train`` (the full frames) and ``test`` (the validation blocks), ``fivek`` and ``zurich`` have ``train``
            and ``test``.
        as_clean: whether the frames of a bare folder are taken for clean ones, so that ``NAME_noisy.dng`` is refused.
        max_pixels: the limit of the sRGB pictures, and of mosaics in PNG files; larger ones are an error of their pair.
            None stands for :data:`rawaug.io.pictures.MAX_PIXELS`. Pairs given as a sequence keep theirs.
        bin: K makes each site the mean of K x K sites of its colour around it: a reference with about 1 / K^2 of its
            own noise.
        developed: open pairs of developed pictures, such as ``cc15:DIR``, instead of raising an error; they are
            :class:`rawaug.data.picture_pairs.PicturePair`.
        settings: settings of the reader of ``kind``, such as ``cfa="RGGB"`` of ``pairs:``; None keeps the default.

    Raises:
        FileNotFoundError, ValueError: if there is no such kind, split, file, folder or setting, or noisy/clean pairs
            are opened as a bare folder.

    Example:
        >>> len(open_pairs("demo:validation"))
        4
    """
    if bin != 1:
        return open_pairs(spec, split, as_clean, max_pixels, developed=developed, **settings).binned(bin)

    settings = {key: value for key, value in settings.items() if value is not None}
    if not isinstance(spec, (str, Path)):
        _require_none(settings, "a sequence of pairs")
        if not isinstance(spec, Frames) and not _are_pairs(spec):
            raise ValueError(f"data must be a path, kind:path or a non-empty list of Pair, got {type(spec).__name__}")
        return as_frames(spec)

    kind, path = _kind_and_path(str(spec))
    if kind is None:
        _require_none(settings, spec)
        folder = RawFolder(path, max_pixels=max_pixels or MAX_PIXELS)
        require_no_pairs(folder, str(spec), as_clean)
        return folder

    if is_picture_pairs(str(spec)):
        if not developed:
            raise ValueError(f"{spec} is pairs of developed pictures, for rawaug run srgb; give RAW frames")
        return open_picture_pairs(str(spec), **settings)

    reader = _reader(DATASETS, str(spec), kind, path, "a RAW file or folder")
    path, split_of_spec = _path_and_split(path)
    if settings:
        settings = check_settings(f"{kind}:", reader, settings, given=("path", "split"))
    pairs = as_frames(reader(path, split_of_spec or split, **settings))
    if max_pixels is not None:
        pairs.max_pixels = max_pixels
    return pairs


def names_dataset(spec: str | Path) -> bool:
    """Whether ``spec`` is ``kind:path`` rather than the path of RAW files."""
    kind, _ = _kind_and_path(str(spec))
    return kind is not None


def _are_pairs(pairs: Any) -> bool:
    return isinstance(pairs, Sequence) and len(pairs) > 0 and all(isinstance(pair, Pair) for pair in pairs)


def _require_none(settings: Mapping[str, Any], spec: object) -> None:
    if settings:
        raise ValueError(f"{spec}: {', '.join(settings)} can only be given for pairs:PATH")


def open_pictures(spec: str | Path | Sequence[str | Path], min_side: int = 2, max_pixels: int | None = None) -> Any:
    """Open sRGB pictures, a map-style dataset of uint8 ``(3, H, W)``: a folder, ``"demo:"``, ``"shapes:100"``.

    Args:
        spec: the path of a folder or of a picture, ``"demo:"``, ``"shapes:COUNT"``, or several of these, one after
            the other.
        min_side: smaller pictures of a folder are skipped and reported; use the side of your crops.
        max_pixels: larger pictures likewise; None stands for :data:`rawaug.io.pictures.MAX_PIXELS`.

    Raises:
        FileNotFoundError, ValueError: if there is no such kind or folder, or it holds no picture.

    Example:
        >>> len(open_pictures(["demo:", "shapes:10"]))
        42
    """
    if not isinstance(spec, (str, Path)):
        return ConcatDataset([open_pictures(name, min_side, max_pixels) for name in spec])

    spec = str(spec)
    kind, path = _kind_and_path(spec)
    if kind is None:
        return PictureFolder(path, min_side, max_pixels or MAX_PIXELS)
    return _reader(PICTURES, spec, kind, path, "a folder")(path, min_side)


def picture_stamp(spec: str | Path | Sequence[str | Path]) -> str:
    """Compute a fingerprint of the files that :func:`open_pictures` opens, by name, size and modification time.

    No file is read. Pictures that are no files have their spec as fingerprint.
    """
    if not isinstance(spec, (str, Path)):
        return fingerprint([picture_stamp(name) for name in spec])

    kind, path = _kind_and_path(str(spec))
    if kind is not None or spec == OWN_PICTURES:
        return str(spec)

    files = []
    for file in list_pictures(path).files:
        status = file.stat()
        files.append((os.path.relpath(file, path), status.st_size, status.st_mtime_ns))
    return fingerprint(files)


def _reader(kinds: Registry, spec: str, kind: str, path: str, other: str) -> Callable[[str, Any], Any]:
    if kind not in kinds:
        prefixes = ", ".join(f"{name}:" for name in kinds)
        raise ValueError(f"{spec}: unknown {kinds.kind}; use {prefixes} or the path of {other}{suggest(kind, kinds)}")

    reader: Callable[[str, Any], Any] = kinds[kind]
    if not path and inspect.signature(reader).parameters["path"].default is inspect.Parameter.empty:
        raise ValueError(f"{spec}: has no path; write {kind}:PATH")
    return reader


def _kind_and_path(spec: str) -> tuple[str | None, str]:
    """Split ``"kind:path"``; the kind is None for a plain path, including ``C:\\shots``."""
    kind, colon, path = spec.partition(":")
    if colon and len(kind) > 1 and kind.replace("-", "").isidentifier():
        return kind, path
    return None, spec


def _path_and_split(path: str) -> tuple[str, str | None]:
    """Split ``"path:split"``; the split is None if not given."""
    folder, colon, split = path.rpartition(":")
    if colon and split in _SPLITS:
        return folder, split
    return path, None
