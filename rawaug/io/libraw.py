"""RAW files, opened and unpacked by LibRaw, whose complaints become one line that names the file.

LibRaw reports damage on the standard error stream and goes on. What it did not decode is then memory that it never
wrote to, which may hold the pixels of the previous file. That stream is therefore caught while LibRaw unpacks. Memory
is first filled with :data:`FILL`, if the C library can do so (glibc), which reveals the sites that were left out.
"""

from __future__ import annotations

import ctypes
import os
import re
import tempfile
import threading
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from rawaug.errors import extra
from rawaug.files import require_file
from rawaug.io.damage import count_empty_rows, find_fault, is_cut_short, stated_bytes
from rawaug.io.pictures import require_utf8
from rawaug.io.tiff import JPEG, TiffTags, read_tiff_tags

MAX_PIXELS = 200_000_000
"""A mosaic has at most this many sites; the largest sensors have 150 million."""

FILL = 0xFEFE
"""Every site of a mosaic holds this number before it is decoded."""

SMALLEST_GAP = 64
"""A gap has at least this many sites without a value; fewer may be defects of the sensor."""

KNOWN_PATTERNS = "Bayer, X-Trans and Quad-Bayer RAW is supported"

_DEVELOPED = (b"\xff\xd8\xff", b"\x89PNG", b"RIFF", b"GIF8", b"\x00\x00\x00\x0cJXL", b"\xff\x0a")
"""Files that begin with these bytes cannot hold RAW: JPEG, PNG, WebP, GIF, JPEG XL."""

_TO_LOSSLESS = "convert it to a DNG in lossless JPEG, as Adobe DNG Converter writes it"
_UNREAD_COMPRESSIONS = {
    52546: ("JPEG XL (DNG 1.7)", _TO_LOSSLESS),
    34892: ("lossy JPEG", _TO_LOSSLESS),
    9: ("GoPro's VC-5 (GPR)", "convert it with GoPro's gpr_tools (-i IN.GPR -o OUT.DNG) or Adobe DNG Converter"),
    8: ("deflate", _TO_LOSSLESS),
    32946: ("deflate", _TO_LOSSLESS),
    5: ("LZW", _TO_LOSSLESS),
}
"""LibRaw may fail to decode these compressions, by TIFF's number; what to do then."""
_BIG_TIFF = (b"II+\0", b"MM\0+")

_COMPLAINT = re.compile(r": (Unexpected end of file|data corrupted at -?\d+)$")
_M_PERTURB = -6
"""With this parameter of glibc's ``mallopt``, new memory is filled with the complement of a byte."""


@contextmanager
def opened_raw(path: Path, unpack: bool = True) -> Iterator[tuple[Any, TiffTags]]:
    """Open a file, decode its mosaic if it is to be unpacked, and read its TIFF tags.

    Raises:
        FileNotFoundError: if there is no such file.
        OSError: if LibRaw cannot read it, or it is truncated or damaged inside.
        ValueError: if it is a developed picture, or too large.
    """
    with extra("raw"):
        import rawpy

    require_file(path, "RAW file")
    require_utf8(path)
    # rawpy warns about forks, which rendering on one thread makes safe
    warnings.filterwarnings("ignore", "rawpy is being used in a process created by", RuntimeWarning)

    try:
        with caught_stderr():
            opened = rawpy.imread(str(path))
        with opened as raw:
            tags = read_tiff_tags(path)
            _require_size(path, raw, tags)
            if unpack:
                _unpack(path, raw, tags)
            yield raw, tags
    except rawpy.LibRawError as error:
        raise _explained(path, error) from error
    except NotImplementedError as error:  # from rawpy, for a mosaic without a repeating cell
        raise ValueError(f"{path}: has no mosaic of a known pattern ({error}); {KNOWN_PATTERNS}") from error
    except (ArithmeticError, np.linalg.LinAlgError) as error:
        raise OSError(f"{path}: its white balance or colour matrix is damaged ({error}); copy it again") from error


def _require_size(path: Path, raw: Any, tags: TiffTags) -> None:
    """Raise an error if the file is shorter than its tags say, or declares too many pixels."""
    size = path.stat().st_size
    if tags.mosaic is not None:
        end = max((offset + length for offset, length in tags.mosaic.segments), default=0)
        if end > size:
            raise OSError(f"{path}: cannot be read as RAW: truncated, {size} of {end} bytes")
    elif is_cut_short(path):
        raise OSError(f"{path}: cannot be read as RAW: truncated, {size} of {stated_bytes(path)} bytes")

    height, width = raw.sizes.raw_height, raw.sizes.raw_width
    if height * width > MAX_PIXELS:
        raise ValueError(f"{path}: declares {height} x {width} pixels, above the limit of {MAX_PIXELS}; copy it again")


