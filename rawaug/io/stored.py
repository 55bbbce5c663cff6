"""Pictures to denoise: reading of their stored numbers, and writing of a file with all of the first one's metadata.

A picture is neither turned nor converted: its EXIF, its ICC profile and its orientation go to the new file as they are
(:mod:`rawaug.io.metadata`), and so does transparency. 8 and 16 bits, and floating point in TIFF, are kept if the new
format has them.
"""

from __future__ import annotations

from io import BytesIO
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from rawaug.errors import extra
from rawaug.files import write_bytes
from rawaug.io.decoding import MAX_PIXELS, decode
from rawaug.io.directories import TiffFile
from rawaug.io.exif import Thumbnail, mend_exif, read_exif
from rawaug.io.headers import webp_chunks
from rawaug.io.metadata import Metadata, byte_order, dress_jpeg, dress_png, dress_tiff
from rawaug.io.pictures import require_unit_range

QUALITY = 97
"""JPEG and WebP files are written at this quality; a JPEG has chroma at full size."""
PICTURE_FORMATS = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".webp")
"""Files with these extensions can be written."""

_TURNED_BY_DECODER = ("HEIC", "JPEG XL", "JPEG 2000")
_LARGEST_WEBP = 16383
_TIFF_COMPRESSIONS = {1: None, 5: "lzw"}
"""This maps the compression of a source TIFF to that of the result; any other becomes Deflate."""


class StoredPicture(NamedTuple):
    """A picture as its file has it.

    Args:
        colours: ``(H, W, 1)`` or ``(H, W, 3)``, uint8, uint16 or float32, display values, not turned upright.
        alpha: ``(H, W, 1)`` of the same type, if there is transparency; ``colours`` are not multiplied by it.
        metadata: the metadata besides the pixels.
    """

    colours: np.ndarray
    alpha: np.ndarray | None
    metadata: Metadata

    @property
    def srgb(self) -> Tensor:
        """float32 ``(3, H, W)`` in [0, 1]; grey has three equal channels."""
        pixels = np.ascontiguousarray(self.colours.transpose(2, 0, 1))
        planes = torch.from_numpy(pixels.astype(np.float32))
        if self.colours.dtype.kind == "u":
            planes *= 1.0 / np.iinfo(self.colours.dtype).max
        return planes.expand(3, -1, -1).contiguous()

    @property
    def is_grey(self) -> bool:
        """Whether the file has one channel."""
        return self.colours.shape[-1] == 1


def read_stored(path: str | Path, max_pixels: int = MAX_PIXELS) -> StoredPicture:
    """Read a picture of 8 or 16 bits, or of floating-point numbers in [0, 1].

    Raises:
        FileNotFoundError: if there is no such file.
        OSError: if it is not a picture, or is truncated.
        ValueError: if it is camera RAW, larger than ``max_pixels``, animated, CMYK or CIELAB, a TIFF of several pages,
            or holds linear light or numbers outside [0, 1].
    """
    path = Path(path)
    picture = decode(path, max_pixels)
    if picture.colour.is_linear:
        raise ValueError(f"{path}: is {picture.format} and holds linear light; save it as a developed picture")

    colours, alpha = picture.colours, picture.alpha
    if colours.dtype.kind == "f":
        colours = require_unit_range(colours, path)
    if alpha is not None and picture.associated:
        colours = _divided(colours, alpha)

    exif = picture.headers.exif
    if picture.format == "TIFF":
        exif = read_exif(path, "TIFF")

    metadata = Metadata(path, picture.format, exif, picture.headers.xmp, picture.colour.icc())
    return StoredPicture(np.ascontiguousarray(colours), alpha, metadata)


def write_stored(path: str | Path, srgb: Tensor, like: StoredPicture) -> None:
    """Write sRGB ``(3, H, W)`` in [0, 1], completely or not at all, with channels, bits and metadata of ``like``.

    Raises:
        ValueError: if the extension is none of :data:`PICTURE_FORMATS`, or the format cannot hold the picture.
        OSError: if the file cannot be written.
    """
    path = Path(path)
    extension = path.suffix.lower()
    if extension not in PICTURE_FORMATS:
        raise ValueError(f"{path}: cannot be written; use one of {', '.join(PICTURE_FORMATS)}")

    planes = srgb.detach().cpu()
    if like.is_grey:
        planes = planes.mean(0, keepdim=True)
    planes = planes.clamp(0.0, 1.0)

    upright = like.metadata.format in _TURNED_BY_DECODER
    if extension in (".jpg", ".jpeg"):
        data = _jpeg(planes, like, upright)
    elif extension == ".png":
        data = _png(planes, like, upright)
    elif extension == ".webp":
        data = _webp(path, planes, like, upright)
    else:
        data = _tiff(planes, like, upright)

    write_bytes(data, path)


def _numbers(planes: Tensor, dtype: np.dtype) -> np.ndarray:
    """Convert planes in [0, 1] to ``(H, W, C)`` of a type."""
    pixels = planes.permute(1, 2, 0).numpy()
    if dtype.kind != "f":
        pixels = np.rint(pixels * np.iinfo(dtype).max)
    return np.ascontiguousarray(pixels.astype(dtype))


