"""Pictures in TIFF: which decoder reads which kind as it is meant, and the kinds that none does.

A TIFF's numbers mean what PhotometricInterpretation says; they are packed in 1 to 64 bits, as planes or as pixels, and
predicted or not. Decoders take combinations that they do not implement for others, without a word: OpenImageIO shows
white-is-zero above 8 bits as a negative. So kinds are listed that were compared with pictures that are known
(`python -m benchmarks.matrices`). OpenImageIO reads the usual ones, tifffile the others, and the rest is refused.
Source: TIFF 6.0, sections 3 to 14, 18 and 22.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np

from rawaug.io.directories import COMPRESSION, PHOTOMETRIC, DamagedTags, Directory, TiffFile

_WIDTH, _HEIGHT, _BITS, _DESCRIPTION, _SAMPLES, _PLANES = 256, 257, 258, 270, 277, 284
_PREDICTOR, _EXTRA_SAMPLES, _NUMBERS = 317, 338, 339
_SUBFILE_TYPE, _OLD_SUBFILE_TYPE = 254, 255
_REDUCED_OR_MASK, _OLD_REDUCED = 5, 2
_MOST_PAGES = 64

WHITE_IS_ZERO, BLACK_IS_ZERO, RGB, PALETTE, _CMYK, _YCBCR = 0, 1, 2, 3, 5, 6
_NAMES = {4: "a mask", _CMYK: "CMYK", _YCBCR: "YCbCr", 8: "CIELAB", 9: "ICCLAB", 10: "ITULAB"}
_UNSIGNED, _FLOATING = 1, 3
_FAX, _JPEG, _LOSSLESS, _NEWER = (2, 3, 4), 7, (1, 5, 8, 32946, 32773), (34925, 50000)
"""Compressions: those of fax; JPEG; none, LZW, Deflate by either number and PackBits; LZMA and Zstandard."""
_ASSOCIATED, _UNASSOCIATED = 1, 2
_IMAGEJ_STACK = re.compile(rb"^ImageJ=.*\nimages=(\d+)", re.DOTALL)


class TiffKind(NamedTuple):
    """How the first picture of a TIFF is stored, in TIFF's numbers; ``extra`` are the meanings of further samples."""

    photometric: int
    bits: tuple[int, ...]
    samples: int
    planes: int
    predictor: int
    compression: int
    numbers: int
    extra: tuple[int, ...]
    pages: int

    def __str__(self) -> str:
        meaning = _NAMES.get(self.photometric, f"photometric interpretation {self.photometric}")
        bits = "/".join(str(number) for number in dict.fromkeys(self.bits))
        kind = "floating-point bits" if self.numbers == _FLOATING else "bits"
        return f"{meaning}, {bits} {kind}, compression {self.compression}, predictor {self.predictor}"


def read_tiff_kind(file: BinaryIO) -> TiffKind | None:
    """Read how a TIFF stores its picture; return None if its directory is damaged, which its decoder will say."""
    try:
        tiff = TiffFile(file)
        first = tiff.directory(tiff.first)
        samples = tiff.number(first, _SAMPLES, 1)
        numbers = set(tiff.numbers(first.entries.get(_NUMBERS))) or {_UNSIGNED}
        return TiffKind(
            photometric=tiff.number(first, PHOTOMETRIC, -1),
            bits=tiff.numbers(first.entries.get(_BITS)) or (1,),
            samples=samples,
            planes=tiff.number(first, _PLANES, 1) if samples > 1 else 1,
            predictor=tiff.number(first, _PREDICTOR, 1),
            compression=tiff.number(first, COMPRESSION, 1),
            numbers=numbers.pop() if len(numbers) == 1 else 0,
            extra=tiff.numbers(first.entries.get(_EXTRA_SAMPLES)),
            pages=_count_pages(tiff),
        )
    except DamagedTags:
        return None


def _count_pages(tiff: TiffFile) -> int:
    """Count the pictures, without thumbnails, masks, and what is less than half as wide or high as the first."""
    places: list[int] = []
    offset = tiff.first
    first = tiff.directory(offset)
    least = tiff.number(first, _HEIGHT) / 2, tiff.number(first, _WIDTH) / 2

    pages = 0
    while offset and offset not in places and len(places) < _MOST_PAGES:
        places.append(offset)
        directory = tiff.directory(offset)
        is_large = tiff.number(directory, _HEIGHT) >= least[0] and tiff.number(directory, _WIDTH) >= least[1]
        pages += is_large and not _is_reduced(tiff, directory)
        offset = directory.following

    description = first.entries.get(_DESCRIPTION)
    stack = None if description is None else _IMAGEJ_STACK.match(tiff.tag(description).data)
    return max(pages, int(stack[1]) if stack is not None else 1)