def _unpack(path: Path, raw: Any, tags: TiffTags) -> None:
    """Decode the mosaic; raise OSError if a part of it is missing."""
    stored = tags.mosaic
    if stored is not None and stored.compression == JPEG and len(stored.segments) > 1 and not stored.tiled:
        what = f"its mosaic is in {len(stored.segments)} strips of JPEG, of which LibRaw reads the first"
        raise ValueError(f"{path}: {what}; {_TO_LOSSLESS}")

    with caught_stderr() as lines, _filled_memory() as filled:
        raw.unpack()
    if lines:
        raise OSError(f"{path}: is damaged inside (LibRaw: {lines[0]}); copy it again")

    numbers = None if is_stack(raw) else raw.raw_image
    if stored is not None:
        fault = find_fault(path, stored, numbers)
        if fault:
            raise OSError(f"{path}: is damaged inside ({fault}); copy it again")

    if filled and numbers is not None and raw.white_level < FILL:
        visible = raw.raw_image_visible
        missing = int((visible == FILL).sum())
        if missing >= SMALLEST_GAP:
            raise OSError(f"{path}: is damaged inside ({missing} of {visible.size} sites are missing); copy it again")

    if numbers is not None:
        empty = count_empty_rows(raw.raw_image_visible, min(raw.black_level_per_channel))
        if empty:
            height = raw.raw_image_visible.shape[0]
            raise OSError(f"{path}: is damaged inside (the last {empty} of {height} rows are empty); copy it again")


def is_stack(raw: Any) -> bool:
    """Tell whether a file has all colours at every pixel."""
    with extra("raw"):
        import rawpy

    return bool(raw.raw_type == rawpy.RawType.Stack)


def _explained(path: Path, error: Any) -> Exception:
    """Turn LibRaw's error into one that says what the file is, if its content shows that."""
    with extra("raw"):
        import rawpy

    with path.open("rb") as file:
        head = file.read(12)
    if head.startswith(_DEVELOPED):
        return ValueError(f"{path}: this is a developed picture, not RAW; give the camera's RAW file")
    if head.startswith(_BIG_TIFF):
        return ValueError(f"{path}: is a BigTIFF, which LibRaw does not read; {_TO_LOSSLESS}")

    reason = str(error)
    if error.args and isinstance(error.args[0], bytes):
        reason = error.args[0].decode("ascii", "replace")

    try:
        compressions = read_tiff_tags(path).compressions
    except OSError:
        compressions = ()
    for number, (name, advice) in _UNREAD_COMPRESSIONS.items():
        if number in compressions and isinstance(error, rawpy.LibRawFileUnsupportedError):
            return ValueError(f"{path}: is compressed as {name}, which LibRaw does not read ({reason}); {advice}")

    advice = "check that it is complete and from a supported camera"
    return OSError(f"{path}: cannot be read as RAW (LibRaw: {reason}); {advice}")


# -- the standard error stream and the memory of C code ----------------------------------------------------------------

_stderr_lock = threading.Lock()


def _renew_lock() -> None:
    global _stderr_lock
    _stderr_lock = threading.Lock()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_renew_lock)  # another thread may have held it


@contextmanager
def caught_stderr() -> Iterator[list[str]]:
    """Catch LibRaw's complaints, which are in the list after the block; other lines are passed on."""
    complaints: list[str] = []
    with _stderr_lock:
        try:
            terminal = os.dup(2)
        except OSError:  # a process without a standard error stream
            yield complaints
            return

        with tempfile.TemporaryFile() as file:
            os.dup2(file.fileno(), 2)
            try:
                yield complaints
            finally:
                os.dup2(terminal, 2)
                os.close(terminal)
                file.seek(0)
                for line in file.read().splitlines():
                    complaint = _COMPLAINT.search(line.decode("utf-8", "replace"))
                    if complaint:
                        complaints.append(complaint[1])
                    else:
                        os.write(2, line + b"\n")


@contextmanager
def _filled_memory() -> Iterator[bool]:
    """Let the C library fill new memory with :data:`FILL`; yield False if it cannot."""
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (AttributeError, OSError, TypeError):
        yield False
        return

    accepted = mallopt(_M_PERTURB, ~FILL & 0xFF)
    try:
        yield bool(accepted)
    finally:
        mallopt(_M_PERTURB, 0)
