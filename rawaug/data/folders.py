"""Folders of sRGB pictures and of RAW files, and the treatment of unreadable files in them.

A picture folder lists its files without opening them, and checks a file when it is read. The next usable file, in the
order of the paths, replaces an unusable one, so that a sample does not depend on the order of access or the number of
workers. All workers mark damaged files in shared memory, so that the main process can report them and no worker opens
one twice. Unreadable pairs are skipped and reported.
"""

from __future__ import annotations

import logging
import os
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import ConcatDataset, Dataset

from rawaug.bayer import turn_back
from rawaug.data.frames import Frames
from rawaug.data.pairs import Pair, centre
from rawaug.errors import count_of, escape
from rawaug.files import files_in
from rawaug.io import RawFrame, read_picture, read_raw, read_raw_and_develop
from rawaug.io.content import PICTURE_EXTENSIONS as PICTURE_EXTENSIONS
from rawaug.io.content import list_pictures
from rawaug.io.pictures import MAX_PIXELS, read_crop, recode_jpeg
from rawaug.io.raw import RAW_EXTENSIONS

_JPEG_SUFFIXES = (".jpg", ".JPG", ".jpeg", ".JPEG")
_JPEG_MARGIN = 0.03
"""Maximum share by which the sides of a JPEG and of LibRaw's RAW may exceed the common size."""
_MAX_NAMES = 20
"""Maximum number of files that an error names."""
_log = logging.getLogger(__name__)
T = TypeVar("T")


