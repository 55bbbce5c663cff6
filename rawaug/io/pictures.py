r"""sRGB pictures: files of any format that OpenImageIO knows, to and from uint8 ``(3, H, W)``.

The display transfer of sRGB (IEC 61966-2-1:1999), for linear light l and display value v, both in [0, 1]:

    v = 12.92 l                      for l <= 0.0031308
    v = 1.055 l^(1/2.4) - 0.055      otherwise

OpenEXR and Radiance files hold l, everything else is taken to hold v. An embedded ICC profile of another space (Display
P3, Adobe RGB, grey of another gamma) is applied by LittleCMS, relative colorimetric with black point compensation, in 8
bits; without one, a picture is taken to be sRGB whatever else its tags say. Source: ICC.1:2022.

A picture that is denoised (:func:`read_stored`) is neither turned nor converted: its EXIF, its ICC profile and its
orientation go to the new file as they are, and so does transparency. 8 and 16 bits are kept where that format has them.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from functools import lru_cache
from io import BytesIO
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from rawaug.bayer import turn
from rawaug.errors import extra
from rawaug.files import replacing, require_file

MAX_PIXELS = 2**26
"""Larger pictures (8192 x 8192) are refused by default, since a few header bytes can claim any size."""

MAX_CHANNELS = 4

_VIEW_OF_EXIF_ORIENTATION = (0, 1, 3, 2, 4, 5, 7, 6)
"""Views of :func:`rawaug.bayer.turn` that bring EXIF orientations 1 to 8 upright."""

_FORMAT = "rawaug:format"
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


def view_of_orientation(orientation: int) -> int:
    """The view of :func:`rawaug.bayer.turn` that shows a picture of this EXIF orientation upright; 0 if unknown."""
    return _VIEW_OF_EXIF_ORIENTATION[orientation - 1] if 1 <= orientation <= 8 else 0


def read_picture(path: str | Path, max_pixels: int = MAX_PIXELS) -> Tensor:
    """The first picture of a file as sRGB, uint8 ``(3, H, W)``, upright as its EXIF orientation says.

    Grey becomes three equal channels. Transparency is composited over black. 16 bits become 8 by rounding to the
    nearest level; floating point too, and must lie in [0, 1] (half an 8-bit level aside).

    Raises:
        FileNotFoundError: if there is no such file.
        OSError: if the file is not a picture, or is truncated.
        ValueError: if its header declares more than ``max_pixels``, it is animated, its colours are not sRGB (CMYK,
            CIELAB, more than four channels, a damaged profile), or leave [0, 1].
    """
    pixels, orientation = _read(Path(path), max_pixels)
    return turn(torch.from_numpy(pixels).permute(2, 0, 1), view_of_orientation(orientation)).contiguous()


def read_plane(path: str | Path, max_pixels: int = MAX_PIXELS) -> np.ndarray:
    """The numbers of a file with one channel as they are stored, uint8 or uint16 ``(H, W)``: a mosaic kept as a PNG."""
    pixels, spec = decode_file(Path(path), max_pixels, lambda spec: spec.format)
    if pixels.shape[-1] != 1 or pixels.dtype not in (np.uint8, np.uint16):
        names = ", ".join(spec.channelnames)
        raise ValueError(f"{path}: has {pixels.dtype} channels {names}; a mosaic must have one channel of 8 or 16 bits")
    return pixels[..., 0]


def write_picture(path: str | Path, srgb: Tensor) -> None:
    """Write sRGB ``(3, H, W)``, uint8 or floating point in [0, 1], as 8 bits in the format of the path's extension.

    Raises:
        ValueError: if the shape is wrong, a value leaves [0, 1], or the extension is unknown.
        OSError: if the file cannot be written.
    """
    oiio = _oiio()
    if srgb.ndim != 3 or srgb.shape[0] != 3:
        raise ValueError(f"{path}: the picture must have shape (3, H, W), got {tuple(srgb.shape)}")
    pixels = srgb.detach().cpu().permute(1, 2, 0).numpy()
    if pixels.dtype != np.uint8:
        pixels = _round_to_8_bits(pixels, Path(path))
    output = oiio.ImageOutput.create(str(path))
    if output is None:
        raise ValueError(f"{path}: unsupported extension; use .png, .tif or .jpg ({oiio.geterror()})")
    spec = oiio.ImageSpec(pixels.shape[1], pixels.shape[0], 3, "uint8")
    written = output.open(str(path), spec) and output.write_image(np.ascontiguousarray(pixels))
    _require_written(output, written, path)


def _require_written(output: Any, written: bool, path: str | Path) -> None:
    """Close OpenImageIO's ``output``; OSError if it, or what was ``written`` to it, failed."""
    if not (output.close() and written):
        raise OSError(f"{path}: cannot be written (OpenImageIO: {_reason(output) or 'no reason given'})")


