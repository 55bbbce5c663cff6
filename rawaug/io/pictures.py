r"""sRGB pictures: files of any format that :mod:`rawaug.io.decoding` reads, to and from uint8 ``(3, H, W)``.

The display transfer of sRGB (IEC 61966-2-1:1999), for linear light l and display value v, both in [0, 1]:

    v = 12.92 l                      for l <= 0.0031308
    v = 1.055 l^(1/2.4) - 0.055      otherwise

OpenEXR and Radiance files hold l; everything else is taken to hold v. Another space that the file states, by a profile,
by numbers or by EXIF, is converted by :mod:`rawaug.io.colour`. Pictures that are denoised are read by
:mod:`rawaug.io.stored`.
"""

from __future__ import annotations

from collections.abc import Callable
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from rawaug.bayer import turn
from rawaug.errors import extra
from rawaug.files import replacing, require_file, write_bytes
from rawaug.io.colour import SRGB, to_srgb
from rawaug.io.content import identify_content
from rawaug.io.decoding import MAX_PIXELS as MAX_PIXELS
from rawaug.io.decoding import Decoded, decode, decode_part, load_oiio, reason
from rawaug.io.decoding import require_utf8 as require_utf8
from rawaug.io.directories import EXIF, DamagedTags, TiffFile
from rawaug.io.exif import read_exif

_VIEW_OF_EXIF_ORIENTATION = (0, 1, 3, 2, 4, 5, 7, 6)
"""These views of :func:`rawaug.bayer.turn` bring EXIF orientations 1 to 8 upright."""

_HALF_LEVEL = 0.5 / 255


def encode_srgb(linear: Tensor) -> Tensor:
    """Convert linear light in [0, 1] to display values in [0, 1], of any shape."""
    curve = 1.055 * linear.clamp(min=0.0031308) ** (1 / 2.4) - 0.055
    return torch.where(linear <= 0.0031308, 12.92 * linear, curve)


def decode_srgb(display: Tensor) -> Tensor:
    """Convert display values in [0, 1] to linear light in [0, 1], of any shape; the inverse of :func:`encode_srgb`."""
    curve = ((display.clamp(min=0.04045) + 0.055) / 1.055) ** 2.4
    return torch.where(display <= 0.04045, display / 12.92, curve)


def view_of_orientation(orientation: int) -> int:
    """Find the view of :func:`rawaug.bayer.turn` that turns this EXIF orientation upright; 0 if it is unknown."""
    if not 1 <= orientation <= 8:
        return 0
    return _VIEW_OF_EXIF_ORIENTATION[orientation - 1]


def read_picture(path: str | Path, max_pixels: int = MAX_PIXELS) -> Tensor:
    """Read the first picture of a file as sRGB, uint8 ``(3, H, W)``, upright as its EXIF orientation says.

    Grey becomes three equal channels. Transparency is composited over black. 16 bits become 8 by rounding to the
    nearest level. So does floating point, which must lie in [0, 1] (half an 8-bit level aside). A JPEG with a gain map
    ("Ultra HDR") gives the picture that any viewer shows.

    Raises:
        FileNotFoundError: if there is no such file.
        OSError: if the file is not a picture, or is truncated.
        ValueError: if it is camera RAW, its header declares more than ``max_pixels``, it is animated, its colours are
            not sRGB (CMYK, CIELAB, more than four channels, a damaged profile, PQ or HLG), or leave [0, 1], or it is
            HEIC and the extra ``heif`` is not installed.

    Example:
        >>> read_picture("IMG_0001.heic").shape  # doctest: +SKIP
        torch.Size([3, 4032, 3024])
    """
    path = Path(path)
    picture = decode(path, max_pixels, coarse=True)
    pixels = _as_srgb(_over_black(picture), picture, path)
    # NumPy separates the planes several times faster than PyTorch
    planes = torch.from_numpy(np.ascontiguousarray(pixels.transpose(2, 0, 1)))

    view = view_of_orientation(picture.orientation)
    if view:
        planes = turn(planes, view).contiguous()
    return planes