class PictureFolder(Dataset[Tensor]):
    """The pictures of a folder and its subfolders, sorted by path: uint8 ``(3, H, W)`` of any size.

    A file that cannot be used is logged with the reason when it is met, and the next one stands in for it, as
    :meth:`file` says; :attr:`skipped` and :meth:`report` list those met so far, by whichever worker. Files of other
    kinds (RAW, HEIC where its decoder is not installed, text) are counted in :attr:`left_out`. ``rawaug data check``
    finds the files that crash a decoder, and a worker with it.

    Args:
        path: a folder, or one picture. Files are chosen by their extension; links to folders are not followed.
        min_side: smaller pictures are skipped; use the side of your crops. A mosaic has sides of at least 2.
        max_pixels: larger pictures are skipped.
        allowed_share: share of the files that may be skipped; above it, reading raises an error that names them.

    Raises:
        FileNotFoundError: if there is no such folder.
        ValueError: if it holds no file with such an extension, or, on access, if too many of them had to be skipped.
    """

    def __init__(
        self, path: str | Path, min_side: int = 2, max_pixels: int = MAX_PIXELS, allowed_share: float = 0.05
    ) -> None:
        self.path = Path(path)
        self.min_side = min_side
        self.max_pixels = max_pixels
        self.allowed_share = allowed_share

        listing = list_pictures(self.path)
        self.left_out = listing.lines()
        if self.path.is_file():
            self.path = self.path.parent

        # an array, since forked workers would copy a list page by page as its reference counts change
        self._names = np.array([os.fsencode(file.relative_to(self.path)) for file in listing.files])
        self._bad = torch.zeros(len(self), dtype=torch.uint8).share_memory_()
        self._reasons: dict[int, str] = {}

    def __len__(self) -> int:
        return len(self._names)

    def __getitem__(self, index: int) -> Tensor:
        return self._give(index, self.read)

    def read_part(self, index: int, choose: Callable[[int, int], tuple[int, int, int, int]]) -> Tensor:
        """Read a part of a picture, by :func:`rawaug.io.pictures.read_crop`: a JPEG no further than its last row.

        Args:
            index: of the picture.
            choose: a function from the height and width of the picture to the top, left, rows and columns of the part.
                It is asked again if another file stands in for a damaged one.
        """

        def read(candidate: int) -> Tensor:
            def choose_if_large(height: int, width: int) -> tuple[int, int, int, int]:
                self._require_size(candidate, height, width)
                return choose(height, width)

            return read_crop(self._path(candidate), choose_if_large, self.max_pixels)

        return self._give(index, read)

    def _give(self, index: int, read: Callable[[int], Tensor]) -> Tensor:
        """Read a file, or the next one that can be used."""
        first = range(len(self))[index]
        if self._bad[first]:
            self._require_few_bad(last=first)

        for candidate in self._from(first):
            if self._bad[candidate]:
                continue
            picture = self._attempt(candidate, read)
            if picture is not None:
                return picture
        raise AssertionError("the share of skipped files is checked before the last one is")

    def _from(self, first: int) -> Iterator[int]:
        """The indices in the order in which files stand in for file ``first``."""
        return chain(range(first, len(self)), range(first))

    @property
    def names(self) -> list[str]:
        """The paths of all files."""
        return [str(self._path(index)) for index in range(len(self))]

    def file(self, index: int) -> Path:
        """The path of the file whose picture an index gives: the next one if its own was found to be damaged."""
        for candidate in self._from(range(len(self))[index]):
            if not self._bad[candidate]:
                return self._path(candidate)
        return self._path(index)

    def _path(self, index: int) -> Path:
        return self.path / os.fsdecode(self._names[index])

    def read(self, index: int) -> Tensor:
        """Read the picture of one file, not replaced by another; OSError or ValueError if it cannot be used."""
        picture = read_picture(self._path(index), self.max_pixels)
        self._require_size(index, *picture.shape[1:])
        return picture

    def _require_size(self, index: int, height: int, width: int) -> None:
        if min(height, width) < self.min_side:
            raise ValueError(f"{self._path(index)}: is {height} x {width}, smaller than min_side {self.min_side}")

    @property
    def skipped(self) -> dict[Path, str]:
        """The files that could not be used, with the reason, as far as any worker has met them."""
        reasons: dict[Path, str] = {}
        for index in self._bad_indices():
            reasons[self._path(index)] = self._reason(index)
        return reasons

    def _bad_indices(self) -> list[int]:
        indices: list[int] = self._bad.nonzero()[:, 0].tolist()
        return indices

    def _reason(self, index: int) -> str:
        """Why a file cannot be used; it is read again if a worker has met it."""
        if index not in self._reasons:
            self._reasons[index] = f"{self._path(index)}: was damaged, but is readable now"
            try:
                self.read(index)
            except (OSError, ValueError) as error:
                self._reasons[index] = str(error)
        return self._reasons[index]

    def report(self) -> str:
        """Describe the files that were skipped so far, with the reasons, and the kinds of files not used."""
        skipped = self.skipped
        pictures = count_of(len(self), "picture")
        head = f"{escape(self.path)}: none of {pictures} skipped so far"
        if skipped:
            head = f"{escape(self.path)}: {len(skipped)} of {pictures} skipped"
        return "\n".join([head, *map(escape, skipped.values()), *self.left_out])

    def _attempt(self, index: int, read: Callable[[int], Tensor]) -> Tensor | None:
        """Read a picture; return None if the file is damaged, and mark it."""
        try:
            return read(index)
        except (OSError, ValueError) as error:
            self._reasons[index] = str(error)
            _log.warning("skipped: %s", escape(error))

        self._bad[index] = 1
        self._require_few_bad(last=index)
        return None

    def _require_few_bad(self, last: int) -> None:
        """Raise ValueError if more than the allowed share of the files had to be skipped."""
        bad = self._bad_indices()
        if len(bad) <= self.allowed_share * len(self):
            return

        names = [str(self._path(index)) for index in bad[:_MAX_NAMES]]
        if len(bad) > _MAX_NAMES:
            names.append("...")
        pictures = count_of(len(self), "picture")
        count = f"{len(bad)} of {pictures} unusable, more than allowed_share {self.allowed_share:.0%}"
        raise ValueError(f"{self.path}: {count}: {', '.join(names)}; last: {self._reason(last)}")


def reports(pictures: Any) -> list[str]:
    """Get the report of each folder in ``pictures`` that leaves files out, including cached and concatenated ones."""
    if isinstance(pictures, PictureFolder):
        if pictures.skipped or pictures.left_out:
            return [pictures.report()]
        return []

    parts = [getattr(pictures, "pictures", None)]
    if isinstance(pictures, ConcatDataset):
        parts = list(pictures.datasets)

    lines: list[str] = []
    for part in parts:
        if part is not None:
            lines += reports(part)
    return lines