def encode_png(srgb: Tensor) -> bytes:
    """sRGB ``(3, H, W)`` in [0, 1] as a PNG file of 8 bits."""
    with extra("raw"):
        from PIL import Image

    file = BytesIO()
    Image.fromarray((srgb * 255.0).round().to(torch.uint8).permute(1, 2, 0).contiguous().numpy()).save(file, "PNG")
    return file.getvalue()


def _read(path: Path, max_pixels: int) -> tuple[np.ndarray, int]:
    """Pixels uint8 ``(H, W, 3)`` as stored, and the EXIF orientation."""

    def kind(spec: Any) -> str:
        _require_srgb(spec, path)
        floats = _oiio().HALF, _oiio().FLOAT, _oiio().DOUBLE
        return "float" if spec.format.basetype in floats else "uint8"

    pixels, spec = decode_file(path, max_pixels, kind)
    pixels = pixels[..., :3] if pixels.shape[-1] >= 3 else np.repeat(pixels[..., :1], 3, axis=-1)
    if pixels.dtype != np.uint8:
        pixels = _round_to_8_bits(pixels, path, linear=spec.get_string_attribute(_FORMAT) in _LINEAR_FORMATS)
    profile = spec.getattribute("ICCProfile")
    if profile is not None:
        pixels = to_srgb(np.ascontiguousarray(pixels), bytes(profile), path)
    return pixels, spec.get_int_attribute("Orientation", 1)


def decode_file(path: Path, max_pixels: int, kind: Callable[[Any], Any]) -> tuple[np.ndarray, Any]:
    """The pixels ``(H, W, C)`` of the first picture in the type that ``kind`` chooses, and OpenImageIO's spec of it."""
    source = _opened(path)
    spec = source.spec()
    spec.attribute(_FORMAT, source.format_name())
    _require_size(spec, path, max_pixels)
    try:
        pixels = source.read_image(kind(spec))
    except UnicodeDecodeError as error:  # OpenImageIO's binding, of texts in the header
        raise OSError(f"{path}: cannot be read as a picture (its header is damaged: {error}); copy it again") from error
    fault = _reason(source)  # also set where a decoder padded a truncated file
    # a GIF is marked as animated only if its frames have a duration
    moves = spec.get_int_attribute("oiio:Movie") or (source.format_name() == "gif" and source.seek_subimage(1, 0))
    source.close()
    if moves:
        raise ValueError(f"{path}: is an animation; save a single frame")
    if pixels is None or fault:
        raise OSError(f"{path}: cannot be read as a picture (OpenImageIO: {fault or 'no reason given'})")
    return pixels, spec


def _opened(path: Path) -> Any:
    oiio = _oiio()
    require_file(path, "picture file")
    require_utf8(path)
    source = oiio.ImageInput.open(str(path))
    if source is None:
        raise OSError(f"{path}: cannot be read as a picture (OpenImageIO: {_reason(oiio) or 'no reason given'})")
    return source


def require_utf8(path: Path) -> None:
    """Raise OSError if the name is not UTF-8, which the libraries need."""
    if any("\udc80" <= letter <= "\udcff" for letter in str(path)):  # how Python represents bytes that are not UTF-8
        raise OSError(f"{os.fsencode(path)!r}: cannot be opened because its name is not UTF-8; rename it")


def _oiio() -> Any:
    with extra("raw"):
        import OpenImageIO

    return OpenImageIO


def _require_size(spec: Any, path: Path, max_pixels: int) -> None:
    """Raise ValueError if the declared size is above the limit, before anything is decoded."""
    pixels = spec.width * spec.height * spec.depth
    if pixels > max_pixels or pixels * spec.nchannels > MAX_CHANNELS * max_pixels:
        size = f"{spec.height} x {spec.width} pixels"
        size += f" of {spec.nchannels} channels" if pixels <= max_pixels else ""
        raise ValueError(f"{path}: declares {size}, above the limit of {max_pixels}; split it, or raise max_pixels")


