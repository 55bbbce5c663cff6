"""Sequences of frames that are read on access, and the views of them.

A frame is identified by the resolved paths of its files, or by its name if it has no files. So a recipe can check,
without reading any frames, that it does not score those that it trains on. Datasets that describe their frames have
``labels``.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, Generic, NamedTuple, TypeVar, overload

from torch import Tensor
from torch.utils.data import Dataset

from rawaug.data.pairs import Pair
from rawaug.errors import count_of, escape
from rawaug.files import digest
from rawaug.io import RawFrame
from rawaug.io.pictures import MAX_PIXELS

T = TypeVar("T")
S = TypeVar("S")


class FrameLabel(NamedTuple):
    """The scene that a frame shows, the phone that took it, and its ISO."""

    scene: str
    phone: str
    iso: int


class Frames(Sequence[T], Generic[T]):
    """Named pairs, or frames, that are read on access; :meth:`some`, :meth:`map`, :meth:`kept`, ... are views of them.

    The last one that was read stays in memory.

    Args:
        names: the name of each, which identifies it unless :meth:`frame_files` does.

    Example:
        >>> from rawaug.data import demo_pairs
        >>> as_frames(demo_pairs("test", count=2)).some([1]).binned(4)[0].clean.mosaic.shape
        torch.Size([1, 72, 112])
    """

    max_pixels: int = MAX_PIXELS
    """Maximum number of pixels of sRGB pictures and of mosaics in PNG files."""
    labels: Sequence[FrameLabel] = ()
    """The labels of the frames, if the dataset knows them without reading a frame."""
    rendering: str = "sRGB of the pairs"
    """What has rendered the sRGB of registered pairs."""

    def __init__(self, names: Sequence[str]) -> None:
        self.names = list(names)
        self._last: tuple[int, T] | None = None

    def read(self, index: int) -> T:
        """Read the one at ``index`` in [0, len)."""
        raise NotImplementedError(f"{type(self).__name__}: its subclass reads the frames")

    def __len__(self) -> int:
        return len(self.names)

    @overload
    def __getitem__(self, index: int) -> T: ...

    @overload
    def __getitem__(self, index: slice) -> list[T]: ...

    def __getitem__(self, index: int | slice) -> T | list[T]:
        if isinstance(index, slice):
            return [self[i] for i in range(len(self))[index]]

        index = range(len(self))[index]
        if self._last is None or self._last[0] != index:
            self._last = index, self.read(index)
        return self._last[1]

    def frame(self: Frames[Pair], index: int) -> RawFrame:
        """Read the captured mosaic of a pair, the noisy one if there is one, without its picture."""
        pair = self[index]
        return pair.noisy or pair.clean

    def frame_files(self, index: int) -> Sequence[Path]:
        """The files that identify a pair; empty if its name identifies it."""
        return ()

    def stamp(self, index: int) -> str:
        """Identify the content of a pair by the path, size and modification time of its files, or by its name."""
        parts = []
        for file in self.frame_files(index):
            status = file.stat()
            parts.append(f"{os.path.realpath(file)} {status.st_size} {status.st_mtime_ns}")
        if not parts:
            return self.names[index]
        return " ".join(parts)

    def stamps(self) -> list[str]:
        """The stamps of all frames; no file is read."""
        return [self.stamp(index) for index in range(len(self))]

    def some(self, indices: Iterable[int]) -> Frames[T]:
        """The frames at these indices."""
        return _View(self, indices)

    def map(self, change: Callable[[T], S], step: str = "", only: Iterable[int] | None = None) -> Frames[S]:
        """All frames, each changed as it is read, or what is made of each, such as its picture.

        Args:
            change: a function of one of them.
            step: what it does to the pixels, which becomes a part of the stamps.
            only: the indices of the frames that are changed; all by default.
        """
        return _View(self, range(len(self)), change, step, only)

    def middles(self: Frames[Pair], crop: int) -> Frames[Pair]:
        """The middle ``crop x crop`` of each frame."""
        return self.map(lambda pair: pair.middle(crop))

    def binned(self: Frames[Pair], factor: int, together: bool = False) -> Frames[Pair]:
        """All frames, binned by :meth:`Pair.binned`: references with less noise of their own; ValueError below 1."""
        if factor < 1:
            raise ValueError(f"bin must be at least 1, got {factor}")
        step = f"binned by {factor}"
        if together:
            step += ", around one centre"
        return self.map(lambda pair: pair.binned(factor, together), step)

    def kept(self, megabytes: int = 1024) -> Frames[T]:
        """All frames, each read once; up to ``megabytes`` of them stay in memory."""
        pairs: Cached[T] = Cached(self, megabytes)
        return _View(self, range(len(self)), read=pairs.__getitem__)


class _View(Frames[Any]):
    """Some of the frames of a sequence, perhaps changed."""

    def __init__(
        self,
        frames: Frames[Any],
        indices: Iterable[int],
        change: Callable[[Any], Any] | None = None,
        step: str = "",
        only: Iterable[int] | None = None,
        read: Callable[[int], Any] | None = None,
    ) -> None:
        self.frames = frames
        self.indices = list(indices)
        self.change, self.step = change, step
        self.only = None if only is None else set(only)
        self.read_frame = read or frames.__getitem__

        super().__init__([frames.names[index] for index in self.indices])
        if frames.labels:
            self.labels = [frames.labels[index] for index in self.indices]

    def read(self, index: int) -> Any:
        frame = self.read_frame(self.indices[index])
        if self.change is None or (self.only is not None and index not in self.only):
            return frame
        return self.change(frame)

    def frame_files(self, index: int) -> Sequence[Path]:
        return self.frames.frame_files(self.indices[index])

    def stamp(self, index: int) -> str:
        stamp = self.frames.stamp(self.indices[index])
        return f"{stamp} {self.step}" if self.step else stamp


_STAMP_STEP = 4099
"""Step between the values of an image that identify it; a prime, so that no row or column is favoured."""


class _InMemory(Frames[Pair]):
    def __init__(self, pairs: Sequence[Pair]) -> None:
        self.pairs = pairs
        super().__init__([pair.name for pair in pairs])

    def read(self, index: int) -> Pair:
        return self.pairs[index]

    def stamp(self, index: int) -> str:
        pair = self.pairs[index]
        clean = pair.clean
        parts = [repr((pair.name, clean.camera, pair.cfa, clean.white_balance, clean.mosaic.shape)).encode()]
        images = [pair.srgb, clean.mosaic]
        if pair.noisy is not None:
            images.append(pair.noisy.mosaic)
        for image in images:
            sites = image.flatten()[::_STAMP_STEP]
            parts.append(sites.numpy().tobytes())
        return digest(*parts)[:16]


def as_frames(pairs: Sequence[Pair]) -> Frames[Pair]:
    """Return the pairs as a sequence with names and files, which are available without reading a pair."""
    if isinstance(pairs, Frames):
        return pairs
    return _InMemory(pairs)


def shared_frame(first: Sequence[Pair], second: Sequence[Pair]) -> str | None:
    """Find a frame that both hold, by its path or name; None if they share none."""
    return min(_identities(as_frames(first)) & _identities(as_frames(second)), default=None)


def _identities(pairs: Frames[Pair]) -> set[str]:
    identities: set[str] = set()
    for index, name in enumerate(pairs.names):
        files = pairs.frame_files(index)
        identities.update(map(os.path.realpath, files))
        if not files:
            identities.add(name)
    return identities


class Cached(Dataset[T]):
    """A cache for a dataset; each worker has its own.

    Args:
        pictures: the dataset.
        megabytes: the size of the cache; items that do not fit are read and made anew on every access.
        make: a function from a picture to an item; by default items are the pictures.
    """

    def __init__(self, pictures: Sequence[T] | Any, megabytes: int, make: Callable[[Any], T] | None = None) -> None:
        self.pictures = pictures
        self.make = make
        self._free_bytes = megabytes * 2**20
        self._cache: dict[int, T] = {}

    def __len__(self) -> int:
        return len(self.pictures)

    def __getitem__(self, index: int) -> T:
        if index in self._cache:
            return self._cache[index]

        picture = self.pictures[index]
        item: T = picture if self.make is None else self.make(picture)
        size = _count_bytes(item)
        if size <= self._free_bytes:
            self._free_bytes -= size
            self._cache[index] = item
        return item


def _count_bytes(item: Any) -> int:
    """The memory of a tensor, or of the tensors among the attributes of an object and of the frames that it holds."""
    if isinstance(item, Tensor):
        return item.nbytes

    size = 0
    for value in vars(item).values():
        if isinstance(value, (Tensor, RawFrame)):
            size += _count_bytes(value)
    return size


class Readable(Sequence[Pair]):
    """Pairs that skip unreadable ones and record the reasons; ValueError on iteration if all are unreadable."""

    def __init__(self, pairs: Sequence[Pair]) -> None:
        self.pairs = pairs
        self.broken: dict[int, str] = {}

    def __len__(self) -> int:
        return len(self.pairs)

    def __getitem__(self, index: Any) -> Any:
        return self.pairs[index]

    def __iter__(self) -> Iterator[Pair]:
        for index in range(len(self.pairs)):
            pair = self.attempt(index, self.pairs.__getitem__)
            if pair is not None:
                yield pair

        if self.broken and len(self.broken) == len(self.pairs):
            raise ValueError(f"none of the {count_of(len(self.pairs), 'frame')} can be read; {self.reasons()[0]}")

    def attempt(self, index: int, read: Callable[[int], T]) -> T | None:
        """Return ``read(index)``, or None if this pair cannot be read."""
        if index in self.broken:
            return None
        try:
            return read(index)
        except (OSError, ValueError) as error:
            self.broken[index] = " ".join(str(error).split())
            return None

    def reasons(self) -> list[str]:
        """Why pairs cannot be read, in the order of the pairs."""
        return [self.broken[index] for index in sorted(self.broken)]

    def readable(self) -> Sequence[Pair]:
        """The pairs without those that were unreadable so far; the original sequence if there are none."""
        if not self.broken:
            return self.pairs

        readable = [index for index in range(len(self.pairs)) if index not in self.broken]
        return as_frames(self.pairs).some(readable)


def left_out(pairs: Readable, of: str) -> list[str]:
    """Make lines to print about skipped pairs: their number, then each reason; empty if none was skipped."""
    reasons = pairs.reasons()
    if not reasons:
        return []

    frames = count_of(len(pairs), "frame")
    return [f"left out of {escape(of)}: {len(reasons)} of {frames}, unreadable", *map(escape, reasons)]


def skip_broken(pairs: Sequence[Pair], of: str) -> Iterator[Pair]:
    """Iterate over the readable pairs; afterwards, print the skipped ones."""
    readable = pairs if isinstance(pairs, Readable) else Readable(pairs)
    yield from readable

    lines = left_out(readable, of)
    if lines:
        print("\n".join(lines))


OWN_PICTURES = "pairs"
"""The value of ``data.pictures`` for augmenting the pictures of a recipe's own pairs."""
