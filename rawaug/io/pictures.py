r"""sRGB pictures: files of any format that OpenImageIO knows, to and from uint8 ``(3, H, W)``.

The display transfer of sRGB (IEC 61966-2-1:1999), for linear light l and display value v, both in [0, 1]:

    v = 12.92 l                      for l <= 0.0031308
    v = 1.055 l^(1/2.4) - 0.055      otherwise

OpenEXR and Radiance files hold l, everything else is taken to hold v; an embedded ICC profile is not applied.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from rawaug.bayer import turn

_VIEW_OF_EXIF_ORIENTATION = (0, 1, 3, 2, 4, 5, 7, 6)
"""Views of :func:`rawaug.bayer.turn` that bring EXIF orientations 1 to 8 upright."""

_LINEAR_FORMATS = ("openexr", "hdr")
_HALF_LEVEL = 0.5 / 255


def encode_srgb(linear: Tensor) -> Tensor:
    """Linear light in [0, 1] to display values in [0, 1], any shape."""
    curve = 1.055 * linear.clamp(min=0.0031308) ** (1 / 2.4) - 0.055
    return torch.where(linear <= 0.0031308, 12.92 * linear, curve)


def decode_srgb(display: Tensor) -> Tensor:
    """Display values in [0, 1] to linear light in [0, 1], any shape; the inverse of :func:`encode_srgb`."""
    curve = ((display.clamp(min=0.04045) + 0.055) / 1.055) ** 2.4
    return torch.where(display <= 0.04045, display / 12.92, curve)


def read_picture(path: str | Path) -> Tensor:
    """The first picture of a file as sRGB, uint8 ``(3, H, W)``, upright as its EXIF orientation says.

    Grey becomes three equal channels. Transparency is composited over black. 16 bits become 8 by rounding to the
    nearest level; floating point too, and must lie in [0, 1] (half an 8-bit level aside).

    Raises:
        FileNotFoundError: if there is no such file.
        OSError: if the file is no picture, or is cut short.
        ValueError: if its colours are not sRGB (CMYK, CIELAB, more than four channels), or leave [0, 1].

    Example:
        >>> read_picture("photograph.jpg").shape  # doctest: +SKIP
        torch.Size([3, 480, 640])
    """
    pixels, orientation = _read(Path(path))
    view = _VIEW_OF_EXIF_ORIENTATION[orientation - 1] if 1 <= orientation <= 8 else 0
    return turn(torch.from_numpy(pixels).permute(2, 0, 1), view).contiguous()


def write_picture(path: str | Path, srgb: Tensor) -> None:
    """Write sRGB ``(3, H, W)``, uint8 or floating point in [0, 1], as 8 bits in the format of the path's extension.

    Raises:
        ValueError: if the shape is wrong, a value leaves [0, 1], or the extension is unknown.
        OSError: if the file cannot be written.
    """
    import OpenImageIO as oiio

    if srgb.ndim != 3 or srgb.shape[0] != 3:
        raise ValueError(f"{path}: a picture to write has shape (3, H, W), got {tuple(srgb.shape)}")
    pixels = srgb.detach().cpu().permute(1, 2, 0).numpy()
    if pixels.dtype != np.uint8:
        pixels = _round_to_8_bits(pixels, Path(path))
    output = oiio.ImageOutput.create(str(path))
    if output is None:
        raise ValueError(f"{path}: no picture format has this extension; use .png, .tif or .jpg ({oiio.geterror()})")
    spec = oiio.ImageSpec(pixels.shape[1], pixels.shape[0], 3, "uint8")
    written = output.open(str(path), spec) and output.write_image(np.ascontiguousarray(pixels))
    if not (output.close() and written):
        raise OSError(f"{path}: cannot be written (OpenImageIO: {_first_line(output.geterror())})")


def _read(path: Path) -> tuple[np.ndarray, int]:
    """Pixels uint8 ``(H, W, 3)`` as stored, and the EXIF orientation."""
    import OpenImageIO as oiio

    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such picture file")
    source = oiio.ImageInput.open(str(path))
    if source is None:
        raise OSError(f"{path}: cannot be read as a picture (OpenImageIO: {_first_line(oiio.geterror())})")
    spec = source.spec()
    _require_srgb(spec, path)
    floating = spec.format.basetype in (oiio.HALF, oiio.FLOAT, oiio.DOUBLE)
    pixels = source.read_image("float" if floating else "uint8")
    error = source.geterror()  # set also where a decoder filled up a file that is cut short
    source.close()
    if pixels is None or error:
        raise OSError(f"{path}: cannot be read as a picture (OpenImageIO: {_first_line(error)})")
    pixels = pixels[..., :3] if pixels.shape[-1] >= 3 else np.repeat(pixels[..., :1], 3, axis=-1)
    if floating:
        pixels = _round_to_8_bits(pixels, path, linear=source.format_name() in _LINEAR_FORMATS)
    return pixels, spec.get_int_attribute("Orientation", 1)


def _require_srgb(spec: Any, path: Path) -> None:
    """Refuse what would need a profile, or a choice of channels, to become sRGB."""
    stored = spec.get_string_attribute("tiff:ColorSpace") or spec.get_string_attribute("jpeg:ColorSpace")
    if any(name in stored for name in ("CMYK", "YCCK", "LAB", "separated")):
        raise ValueError(f"{path}: holds {stored} colours; convert it to sRGB first")
    names = tuple(spec.channelnames)
    extra = names[1:] if len(names) < 3 else names[3:]
    if extra not in ((), ("A",)):
        raise ValueError(f"{path}: holds channels {', '.join(names)}; a picture has grey or R, G, B, and at most alpha")


def _round_to_8_bits(pixels: np.ndarray, path: Path, linear: bool = False) -> np.ndarray:
    """Floating point in [0, 1] to the nearest 8-bit level, through the sRGB transfer where the values are linear."""
    low, high = float(pixels.min()), float(pixels.max())
    if not (low >= -_HALF_LEVEL and high <= 1 + _HALF_LEVEL):
        raise ValueError(f"{path}: values run from {low:.4g} to {high:.4g}, not in [0, 1]; scale or tone-map it first")
    values = np.clip(pixels, 0, 1)
    if linear:
        values = encode_srgb(torch.from_numpy(values)).numpy()
    return np.rint(values * 255).astype(np.uint8)


def _first_line(message: str) -> str:
    return message.strip().splitlines()[0] if message.strip() else "no reason given"