def read_crop(
    path: str | Path, choose: Callable[[int, int], tuple[int, int, int, int]], max_pixels: int = MAX_PIXELS
) -> Tensor:
    """Read a part of a file's picture, the same numbers as :func:`read_picture` gives there.

    A JPEG is decoded no further than the last row of the part, if it is upright sRGB and complete; of any other file
    the whole picture is read.

    Args:
        path: the file.
        choose: a function from the height and width of the picture to the top, left, rows and columns of the part.
        max_pixels: as for :func:`read_picture`, whose errors are raised.

    Returns:
        uint8 ``(3, rows, columns)``.
    """
    path = Path(path)
    require_file(path, "picture file")
    part = decode_part(path, choose, max_pixels)
    if part is not None:
        return torch.from_numpy(np.ascontiguousarray(part.transpose(2, 0, 1)))

    picture = read_picture(path, max_pixels)
    top, left, rows, columns = choose(*picture.shape[1:])
    return picture[:, top : top + rows, left : left + columns].clone()


def read_plane(path: str | Path, max_pixels: int = MAX_PIXELS) -> np.ndarray:
    """Read the stored numbers of a file with one channel, uint8 or uint16 ``(H, W)``, such as a mosaic in a PNG."""
    picture = decode(Path(path), max_pixels)
    numbers = picture.colours
    if numbers.shape[-1] != 1 or picture.alpha is not None or numbers.dtype not in (np.uint8, np.uint16):
        names = ["Y"]
        if numbers.shape[-1] == 3:
            names = ["R", "G", "B"]
        if picture.alpha is not None:
            names.append("A")
        channels = f"{numbers.dtype} channels {', '.join(names)}"
        raise ValueError(f"{path}: has {channels}; a mosaic must have one channel of 8 or 16 bits")

    return numbers[..., 0]


