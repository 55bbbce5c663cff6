"""Camera and exposure of a RAW file, from LibRaw, the file's tags or its thumbnail."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from io import BytesIO
from typing import Any

from rawaug.extras import extra
from rawaug.io.tiff_tags import TiffTags

_EXIF_MAKE, _EXIF_MODEL = 271, 272
_SENSE = 1e6


@dataclass(frozen=True)
class Exposure:
    """How a shot was taken; None where the file does not say."""

    seconds: float | None = None
    f_number: float | None = None
    focal_length: float | None = None
    date: str | None = None


UNKNOWN = Exposure()


def exposure_of(raw: Any) -> Exposure:
    """LibRaw says 0 where it does not know, and 1970 of a date; absurd values count as unknown too."""
    other = getattr(raw, "other", None)  # rawpy 0.27 or newer
    numbers = [float(getattr(other, name, 0)) for name in ("shutter_speed", "aperture", "focal_length")]
    seconds, f_number, focal_length = (number if 0 < number < _SENSE else None for number in numbers)
    taken = getattr(other, "timestamp", None)
    date = f"{taken:%Y:%m:%d %H:%M:%S}" if taken is not None and taken.year > 1970 else None
    return Exposure(seconds, f_number, focal_length, date)


def camera_of(raw: Any, tags: TiffTags) -> str:
    """Make and model, from the file's tags or from its thumbnail's EXIF."""
    make, model = tags.make, tags.model
    if not model:
        make, model = _thumbnail_camera(raw)
    make, model = (str(name or "").strip() for name in (make, model))
    return (model if model.startswith(make) else f"{make} {model}") or "unknown"


def _thumbnail_camera(raw: Any) -> tuple[str | None, str | None]:
    with extra("raw"):
        import rawpy
        from PIL import Image

    try:
        thumbnail = raw.extract_thumb()
    except rawpy.LibRawError:
        return None, None
    if thumbnail.format != rawpy.ThumbFormat.JPEG:
        return None, None
    try:
        exif = Image.open(BytesIO(thumbnail.data)).getexif()
    except (OSError, SyntaxError, TypeError, ValueError, LookupError, struct.error):  # the mosaic may be whole
        return None, None
    return exif.get(_EXIF_MAKE), exif.get(_EXIF_MODEL)