def _require_srgb(spec: Any, path: Path) -> None:
    """Raise ValueError if a conversion to sRGB would need a profile or a choice of channels."""
    stored = spec.get_string_attribute("tiff:ColorSpace") or spec.get_string_attribute("jpeg:ColorSpace")
    if any(name in stored for name in ("CMYK", "YCCK", "LAB", "separated")):
        raise ValueError(f"{path}: is {stored}; convert it to sRGB first")
    names = tuple(spec.channelnames)
    extra = names[1:] if len(names) < 3 else names[3:]
    if extra not in ((), ("A",)):
        raise ValueError(f"{path}: has channels {', '.join(names)}; expected grey or R, G, B, with optional alpha")


def _round_to_8_bits(pixels: np.ndarray, path: Path, linear: bool = False) -> np.ndarray:
    """Floating point in [0, 1] to the nearest 8-bit level, through the sRGB transfer where the values are linear."""
    low, high = float(pixels.min()), float(pixels.max())
    if not (low >= -_HALF_LEVEL and high <= 1 + _HALF_LEVEL):
        raise ValueError(f"{path}: has values from {low:.4g} to {high:.4g}, expected [0, 1]; scale or tone-map it")
    values = np.clip(pixels, 0, 1)
    if linear:
        values = encode_srgb(torch.from_numpy(values)).numpy()
    return np.rint(values * 255).astype(np.uint8)


def _reason(source: Any) -> str:
    """The first line of OpenImageIO's message, if there is one."""
    try:
        return "".join(source.geterror().strip().splitlines()[:1])
    except UnicodeDecodeError:  # it quotes the damaged file
        return "its header is damaged"


_ISO = ("Exif:PhotographicSensitivity", "Exif:ISOSpeedRatings")


def read_exposure(path: str | Path) -> float:
    """The exposure in stops, ``log2(t S / (100 N^2))`` of its EXIF's seconds t, ISO S and f-number N.

    One stop more is twice the RAW value; unlike the exposure value of ISO 2720 it grows with exposure.
    """
    source = _opened(Path(path))
    spec = source.spec()
    source.close()
    iso = next((value for name in _ISO if (value := spec.get_int_attribute(name, 0))), 0)
    stated = {
        "exposure time": spec.get_float_attribute("ExposureTime", 0.0),
        "f-number": spec.get_float_attribute("FNumber", 0.0),
        "ISO": float(iso),
    }
    if missing := [name for name, value in stated.items() if not 0 < value < math.inf]:
        raise ValueError(f"{path}: its EXIF has no {' or '.join(missing)}; give the exposures with --ev")
    seconds, f_number, speed = stated.values()
    return math.log2(seconds * speed / (100.0 * f_number**2))


_MODES = {"RGB": "RGB", "GRAY": "L"}


def to_srgb(pixels: np.ndarray, profile: bytes, path: Path) -> np.ndarray:
    """Pixels uint8 ``(H, W, 3)`` in the space of ``profile`` as sRGB; the same pixels where that is sRGB by name."""
    with extra("raw"):
        from PIL import Image, ImageCms

    try:
        mode, transform = _transform(profile)
    except (ImageCms.PyCMSError, OSError, KeyError) as error:
        raise ValueError(f"{path}: its ICC profile cannot be used ({error}); convert the picture to sRGB") from error
    if transform is None:
        return pixels
    stored = Image.fromarray(pixels if mode == "RGB" else np.ascontiguousarray(pixels[..., 0]), mode)
    return np.array(ImageCms.applyTransform(stored, transform))


@lru_cache(maxsize=8)
def _transform(profile: bytes) -> tuple[str, Any]:
    """The mode of the stored pixels, and the conversion; None for sRGB."""
    with extra("raw"):
        from PIL import ImageCms

    source = ImageCms.ImageCmsProfile(BytesIO(profile))
    mode = _MODES[source.profile.xcolor_space.strip()]
    if (source.profile.profile_description or "").startswith("sRGB"):
        return mode, None
    target = ImageCms.createProfile("sRGB")
    intent, flags = ImageCms.Intent.RELATIVE_COLORIMETRIC, ImageCms.Flags.BLACKPOINTCOMPENSATION
    return mode, ImageCms.buildTransform(source, target, mode, "RGB", intent, flags)