def _is_reduced(tiff: TiffFile, directory: Directory) -> bool:
    is_old = tiff.number(directory, _OLD_SUBFILE_TYPE) == _OLD_REDUCED
    return is_old or bool(tiff.number(directory, _SUBFILE_TYPE) & _REDUCED_OR_MASK)


def choose_tiff_reader(kind: TiffKind, path: Path) -> str:
    """Say which library reads a kind, ``"OpenImageIO"`` or ``"tifffile"``.

    Raises:
        ValueError: if none does as it is meant, or if there are several pages.
    """
    if kind.pages > 1:
        raise ValueError(f"{path}: is a TIFF of {kind.pages} pages; save each as a file of its own")
    if kind.photometric in _NAMES and (kind.photometric != _YCBCR or kind.compression != _JPEG):
        raise ValueError(f"{path}: is {_NAMES[kind.photometric]} in TIFF; convert it to sRGB first")
    if _openimageio_reads(kind):
        return "OpenImageIO"
    if _tifffile_reads(kind):
        return "tifffile"
    raise ValueError(f"{path}: is a TIFF of {kind}, which is not read; save it as PNG or plain TIFF")


def _openimageio_reads(kind: TiffKind) -> bool:
    bits = kind.bits[0]
    if len(set(kind.bits)) > 1:
        return False
    if kind.compression == _JPEG:
        return bits == 8 and kind.photometric in (BLACK_IS_ZERO, RGB, _YCBCR)
    if kind.compression in _FAX:
        return bits == 1 and kind.samples == 1 and kind.photometric in (WHITE_IS_ZERO, BLACK_IS_ZERO)
    if kind.compression not in _LOSSLESS:
        return False

    if kind.numbers == _FLOATING:
        return kind.photometric in (BLACK_IS_ZERO, RGB) and bits in (16, 32, 64) and kind.predictor in (1, 3)
    if kind.numbers != _UNSIGNED or kind.predictor not in (1, 2):
        return False
    if kind.photometric == WHITE_IS_ZERO:
        return kind.samples == 1 and bits in (1, 2, 4, 8) and (kind.predictor == 1 or bits == 8)
    if kind.photometric == PALETTE:
        return bits in (1, 2, 4, 8) and (kind.predictor == 1 or bits == 8)
    if kind.photometric in (BLACK_IS_ZERO, RGB):
        return bits in (8, 16) or (bits in (1, 2, 4) and kind.samples == 1 and kind.predictor == 1)
    return False


def _tifffile_reads(kind: TiffKind) -> bool:
    bits = kind.bits[0]
    is_plain = kind.compression in (*_LOSSLESS, *_NEWER) and len(set(kind.bits)) == 1
    channels = 3 if kind.photometric == RGB else 1
    if (
        kind.photometric not in (WHITE_IS_ZERO, BLACK_IS_ZERO, RGB, _YCBCR)
        or kind.samples - len(kind.extra) != channels
    ):
        return kind.compression == _JPEG and bits == 16 and kind.samples == 3
    if len(kind.extra) > 1 or not set(kind.extra) <= {_ASSOCIATED, _UNASSOCIATED}:
        return False
    if kind.photometric == WHITE_IS_ZERO and _ASSOCIATED in kind.extra:
        return False

    if kind.numbers == _FLOATING:
        return is_plain and bits in (16, 32, 64) and kind.predictor in (1, 3)
    if kind.numbers != _UNSIGNED or kind.predictor not in (1, 2):
        return False
    if kind.compression == _JPEG:
        return bits == 16 and not kind.extra
    return is_plain and bits <= 16


def decode_tiff_codes(codes: np.ndarray, kind: TiffKind) -> np.ndarray:
    """Turn the codes ``(H, W, C)`` of tifffile into numbers that are 0 at black and the most of their type at white."""
    if kind.numbers == _FLOATING:
        numbers = codes.astype(np.float32)
        if kind.photometric == WHITE_IS_ZERO:
            numbers[..., :1] = 1 - numbers[..., :1]
        return numbers

    bits = kind.bits[0]
    dtype = np.dtype(np.uint8) if bits <= 8 else np.dtype(np.uint16)
    numbers = np.bitwise_and(codes, 2**bits - 1).astype(dtype)  # differences wrap around at their own bits
    if bits not in (8, 16):
        scale = np.iinfo(dtype).max / (2**bits - 1)
        numbers = np.rint(numbers * np.float64(scale)).astype(dtype)
    if kind.photometric == WHITE_IS_ZERO:
        numbers[..., :1] = np.iinfo(dtype).max - numbers[..., :1]
    return numbers
