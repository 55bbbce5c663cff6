"""What LibRaw does not pass on of a RAW file built on TIFF (DNG, NEF, CR2, ...), read by tifffile.

A DNG's NoiseProfile (tag 51041, DNG specification 1.3 and later) holds pairs (S, O), one for all colour planes or one a
plane, with noise variance S y + O for a signal y whose black is 0 and white 1: our ``shot_var`` and ``read_var``.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

_MAKE, _MODEL, _DNG_VERSION, _NOISE_PROFILE = 271, 272, 50706, 51041
_CFA_PHOTOMETRIC = 32803


@dataclass(frozen=True)
class TiffTags:
    """Each field is None where the file does not tell, or is no TIFF.

    Attributes:
        make, model: of the camera.
        noise_profile: (shot_var, read_var), the mean over colour planes.
        mosaic_end: the byte after a DNG's mosaic; a smaller file is cut short.
    """

    make: str | None = None
    model: str | None = None
    noise_profile: tuple[float, float] | None = None
    mosaic_end: int | None = None


def read_tiff_tags(path: Path) -> TiffTags:
    """Read the tags of the first page, and of the pages of a DNG that hold the mosaic and its noise."""
    import tifffile

    try:
        with tifffile.TiffFile(path) as tiff:
            pages = list(_all_pages(tiff.pages))
            make, model = (pages[0].tags.valueof(code) if pages else None for code in (_MAKE, _MODEL))
            if not any(_DNG_VERSION in page.tags for page in pages):
                return TiffTags(make, model)
            return TiffTags(make, model, _noise_profile(pages), _mosaic_end(pages))
    except tifffile.TiffFileError:
        return TiffTags()


def _all_pages(pages: Any) -> Iterator[Any]:
    for page in pages:
        yield page
        yield from _all_pages(getattr(page, "pages", None) or ())


def _noise_profile(pages: list[Any]) -> tuple[float, float] | None:
    for page in pages:
        values = page.tags.valueof(_NOISE_PROFILE)
        if values:
            planes = len(values) // 2
            return sum(values[0::2]) / planes, sum(values[1::2]) / planes
    return None


def _mosaic_end(pages: list[Any]) -> int | None:
    ends = [
        offset + count
        for page in pages
        if page.photometric == _CFA_PHOTOMETRIC
        for offset, count in zip(page.dataoffsets, page.databytecounts, strict=True)
    ]
    return max(ends, default=None)