def recode_jpeg(srgb: Tensor, quality: int, chroma: str = "4:2:2") -> Tensor:
    """sRGB ``(3, H, W)`` uint8, encoded at ``quality`` (1 to 100) and decoded again; ``chroma`` is its subsampling."""
    with extra("raw"):
        from PIL import Image

    stored = BytesIO()
    picture = Image.fromarray(srgb.permute(1, 2, 0).contiguous().numpy())
    picture.save(stored, "JPEG", quality=quality, subsampling=chroma)
    return torch.from_numpy(np.array(Image.open(stored))).permute(2, 0, 1).contiguous()


# -- files of pictures to denoise, with all that they say of them ------------------------------------------------------

QUALITY = 97
"""Of a JPEG that is written, with chroma at full size."""
PICTURE_FORMATS = (".jpg", ".jpeg", ".png", ".tif", ".tiff")
"""Extensions of the files that are read and written here."""


class StoredPicture(NamedTuple):
    """A picture as its file has it.

    Args:
        srgb: float32 ``(3, H, W)`` in [0, 1], display values, not turned upright; grey has three equal channels.
        channels: of the file, 1 to 4.
        spec: OpenImageIO's description of the file, with its metadata.
        alpha: uint8 or uint16 ``(H, W, 1)``, where there is transparency.
    """

    srgb: Tensor
    channels: int
    spec: Any
    alpha: np.ndarray | None


def read_stored(path: str | Path, max_pixels: int = MAX_PIXELS) -> StoredPicture:
    """A picture of 8 or 16 bits.

    Raises:
        FileNotFoundError: if there is no such file.
        OSError: if it is not a picture, or is truncated.
        ValueError: if it is larger than ``max_pixels``, animated, CMYK or CIELAB, or holds floating-point numbers.
    """
    path = Path(path)

    def kind(spec: Any) -> Any:
        _require_srgb(spec, path)
        if str(spec.format) not in ("uint8", "uint16"):
            raise ValueError(f"{path}: holds {spec.format} numbers; a picture to denoise has 8 or 16 bits")
        return spec.format

    pixels, spec = decode_file(path, max_pixels, kind)
    channels = pixels.shape[-1]
    alpha = pixels[..., -1:] if channels in (2, 4) else None
    colours = pixels[..., :3] if channels > 2 else np.repeat(pixels[..., :1], 3, axis=-1)
    scale = np.float32(1.0 / np.iinfo(pixels.dtype).max)
    srgb = torch.from_numpy(np.ascontiguousarray(colours.transpose(2, 0, 1)).astype(np.float32) * scale)
    return StoredPicture(srgb, channels, spec, alpha)


def write_stored(path: str | Path, srgb: Tensor, like: StoredPicture) -> None:
    """Write sRGB ``(3, H, W)`` in [0, 1] with the channels, bits and metadata of ``like``, whole or not at all.

    Raises:
        ValueError: if the extension is none of :data:`PICTURE_FORMATS`.
        OSError: if the file cannot be written.
    """
    path = Path(path)
    if path.suffix.lower() not in PICTURE_FORMATS:
        raise ValueError(f"{path}: cannot be written; use one of {', '.join(PICTURE_FORMATS)}")
    jpeg = path.suffix.lower() in (".jpg", ".jpeg")
    stored = np.dtype(np.uint8) if jpeg else np.dtype(str(like.spec.format))
    most = np.iinfo(stored).max
    colours = srgb if like.channels > 2 else srgb.mean(0, keepdim=True)
    pixels = (colours.clamp(0.0, 1.0) * most).round().permute(1, 2, 0).numpy().astype(stored)
    if like.alpha is not None and not jpeg:
        pixels = np.concatenate([pixels, like.alpha], axis=-1)
    spec = _oiio().ImageSpec(like.spec)
    spec.set_format(str(stored))
    spec.nchannels, spec.channelnames = pixels.shape[-1], list(like.spec.channelnames)[: pixels.shape[-1]]
    if jpeg:
        spec.attribute("Compression", f"jpeg:{QUALITY}")
        spec.attribute("jpeg:subsampling", "4:4:4")
    with replacing(path) as partial:
        output = _oiio().ImageOutput.create(str(path))
        written = output.open(str(partial), spec) and output.write_image(np.ascontiguousarray(pixels))
        _require_written(output, written, path)
