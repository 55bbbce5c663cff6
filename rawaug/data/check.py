"""Identify the dataset in a folder, count its items, sizes, patterns and levels, and list damaged files.

Everything is read once, as training would read it, but in a helper process (:mod:`rawaug.io.isolated`). A file that
crashes its decoder, or hangs, is named and the rest is read. A folder is recognised by its publisher's file names; any
other folder counts as one of RAW files, of pictures, or both.
"""

from __future__ import annotations

import fnmatch
import pickle
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from functools import lru_cache, partial, singledispatch
from pathlib import Path
from typing import Any

from torch import Tensor

from rawaug.data.dnd import Dnd
from rawaug.data.folders import PictureFolder
from rawaug.data.formats import READABLE
from rawaug.data.frames import Frames
from rawaug.data.opening import open_pairs, open_pictures
from rawaug.data.pair_folder import PairFolder, looks_like_pairs
from rawaug.data.pairs import DATASETS, PICTURES, Pair
from rawaug.data.picture_pairs import PicturePair
from rawaug.data.published import RAWIR_FOLDERS, Rawir, Zurich
from rawaug.data.sidd import SiddFrames
from rawaug.data.sidd_benchmark import SiddBenchmark
from rawaug.data.sidd_blocks import SiddBlocks, SiddPlusBlocks
from rawaug.data.sidd_scenes import is_scene
from rawaug.errors import escape
from rawaug.files import files_below, files_in
from rawaug.io import RawFrame, read_raw
from rawaug.io.content import RAW_EXTENSIONS, identify_content, list_files, picture_extensions
from rawaug.io.isolated import isolated

_MAX_VALUES = 6
"""Maximum number of values of a property that a report lists."""
_PAIRS = "pairs:"


@dataclass
class PartReport:
    """One kind of data in a folder."""

    what: str
    items: int = 0
    examined: int = 0
    counts: dict[str, Counter[str]] = field(default_factory=lambda: defaultdict(Counter))
    broken: list[str] = field(default_factory=list)
    unfit: list[str] = field(default_factory=list)

    def add_broken(self, error: Exception) -> None:
        """Note an item that is damaged, or intact but of a kind that is not used; a file of many blocks is one line."""
        lines = self.broken if isinstance(error, OSError) else self.unfit
        line = " ".join(str(error).split())
        if line not in lines:
            lines.append(line)

    def __str__(self) -> str:
        head = f"{self.what}: {self.items}"
        if self.examined != self.items:
            head += f", {self.examined} examined"

        lines = [head]
        for what, counts in self.counts.items():
            values = [f"{escape(value)} ({count})" for value, count in counts.most_common(_MAX_VALUES)]
            if len(counts) > _MAX_VALUES:
                values.append(f"{len(counts) - _MAX_VALUES} more")
            lines.append(f"  {what}: {', '.join(values)}")

        lines.append(f"  damaged: {len(self.broken) or 'none'}")
        for line in self.broken:
            lines.append(f"    {escape(line)}")
        if self.unfit:
            lines.append(f"  whole, but not usable: {len(self.unfit)}")
        for line in self.unfit:
            lines.append(f"    {escape(line)}")
        return "\n".join(lines)


@dataclass
class DataReport:
    """The report of :func:`check`; ``str()`` is the text that ``rawaug data check`` prints.

    ``left_out`` has a line for each kind of file that no reader here reads.
    """

    path: Path
    parts: list[PartReport]
    left_out: list[str] = field(default_factory=list)

    @property
    def broken(self) -> list[str]:
        """Why items are damaged."""
        lines: list[str] = []
        for part in self.parts:
            lines += part.broken
        return lines

    @property
    def unfit(self) -> list[str]:
        """Why items are intact but not usable, such as a linear DNG among mosaics."""
        lines: list[str] = []
        for part in self.parts:
            lines += part.unfit
        return lines

    def __str__(self) -> str:
        return "\n".join([escape(self.path), *map(str, self.parts), *self.left_out])


