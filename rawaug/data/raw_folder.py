"""RAW files as pairs: the mosaic, and LibRaw's rendering or the camera's own JPEG of the same shot."""

from __future__ import annotations

import os
import warnings
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path

from torch import Tensor

from rawaug.bayer import turn_back
from rawaug.data.lazy import LazyPairs
from rawaug.data.pair import Pair
from rawaug.io import RawFrame, read_picture, read_raw, read_raw_and_develop
from rawaug.io.apart import apart
from rawaug.io.jpeg import through_jpeg
from rawaug.io.picture_files import MAX_PIXELS

EXTENSIONS = (
    *(".3fr", ".arw", ".cr2", ".cr3", ".crw", ".dcr", ".dng", ".erf", ".fff", ".iiq", ".kdc", ".mef", ".mos", ".mrw"),
    *(".nef", ".nrw", ".orf", ".pef", ".raf", ".raw", ".rw2", ".rwl", ".sr2", ".srf", ".srw"),
)
_MARGIN = 0.03
"""Cameras cut a few lines off their JPEGs that LibRaw keeps, or the other way round."""
_JPEG_SUFFIXES = (".jpg", ".JPG", ".jpeg", ".JPEG")


class RawFolder(LazyPairs):
    """The RAW files of a folder and its subfolders, sorted by path; or one file; or a list of files.

    A pair's sRGB is the JPEG of the same stem beside the RAW file where there is one of the mosaic's size within 3% (it
    is turned into the sensor's orientation, both are cut to the smaller size about the centre, and the pair is not
    ``registered``), else LibRaw's rendering (see :func:`rawaug.io.read_raw_and_develop`, also on forked workers), with
    a warning if there is a JPEG of another size. Its name is the file's stem; where two would have the same, the path.
    Files are read when asked for; the last one stays.

    Args:
        path: where the RAW files are.
        camera_jpeg: False always uses LibRaw's rendering.
        adjust_maximum_thr: LibRaw's scaling by the frame's own maximum, off by default.
        jpeg_quality: LibRaw's rendering as a JPEG of this quality gives it back; None leaves it as it is.
        max_pixels: of a JPEG; a larger one is an error of its pair.

    Raises:
        FileNotFoundError: if a file or the folder does not exist.
        ValueError: if the folder holds no RAW file.

    Example:
        >>> pair = RawFolder("shots")[0]  # doctest: +SKIP
        >>> pair.raw.shape, pair.srgb.shape  # doctest: +SKIP
        (torch.Size([1, 3000, 4000]), torch.Size([3, 3000, 4000]))
    """

    def __init__(
        self,
        path: str | Path | Iterable[str | Path],
        *,
        camera_jpeg: bool = True,
        adjust_maximum_thr: float = 0.0,
        jpeg_quality: int | None = None,
        max_pixels: int = MAX_PIXELS,
    ) -> None:
        self.files = _raw_files(path) if isinstance(path, (str, Path)) else [Path(file) for file in path]
        missing = [file for file in self.files if not file.is_file()]
        if missing:
            raise FileNotFoundError(f"{missing[0]}: no such RAW file")
        if not self.files:
            raise ValueError(
                f"{path}: contains no RAW file; supported extensions are {', '.join(EXTENSIONS)}; "
                "noisy/clean pairs of other formats are read as pairs:PATH"
            )
        self.camera_jpeg = camera_jpeg
        self.adjust_maximum_thr, self.jpeg_quality, self.max_pixels = adjust_maximum_thr, jpeg_quality, max_pixels
        super().__init__(_names(self.files))

    def files_of(self, index: int) -> Sequence[Path]:
        return (self.files[index],)

    def read(self, index: int) -> Pair:
        """The frame of ``files[index]``, developed, or with its camera's JPEG."""
        file = self.files[index]
        jpeg = _jpeg_beside(file) if self.camera_jpeg else None
        if jpeg is not None:
            frame = apart(read_raw, file)
            srgb = turn_back(apart(read_picture, jpeg, self.max_pixels), frame.upright_view)
            size = [min(a, b) // 2 * 2 for a, b in zip(srgb.shape[-2:], frame.mosaic.shape[-2:], strict=True)]
            sides = (*srgb.shape[-2:], *frame.mosaic.shape[-2:])
            if all(side - least <= _MARGIN * side for side, least in zip(sides, size * 2, strict=True)):
                frame = replace(frame, mosaic=_centre(frame.mosaic, *size))
                return _pair(self.names[index], frame, _centre(srgb, *size), registered=False)
            sizes = "is {} x {} but its RAW file is {} x {}".format(*sides)
            warnings.warn(f"{jpeg}: {sizes}; using LibRaw's rendering instead", stacklevel=2)
        frame, srgb = apart(read_raw_and_develop, file, self.adjust_maximum_thr)
        srgb = srgb if self.jpeg_quality is None else through_jpeg(srgb, self.jpeg_quality)
        return _pair(self.names[index], frame, srgb, registered=True)


def _centre(image: Tensor, height: int, width: int) -> Tensor:
    """The middle of ``(C, H, W)``, from an even row and column on."""
    top, left = (image.shape[-2] - height) // 4 * 2, (image.shape[-1] - width) // 4 * 2
    return image[:, top : top + height, left : left + width].contiguous()


def _names(files: Sequence[Path]) -> list[str]:
    """File stems, or paths where two stems are equal."""
    names = [file.stem for file in files]
    if len(set(names)) < len(names):
        above = os.path.commonpath([file.resolve().parent for file in files])
        names = [file.resolve().relative_to(above).as_posix() for file in files]
    return names


def _pair(name: str, frame: RawFrame, srgb: Tensor, registered: bool) -> Pair:
    return Pair(
        name=name,
        srgb=srgb,
        raw=frame.mosaic,
        cfa=frame.cfa,
        white_balance=frame.white_balance,
        color_matrix=frame.color_matrix,
        camera=frame.camera,
        registered=registered,
        iso=frame.iso,
    )


def _raw_files(path: str | Path) -> list[Path]:
    path = Path(path)
    if path.is_dir():
        return sorted(file for file in path.rglob("*") if file.suffix.lower() in EXTENSIONS)
    return [path]


def _jpeg_beside(file: Path) -> Path | None:
    return next((jpeg for suffix in _JPEG_SUFFIXES if (jpeg := file.with_suffix(suffix)).is_file()), None)