def _over_black(picture: Decoded) -> np.ndarray:
    """Multiply the colours by alpha, in their own type."""
    if picture.alpha is None or picture.associated:
        return picture.colours
    if picture.colours.dtype.kind == "f":
        return picture.colours * picture.alpha

    largest = np.uint32(np.iinfo(picture.colours.dtype).max)
    product = picture.colours.astype(np.uint32) * picture.alpha
    return ((product + largest // 2) // largest).astype(picture.colours.dtype)


def _as_srgb(colours: np.ndarray, picture: Decoded, path: Path) -> np.ndarray:
    """Convert the colours of a picture to sRGB, uint8 ``(H, W, 3)``."""
    pixels = colours
    if pixels.shape[-1] == 1:
        pixels = np.repeat(pixels, 3, axis=-1)

    if pixels.dtype.kind == "f":
        pixels = require_unit_range(pixels, path)
    if picture.colour.is_linear and picture.colour.chromaticities == SRGB and pixels.dtype.kind == "f":
        pixels = encode_srgb(torch.from_numpy(pixels)).numpy()
    else:
        pixels = to_srgb(pixels, picture.colour, path)
    if pixels.dtype == np.uint16:
        pixels = pixels * np.float32(1.0 / 65535.0)
    if pixels.dtype != np.uint8:
        pixels = np.rint(pixels * 255).astype(np.uint8)
    return np.ascontiguousarray(pixels)


def require_unit_range(pixels: np.ndarray, path: str | Path) -> np.ndarray:
    """Clip floating point to [0, 1]; raise ValueError if a number leaves it by more than half an 8-bit level."""
    low, high = float(pixels.min()), float(pixels.max())
    if not (low >= -_HALF_LEVEL and high <= 1 + _HALF_LEVEL):
        raise ValueError(f"{path}: has values from {low:.4g} to {high:.4g}, expected [0, 1]; scale or tone-map it")
    return np.clip(pixels, 0, 1)


WRITTEN: dict[str, dict[str, Any]] = {
    ".png": {},
    ".jpg": {"quality": 98},
    ".jpeg": {"quality": 98},
    ".tif": {"compression": "tiff_lzw"},
    ".tiff": {"compression": "tiff_lzw"},
    ".webp": {"quality": 98},
    ".bmp": {},
    ".ppm": {},
}
""":func:`write_picture` writes files of these extensions, with these settings of Pillow."""


def write_picture(path: str | Path, srgb: Tensor) -> None:
    """Write sRGB ``(3, H, W)``, uint8 or floating point in [0, 1], as 8 bits in the format of the path's extension.

    The file is written completely or not at all.

    Raises:
        ValueError: if the shape is wrong, a value leaves [0, 1], or the extension is unknown.
        OSError: if the file cannot be written.
    """
    with extra("raw"):
        from PIL import Image

    extension = Path(path).suffix.lower()
    if extension not in WRITTEN:
        raise ValueError(f"{path}: unsupported extension; use one of {', '.join(WRITTEN)}")
    if srgb.ndim != 3 or srgb.shape[0] != 3:
        raise ValueError(f"{path}: the picture must have shape (3, H, W), got {tuple(srgb.shape)}")

    pixels = srgb.detach().cpu().permute(1, 2, 0).numpy()
    if pixels.dtype != np.uint8:
        pixels = np.rint(require_unit_range(pixels, path) * 255).astype(np.uint8)

    file = BytesIO()
    picture = Image.fromarray(np.ascontiguousarray(pixels))
    picture.save(file, Image.registered_extensions()[extension], **WRITTEN[extension])
    write_bytes(file.getbuffer(), path)


def write_linear(path: str | Path, light: Tensor) -> None:
    """Write linear light ``(3, H, W)``, of any range, as an OpenEXR file of 16-bit floating point.

    Raises:
        OSError: if the file cannot be written.
    """
    oiio = load_oiio()
    pixels = np.ascontiguousarray(light.detach().cpu().permute(1, 2, 0).numpy().astype(np.float16))
    spec = oiio.ImageSpec(pixels.shape[1], pixels.shape[0], 3, "half")
    with replacing(path) as partial:
        output = oiio.ImageOutput.create("openexr")
        success = output.open(str(partial), spec) and output.write_image(pixels)
        if not (output.close() and success and _holds(partial, pixels)):
            raise OSError(f"{path}: cannot be written (OpenImageIO: {reason(output) or 'the file is not whole'})")


def _holds(path: Path, pixels: np.ndarray) -> bool:
    """Tell whether an OpenEXR file has these pixels; OpenEXR does not report all that a full disk cuts off."""
    written = load_oiio().ImageInput.open(str(path))
    if written is None:
        return False

    image = written.read_image("half")
    written.close()
    return image is not None and np.array_equal(image, pixels, equal_nan=True)


def encode_png(srgb: Tensor) -> bytes:
    """Encode sRGB ``(3, H, W)`` in [0, 1] as a PNG file of 8 bits."""
    with extra("raw"):
        from PIL import Image

    codes = (srgb * 255.0).round().to(torch.uint8)
    file = BytesIO()
    Image.fromarray(codes.permute(1, 2, 0).contiguous().numpy()).save(file, "PNG")
    return file.getvalue()


_EXPOSURE_TIME, _F_NUMBER, _ISO, _EXPOSURE_INDEX = 33434, 33437, 34855, 34866


def read_exposure(path: Path) -> dict[str, float]:
    """Read exposure time in seconds, f-number and ISO as the EXIF of a picture states them, with 0 for none."""
    values = {"exposure time": 0.0, "f-number": 0.0, "ISO": 0.0}
    exif = read_exif(path, identify_content(path).format)
    if exif is None:
        return values

    try:
        tiff = TiffFile(BytesIO(exif))
        offset = tiff.number(tiff.directory(tiff.first), EXIF)
        if not offset:
            return values

        entries = tiff.directory(offset).entries
        values["exposure time"] = tiff.rational(entries.get(_EXPOSURE_TIME))
        values["f-number"] = tiff.rational(entries.get(_F_NUMBER))
        iso, *_ = tiff.numbers(entries.get(_ISO)) or (0,)
        if iso in (0, 65535):  # too high for 16 bits
            iso, *_ = tiff.numbers(entries.get(_EXPOSURE_INDEX)) or (0,)
        values["ISO"] = float(iso)
    except DamagedTags:
        pass
    return values


def recode_jpeg(srgb: Tensor, quality: int, chroma: str = "4:2:2") -> Tensor:
    """Encode sRGB ``(3, H, W)`` uint8 at ``quality`` (1 to 100) and decode it; ``chroma`` is its subsampling."""
    with extra("raw"):
        from PIL import Image

    file = BytesIO()
    picture = Image.fromarray(srgb.permute(1, 2, 0).contiguous().numpy())
    picture.save(file, "JPEG", quality=quality, subsampling=chroma)

    pixels = torch.from_numpy(np.array(Image.open(file)))
    return pixels.permute(2, 0, 1).contiguous()