def check(path: str | Path, first: int | None = None, **settings: Any) -> DataReport:
    """Identify and read the data in a folder or a RAW file, or those of ``kind:PATH``.

    At most ``first`` items of each kind are read; ``settings`` are those of :class:`PairFolder`, for ``pairs:PATH``.
    """
    settings = {key: value for key, value in settings.items() if value is not None}
    if str(path).startswith(_PAIRS):
        folder = Path(str(path).removeprefix(_PAIRS))
        open_folder = partial(PairFolder, folder, **settings)
        open_folder()  # raises for a wrong setting
        return DataReport(folder, [_part("noisy/clean pairs", open_folder, first)])
    if settings:
        raise ValueError(f"{path}: {', '.join(settings)} can only be given for {_PAIRS}PATH")

    kind, colon, _ = str(path).partition(":")
    if colon and not Path(path).exists():
        parts = _parts(_of_kind(kind, str(path)), first)
        return DataReport(Path(path), [part for part in parts if part.items] or parts)

    path = Path(path)
    if not path.exists():
        raise FileNotFoundError(f"{path}: no such file or folder")
    openers = list(_datasets(path))
    left_out: list[str] = []
    if not openers:
        openers = list(_files(path))
        if path.is_dir():
            left_out = _left_out(path)
    if not openers:
        contents = "; ".join(left_out) or "see docs/datasets.md"
        raise ValueError(f"{path}: contains no known dataset, RAW file or picture; {contents}")
    return DataReport(path, _parts(openers, first), left_out)


def _left_out(folder: Path) -> list[str]:
    """A line for each kind of file in a folder that is neither RAW nor a readable picture."""
    extensions = (*RAW_EXTENSIONS, *picture_extensions())
    if looks_like_pairs(list(files_below(folder))):
        extensions = (*extensions, *READABLE)
    return list_files(folder, extensions, "neither RAW nor a picture that is known").lines()


def _of_kind(kind: str, spec: str) -> list[tuple[str, Callable[[], Any]]]:
    """List how to open ``kind:path``, which may be pairs, pictures, or both."""
    openers: list[tuple[str, Callable[[], Any]]] = []
    if kind in DATASETS:
        openers.append((f"pairs of {spec}", partial(open_pairs, spec, developed=True)))
    if kind in PICTURES:
        openers.append((f"pictures of {spec}", partial(open_pictures, spec)))
    if not openers:
        open_pairs(spec)  # raises for an unknown kind
    return openers


def _datasets(path: Path) -> Iterator[tuple[str, Callable[[], Any]]]:
    """Yield the published datasets recognised by file names, and how to open each."""
    files = list(files_below(path))
    names = [file.name for file in files]

    if any("GT_RAW" in file.name.upper() and is_scene(file.parent.name) for file in files):
        yield "SIDD, full frames", partial(SiddFrames, path)
    if fnmatch.filter(names, "Validation?*BlocksRaw.mat"):
        yield "SIDD, validation blocks", partial(SiddBlocks, path)
    if "BenchmarkNoisyBlocksRaw.mat" in names:
        yield "SIDD, benchmark blocks (noisy only)", partial(SiddBenchmark, path)
    if fnmatch.filter(names, "siddplus_valid_?*_raw.mat"):
        yield "SIDD+, validation blocks", partial(SiddPlusBlocks, path)
    if (path / "info.mat").is_file():
        yield "DND, boxes (noisy only)", partial(Dnd, path)

    has_npy = bool(fnmatch.filter(names, "*.npy"))
    if (path / "train" / "huawei_raw").is_dir() or (path / "test" / "huawei_raw").is_dir():
        for split in ("train", "test"):
            yield f"Zurich RAW to RGB, {split}", partial(Zurich, path, split)
    elif has_npy and not looks_like_pairs(files):
        has_splits = False
        for split, folder in RAWIR_FOLDERS.items():
            if (path / folder).is_dir():
                has_splits = True
                yield f"RAWIR or AIM 2022, {split}", partial(Rawir, path, split)
        if not has_splits:
            yield "RAWIR or AIM 2022", partial(Rawir, path, "train")


