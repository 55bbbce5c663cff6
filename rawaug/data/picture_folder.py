"""A folder of sRGB pictures as a map-style dataset, for real folders: large, with some damaged files.

Nothing is opened to find out what is there: the folder is listed, and a file is judged when its turn comes. One that
cannot be used is replaced by the next that can, in the order of the paths: the sample is the same whoever asks, in
whatever order, with any number of workers. Damaged files are marked in memory shared by all workers, so that
the main process can report them and no worker opens one twice.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Iterator, Sequence
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import ConcatDataset, Dataset, get_worker_info

from rawaug.io.apart import apart, apart_each, prepare
from rawaug.io.picture_files import MAX_PIXELS, decode_picture
from rawaug.printable import printable

EXTENSIONS = (".bmp", ".exr", ".gif", ".jpeg", ".jpg", ".jxl", ".png", ".ppm", ".tif", ".tiff", ".webp")
_COUNTERS = 64
_NAMED = 20
_log = logging.getLogger(__name__)


class PictureFolder(Dataset[Tensor]):
    """The pictures of a folder and its subfolders, sorted by path: uint8 ``(3, H, W)`` of any size.

    Files are decoded apart (:mod:`rawaug.io.apart`): one that crashes its decoder, or hangs, is skipped like any other
    damaged one. After every ``len(self)`` pictures read (an epoch), by however many workers, the files skipped so far
    are logged as a warning; :attr:`skipped` and :meth:`report` list them at any time.

    Args:
        path: a folder; files with the extensions of :data:`EXTENSIONS` are taken, links to folders not followed.
        min_side: smaller pictures are skipped; use the side of your crops. A mosaic has sides of at least 2.
        max_pixels: larger pictures are skipped.
        allowed_share: part of the files that may be skipped; above it, reading raises an error that names them.

    Raises:
        FileNotFoundError: if there is no such folder.
        ValueError: if it holds no file with such an extension, or, on access, if too many of them had to be skipped.

    Example:
        >>> pictures = PictureFolder("photographs", min_side=256)  # doctest: +SKIP
        >>> pictures[0].shape  # doctest: +SKIP
        torch.Size([3, 375, 500])
        >>> print(pictures.report())  # doctest: +SKIP
        photographs: none of 25000 pictures skipped so far
    """

    def __init__(
        self, path: str | Path, min_side: int = 2, max_pixels: int = MAX_PIXELS, allowed_share: float = 0.05
    ) -> None:
        self.path = Path(path)
        if not self.path.is_dir():
            raise FileNotFoundError(f"{path}: no such folder of pictures")
        self.min_side, self.max_pixels, self.allowed_share = min_side, max_pixels, allowed_share
        self.names = _Names(sorted(_listed(self.path)))
        if not len(self.names):
            raise ValueError(f"{path}: contains no picture; supported extensions are {', '.join(EXTENSIONS)}")
        self._bad = torch.zeros(len(self.names), dtype=torch.uint8).share_memory_()
        self._read = torch.zeros(_COUNTERS, dtype=torch.int64).share_memory_()  # a slot a worker: one writer each
        self._epochs_logged = torch.zeros(1, dtype=torch.int64).share_memory_()
        self._reasons: dict[int, str] = {}
        prepare()

    def __len__(self) -> int:
        return len(self.names)

    def __getitem__(self, index: int) -> Tensor:
        return self._picture(range(len(self))[index])

    def __getitems__(self, indices: Sequence[int]) -> list[Tensor]:
        """Those of a batch, as a DataLoader asks for them."""
        return list(self.read_ahead(indices))

    def read_ahead(self, indices: Sequence[int]) -> Iterator[Tensor]:
        """The pictures in this order, the next ones decoded while the caller works on one."""
        wanted = [range(len(self))[index] for index in indices]
        usable = [not self._bad[index] for index in wanted]
        files = [self.path / self.names[index] for index, use in zip(wanted, usable, strict=True) if use]
        found = apart_each(decode_picture, files, self.max_pixels)
        for index, use in zip(wanted, usable, strict=True):
            yield self._picture(index, next(found) if use else None)

    def _picture(self, first: int, known: Tensor | Exception | None = None) -> Tensor:
        """The picture of a file, or of the next that can be used; ``known`` is what came of reading the first."""
        for candidate in chain(range(first, len(self)), range(first)):
            if self._bad[candidate]:
                continue
            picture = self._judged(candidate, known if candidate == first else None)
            if picture is not None:
                self._count()
                return picture
        raise AssertionError("the share of skipped files is checked before the last one is")

    def read(self, index: int) -> Tensor:
        """The picture of one file, not replaced by another.

        Raises:
            FileNotFoundError, OSError, ValueError: if it cannot be used.
        """
        return self._required(index, apart(decode_picture, self.path / self.names[index], self.max_pixels))

    def _required(self, index: int, picture: Tensor) -> Tensor:
        file = self.path / self.names[index]
        if min(picture.shape[1:]) < self.min_side:
            size = f"{picture.shape[1]} x {picture.shape[2]}"
            raise ValueError(f"{file}: is {size}, smaller than min_side {self.min_side}")
        return picture.contiguous()

    @property
    def skipped(self) -> dict[Path, str]:
        """The files that could not be used, with the reason, as far as any worker has met them."""
        bad = self._bad.nonzero()[:, 0].tolist()
        for index in bad:
            if index not in self._reasons:  # met by a worker: ask the file again
                self._reasons[index] = (
                    self._fault(index) or f"{self.path / self.names[index]}: was damaged, but is readable now"
                )
        return {self.path / self.names[index]: self._reasons[index] for index in bad}

    def report(self) -> str:
        """What was skipped so far, one line a file."""
        skipped = self.skipped
        folder = printable(self.path)
        if not skipped:
            return f"{folder}: none of {len(self)} pictures skipped so far"
        lines = map(printable, skipped.values())
        return "\n".join([f"{folder}: {len(skipped)} of {len(self)} pictures skipped", *lines])

    def _judged(self, index: int, known: Tensor | Exception | None) -> Tensor | None:
        """The picture, or None and a mark where it is damaged; ``known`` is what came of reading it, None if unread."""
        try:
            if isinstance(known, Exception):
                raise known
            return self.read(index) if known is None else self._required(index, known)
        except (OSError, ValueError) as error:
            self._reasons[index] = str(error)
        self._bad[index] = 1
        count = int(self._bad.sum())
        if count > self.allowed_share * len(self):
            names = [f"{self.path / self.names[i]}" for i in self._bad.nonzero()[:_NAMED, 0].tolist()]
            more = f" and {count - _NAMED} more" if count > _NAMED else ""
            raise ValueError(
                f"{self.path}: {count} of {len(self)} pictures are unusable, more than allowed_share "
                f"{self.allowed_share:.0%}: {', '.join(names)}{more}; last: {self._reasons[index]}"
            )
        return None

    def _fault(self, index: int) -> str | None:
        try:
            self.read(index)
        except (OSError, ValueError) as error:
            return str(error)
        return None

    def _count(self) -> None:
        """Count a reading; the worker that completes an epoch logs what was skipped (two may, in a race)."""
        worker = get_worker_info()
        self._read[(0 if worker is None else 1 + worker.id) % _COUNTERS] += 1
        epoch = int(self._read.sum()) // len(self)
        if epoch > self._epochs_logged[0]:
            self._epochs_logged[0] = epoch
            if self._bad.any():
                _log.warning("%s", self.report())


def reports(pictures: Any) -> list[str]:
    """What each folder in ``pictures`` skipped so far, a text a folder; those behind a cache or in a list too."""
    if isinstance(pictures, PictureFolder):
        return [pictures.report()] if pictures.skipped else []
    inside = pictures.datasets if isinstance(pictures, ConcatDataset) else [getattr(pictures, "pictures", None)]
    return [report for each in inside if each is not None for report in reports(each)]


class _Names(Sequence[str]):
    """Many strings in two arrays: a list's reference counts would be copied into every forked worker, page by page."""

    def __init__(self, names: Sequence[str]) -> None:
        encoded = [os.fsencode(name) for name in names]
        self._ends = np.cumsum([len(name) for name in encoded], dtype=np.int64)
        self._bytes = np.frombuffer(b"".join(encoded), np.uint8)

    def __len__(self) -> int:
        return len(self._ends)

    def __getitem__(self, index: int) -> str:  # type: ignore[override]
        index = range(len(self))[index]
        start = self._ends[index - 1] if index else 0
        return os.fsdecode(self._bytes[start : self._ends[index]].tobytes())


def _listed(folder: Path) -> Iterator[str]:
    """Paths below ``folder`` that have a picture's extension, unordered; folders with such a name are skipped."""

    def refuse(error: OSError) -> None:
        raise error

    for parent, _, files in os.walk(folder, onerror=refuse):
        inside = Path(parent).relative_to(folder)
        for file in files:
            if file.lower().endswith(EXTENSIONS):
                yield str(inside / file)