class RawFolder(Frames[Pair]):
    """The RAW files of a folder and its subfolders, sorted by path; or one file; or a list of both.

    A pair's sRGB is the JPEG of the same stem beside the RAW file, if there is one whose size is the mosaic's within
    3%. The JPEG is turned into the sensor's orientation, both are cut to the smaller size about the centre, and the
    pair is not ``registered``. Otherwise it is LibRaw's rendering (see :func:`rawaug.io.read_raw_and_develop`), with a
    warning if there is a JPEG of another size. A pair's name is the file's stem, or the path if two stems are equal.

    Args:
        path: path of the RAW files.
        camera_jpeg: False always uses LibRaw's rendering.
        adjust_maximum_thr: LibRaw's scaling by the frame's own maximum, off by default.
        jpeg_quality: pass LibRaw's rendering through a JPEG of this quality; None leaves it as it is.
        max_pixels: the limit of a JPEG; a larger one is an error of its pair.
    """

    rendering = "LibRaw"

    def __init__(
        self,
        path: str | Path | Iterable[str | Path],
        *,
        camera_jpeg: bool = True,
        adjust_maximum_thr: float = 0.0,
        jpeg_quality: int | None = None,
        max_pixels: int = MAX_PIXELS,
    ) -> None:
        if isinstance(path, (str, Path)):
            path = [path]
        self.files: list[Path] = []
        for folder in path:
            self.files += files_in(folder, "RAW", RAW_EXTENSIONS)

        self.camera_jpeg = camera_jpeg
        self.adjust_maximum_thr = adjust_maximum_thr
        self.jpeg_quality = jpeg_quality
        self.max_pixels = max_pixels
        super().__init__(_names(self.files))

    def frame(self, index: int) -> RawFrame:
        return read_raw(self.files[index])

    def frame_files(self, index: int) -> Sequence[Path]:
        return (self.files[index],)

    def read(self, index: int) -> Pair:
        file = self.files[index]
        jpeg = None
        if self.camera_jpeg:
            jpeg = _jpeg_beside(file)
        if jpeg is not None:
            pair = self._pair_with_jpeg(self.names[index], file, jpeg)
            if pair is not None:
                return pair

        frame, srgb = read_raw_and_develop(file, self.adjust_maximum_thr)
        if self.jpeg_quality is not None:
            srgb = recode_jpeg(srgb, self.jpeg_quality)
        return Pair.of_frame(self.names[index], frame, srgb)

    def _pair_with_jpeg(self, name: str, file: Path, jpeg: Path) -> Pair | None:
        """Make the pair of a RAW file and its JPEG, cut to the smaller size; None, with a warning, if sizes differ."""
        frame = read_raw(file)
        srgb = turn_back(read_picture(jpeg, self.max_pixels), frame.upright_view)

        size = []
        fits = True
        for jpeg_side, raw_side in zip(srgb.shape[-2:], frame.mosaic.shape[-2:], strict=True):
            side = min(jpeg_side, raw_side) // 2 * 2
            size.append(side)
            for own_side in (jpeg_side, raw_side):
                fits = fits and own_side - side <= _JPEG_MARGIN * own_side
        if not fits:
            sides = (*srgb.shape[-2:], *frame.mosaic.shape[-2:])
            sizes = "is {} x {} but its RAW file is {} x {}".format(*sides)
            warnings.warn(f"{jpeg}: {sizes}; using LibRaw's rendering instead", stacklevel=3)
            return None

        frame = replace(frame, mosaic=centre(frame.mosaic, *size))
        return Pair.of_frame(name, frame, centre(srgb, *size), registered=False)


def _names(files: Sequence[Path]) -> list[str]:
    """Name files by their stems, or by their paths below the common folder if two stems are equal."""
    names = [file.stem for file in files]
    if len(set(names)) == len(names):
        return names

    paths = [file.absolute() for file in files]
    common_folder = os.path.commonpath([path.parent for path in paths])
    return [path.relative_to(common_folder).as_posix() for path in paths]


def _jpeg_beside(file: Path) -> Path | None:
    for suffix in _JPEG_SUFFIXES:
        jpeg = file.with_suffix(suffix)
        if jpeg.is_file():
            return jpeg
    return None