def _files(path: Path) -> Iterator[tuple[str, Callable[[], Any]]]:
    """Yield RAW files and pictures of no known dataset; FiveK cannot be told from other DNGs."""
    if path.is_file():
        kind = identify_content(path).kind
        if kind in _READERS:
            what, reader = _READERS[kind]
            yield what, partial(reader, path)
        return

    files = list(files_below(path))
    if looks_like_pairs(files):
        yield "noisy/clean pairs", partial(PairFolder, path)
        return
    extensions = {file.suffix.lower() for file in files}
    if not extensions.isdisjoint(RAW_EXTENSIONS):
        yield "RAW files", partial(_RawFrames, path)
    if not extensions.isdisjoint(picture_extensions()):
        yield "pictures", partial(PictureFolder, path, allowed_share=1)


class _RawFrames(Frames[RawFrame]):
    """RAW files, read without rendering them."""

    def __init__(self, path: Path) -> None:
        self.files = files_in(path, "RAW", RAW_EXTENSIONS)
        super().__init__([str(file) for file in self.files])

    def read(self, index: int) -> RawFrame:
        return read_raw(self.files[index])


_READERS: dict[str, tuple[str, Callable[[Path], Any]]] = {
    "raw": ("RAW files", _RawFrames),
    "picture": ("pictures", partial(PictureFolder, allowed_share=1)),
}
"""The name of the files of each kind of content, and their reader."""


def _parts(openers: Iterable[tuple[str, Callable[[], Any]]], first: int | None) -> list[PartReport]:
    parts = []
    for what, open_part in openers:
        parts.append(_part(what, open_part, first))
    return parts


def _part(what: str, open_part: Callable[[], Any], first: int | None) -> PartReport:
    """Read the items one by one; failures become lines of the report."""
    part = PartReport(what)
    try:
        items = open_part()
    except (OSError, ValueError) as error:
        part.broken.append(" ".join(str(error).split()))
        return part

    part.items = len(items)
    part.examined = part.items if first is None else min(first, part.items)
    opening = pickle.dumps(open_part)
    names = getattr(items, "names", range(part.items))

    for index in range(part.examined):
        try:
            facts = isolated(_facts, opening, index, name=names[index])
        except (OSError, ValueError) as error:
            part.add_broken(error)
            continue
        for kind, value in facts.items():
            part.counts[kind][value] += 1
    return part


@lru_cache(maxsize=1)
def _opened(opening: bytes) -> Any:
    return pickle.loads(opening)()


def _facts(opening: bytes, index: int) -> dict[str, str]:
    """Describe size, pattern, levels, camera and ISO of an item: a picture, pair, RAW frame or noisy block."""
    items = _opened(opening)
    item = getattr(items, "read", items.__getitem__)(index)
    return _describe_item(item)


@singledispatch
def _describe_item(picture: Any) -> dict[str, str]:
    """Describe an item by kinds of fact; for a picture this is its size."""
    return {"sizes": _size(picture)}


@_describe_item.register
def _(pair: PicturePair) -> dict[str, str]:
    return {"sizes": _size(pair.noisy)}


@_describe_item.register
def _(pair: Pair) -> dict[str, str]:
    facts = {"sizes": _size(pair.clean.mosaic), "cfas": str(pair.cfa)}
    if pair.noisy is not None and pair.noisy.noise_profile is not None:
        facts["levels"] = _variances(*pair.noisy.noise_profile)
    return facts | _origin(pair.clean)


@_describe_item.register
def _(frame: RawFrame) -> dict[str, str]:
    facts = {"sizes": _size(frame.mosaic), "cfas": str(frame.cfa)}
    if frame.white > 1:
        black = "/".join(f"{level:g}" for level in dict.fromkeys(frame.black))
        facts["levels"] = f"black {black}, white {frame.white:g}"
    elif frame.noise_profile is not None:
        facts["levels"] = _variances(*frame.noise_profile)

    if frame.remarks:
        facts["tags that are not used"] = "; ".join(frame.remarks)
    return facts | _origin(frame)


def _variances(shot_var: float, read_var: float) -> str:
    return f"shot_var {shot_var:.1e}, read_var {read_var:.1e}"


def _origin(frame: RawFrame) -> dict[str, str]:
    """The camera and the ISO, if they are known."""
    facts = {}
    if frame.camera != "unknown":
        facts["cameras"] = frame.camera
    if frame.iso:
        facts["iso"] = f"{frame.iso:g}"
    return facts


def _size(image: Tensor) -> str:
    return f"{image.shape[-2]} x {image.shape[-1]}"