def _white(dtype: np.dtype) -> float:
    """Return the number that stands for white."""
    if dtype.kind == "f":
        return 1.0
    return float(np.iinfo(dtype).max)


def _with_alpha(pixels: np.ndarray, alpha: np.ndarray | None) -> np.ndarray:
    """Append alpha to colours, in the type of the colours."""
    if alpha is None:
        return pixels

    if alpha.dtype != pixels.dtype:
        scale = _white(pixels.dtype) / _white(alpha.dtype)
        alpha = np.rint(alpha.astype(np.float64) * scale).astype(pixels.dtype)
    return np.ascontiguousarray(np.concatenate([pixels, alpha], axis=-1))


def _divided(colours: np.ndarray, alpha: np.ndarray) -> np.ndarray:
    """Divide colours that were multiplied by alpha by it; they become black where alpha is 0."""
    white = _white(colours.dtype)
    quotient = colours * (white / np.maximum(alpha.astype(np.float64), white * 1e-6))
    quotient = np.clip(quotient, 0.0, white)
    if colours.dtype.kind != "f":
        quotient = np.rint(quotient)
    return quotient.astype(colours.dtype)


def _without_last_axis(pixels: np.ndarray) -> np.ndarray:
    """Reshape pixels ``(H, W, C)`` as encoders take them: one channel becomes ``(H, W)``."""
    if pixels.shape[-1] == 1:
        return pixels[..., 0]
    return pixels


def _renderer(planes: Tensor) -> Thumbnail:
    """Make the function that renders thumbnails of a picture."""

    def render(height: int, width: int) -> np.ndarray:
        small = F.interpolate(planes[None], (height, width), mode="area")[0]
        return _numbers(small.expand(3, -1, -1), np.dtype(np.uint8))

    return render


def _jpeg(planes: Tensor, like: StoredPicture, upright: bool) -> bytes:
    with extra("raw"):
        from PIL import Image

    pixels = _without_last_axis(_numbers(planes, np.dtype(np.uint8)))
    file = BytesIO()
    Image.fromarray(pixels).save(file, "JPEG", quality=QUALITY, subsampling="4:4:4")
    return dress_jpeg(file.getvalue(), like.metadata, _renderer(planes), upright)


def _png(planes: Tensor, like: StoredPicture, upright: bool) -> bytes:
    with extra("raw"):
        import imagecodecs

    dtype = like.colours.dtype
    if dtype != np.uint8:
        dtype = np.dtype(np.uint16)
    pixels = _without_last_axis(_with_alpha(_numbers(planes, dtype), like.alpha))
    plain = bytes(imagecodecs.png_encode(pixels))
    return dress_png(plain, like.metadata, _renderer(planes), upright)


def _webp(path: Path, planes: Tensor, like: StoredPicture, upright: bool) -> bytes:
    with extra("raw"):
        from PIL import Image

    height, width = planes.shape[-2:]
    if max(height, width) > _LARGEST_WEBP:
        raise ValueError(f"{path}: WebP holds at most {_LARGEST_WEBP} pixels a side; use .png or .jpg")

    pixels = _with_alpha(_numbers(planes.expand(3, -1, -1), np.dtype(np.uint8)), like.alpha)
    settings: dict[str, Any] = {"quality": QUALITY, "lossless": _is_lossless(like.metadata), "exact": True}
    if like.metadata.profile:
        settings["icc_profile"] = like.metadata.profile
    if like.metadata.xmp:
        settings["xmp"] = like.metadata.xmp
    if like.metadata.exif:
        settings["exif"] = mend_exif(like.metadata.exif, _renderer(planes), upright)

    file = BytesIO()
    Image.fromarray(pixels).save(file, "WEBP", **settings)
    return file.getvalue()


def _is_lossless(metadata: Metadata) -> bool:
    """Tell whether a picture comes from a lossless format and therefore keeps every bit."""
    if metadata.format in ("JPEG", "HEIC", "AVIF"):
        return False
    if metadata.format != "WebP":
        return True

    with metadata.source.open("rb") as file:
        names = [chunk.name for chunk in webp_chunks(file)]
    return b"VP8L" in names


def _tiff(planes: Tensor, like: StoredPicture, upright: bool) -> bytes:
    with extra("raw"):
        import tifffile

    pixels = _with_alpha(_numbers(planes, like.colours.dtype), like.alpha)
    layout: dict[str, Any] = {"photometric": "minisblack" if like.is_grey else "rgb"}
    if pixels.shape[-1] > 1:
        layout["planarconfig"] = "contig"
    if like.alpha is not None:
        layout["extrasamples"] = ["unassalpha"]

    file = BytesIO()
    tifffile.imwrite(
        file,
        _without_last_axis(pixels),
        compression=_compression(like.metadata),
        byteorder=byte_order(like.metadata),
        metadata=None,
        **layout,
    )
    return dress_tiff(file.getvalue(), like.metadata, upright)


def _compression(metadata: Metadata) -> str | None:
    """Choose the compression of the source if it is a TIFF; other pictures have none."""
    if metadata.format != "TIFF":
        return None

    with metadata.source.open("rb") as file:
        tiff = TiffFile(file)
        number = tiff.number(tiff.directory(tiff.first), 259, 1)
    return _TIFF_COMPRESSIONS.get(number, "deflate")
