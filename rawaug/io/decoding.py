"""Decoding of pictures to the numbers that their files hold, by the decoder that reads each format correctly.

OpenImageIO reads most formats. Four kinds go to other libraries. BMP goes to Pillow, since OpenImageIO mixes up its run
lengths and bit fields. So does a JPEG with a gain map ("Ultra HDR", as Android phones write it), which OpenImageIO
renders in linear light; Pillow gives the picture that every viewer shows. HEIC and AVIF, which it does not know, go to
libheif and Pillow. Kinds of TIFF that it decodes to something else go to tifffile (:mod:`rawaug.io.tiff_pictures`).

Everything else in a header is read here too, byte for byte, since OpenImageIO takes the orientation from XMP even if
EXIF says otherwise, and does not see an EXIF chunk after the pixels of a PNG.
"""

from __future__ import annotations

import os
import tempfile
import warnings
from collections.abc import Callable
from io import BytesIO
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rawaug.errors import extra, how_to_install
from rawaug.files import require_file
from rawaug.io.bitmaps import is_rle4, unpack_rle4
from rawaug.io.colour import Colour, colour_from_chromaticities, require_sdr
from rawaug.io.content import identify_opened, reads_avif, reads_heic
from rawaug.io.headers import ICC_TAG, Headers, headers_of_opened, mend_jpeg_header, png_fault
from rawaug.io.isolated import damage_as_os_error
from rawaug.io.plain import FLOATS, choose_number_type, require_grey_or_rgb, require_plain
from rawaug.io.tiff_pictures import TiffKind, choose_tiff_reader, decode_tiff_codes, read_tiff_kind

MAX_PIXELS = 2**26
"""A picture has at most this many pixels by default: 8192 x 8192."""

MAX_CHANNELS = 4

_LINEAR_FORMATS = ("OpenEXR", "Radiance")
_WITH_ASSOCIATED_ALPHA = ("TIFF", "OpenEXR")
"""In these formats, colours may already be multiplied by alpha."""
_UPRIGHT = ("JPEG XL", "HEIC", "JPEG 2000")
"""Decoders of these formats turn pictures upright, whatever EXIF says."""
_END_OF_JPEG = b"\xff\xd9"


class Decoded(NamedTuple):
    """The first picture of a file.

    Args:
        colours: ``(H, W, 1)`` or ``(H, W, 3)`` of uint8, uint16 or float32, as stored: neither turned nor converted.
        alpha: ``(H, W, 1)`` of the same type, if there is transparency.
        associated: whether ``colours`` are already multiplied by alpha.
        format: of the content, such as ``"JPEG"``.
        colour: the space of the colours.
        orientation: of EXIF, 1 to 8.
        headers: EXIF and other metadata as bytes.
    """

    colours: np.ndarray
    alpha: np.ndarray | None
    associated: bool
    format: str
    colour: Colour
    orientation: int
    headers: Headers


class _Refused(ValueError):
    """A file that is whole but not accepted."""


def decode(path: Path, max_pixels: int = MAX_PIXELS, coarse: bool = False) -> Decoded:
    """Decode the numbers of a picture file.

    Args:
        path: the file.
        max_pixels: larger pictures are refused before anything is decoded.
        coarse: 16 bits may be returned as 8, by rounding, if no profile or alpha has to be applied first.

    Raises:
        FileNotFoundError: if there is no such file.
        OSError: if the file is not a picture, or is truncated.
        ValueError: if its header declares more than ``max_pixels``, it is camera RAW or animated, or its colours are
            neither grey nor RGB, or HDR.
    """
    require_file(path, "picture file")
    require_utf8(path)
    with path.open("rb") as file:
        content = identify_opened(file, path)
        headers = headers_of_opened(file, content.format)
    if content.kind == "raw":
        raise ValueError(f"{path}: is camera RAW ({content.format}), not a developed picture; develop it first")
    if headers.animated:
        raise ValueError(f"{path}: is an animation; save a single frame")
    if headers.unread:
        raise ValueError(f"{path}: {headers.unread}; convert it to sRGB")
    if headers.colour is not None:
        require_sdr(headers.colour, path)

    decoded = _decode(path, content.format, max_pixels, coarse, headers)
    require_sdr(decoded.colour, path)
    return decoded


def _decode(path: Path, name: str, max_pixels: int, coarse: bool, headers: Headers) -> Decoded:
    """Decode by the library that reads a format correctly."""
    if name == "PNG":
        fault = png_fault(path)
        if fault is not None:
            raise OSError(f"{path}: cannot be read as a picture (PNG: {fault}); copy it again")
    if name == "HEIC":
        return _decode_heic(path, max_pixels, headers)
    if name == "AVIF":
        return _decode_avif(path, max_pixels, headers)
    if name == "BMP":
        return _decode_with_pillow(path, "BMP", max_pixels, headers)
    if name == "TIFF":
        with path.open("rb") as file:
            kind = read_tiff_kind(file)
        if kind is not None and choose_tiff_reader(kind, path) == "tifffile":
            return _decode_with_tifffile(path, max_pixels, headers, kind)
    if name == "JPEG":
        return _decode_jpeg(path, max_pixels, coarse, headers)
    require_plain(path, name)
    return _decode_with_oiio(path, name, max_pixels, coarse, headers)


_HARMLESS = ("unknown JFIF revision", "extraneous bytes before marker")
"""libjpeg warns of these, OpenImageIO takes the warnings for errors, and every viewer shows the picture."""


def _decode_jpeg(path: Path, max_pixels: int, coarse: bool, headers: Headers) -> Decoded:
    """Decode a JPEG, whose header is written anew if only that is odd, so that damage of its pixels is still told."""
    try:
        return _decode_with_oiio(path, "JPEG", max_pixels, coarse, headers)
    except OSError as error:
        if not any(warning in str(error) for warning in _HARMLESS):
            raise

    with tempfile.TemporaryDirectory() as folder:
        mended = Path(folder) / "mended.jpg"
        mended.write_bytes(mend_jpeg_header(path))
        try:
            return _decode_with_oiio(mended, "JPEG", max_pixels, coarse, headers)
        except OSError as error:
            raise OSError(str(error).replace(str(mended), str(path))) from None


def require_utf8(path: Path) -> None:
    """Raise OSError if the name is not UTF-8, which the libraries need."""
    try:
        str(path).encode()
    except UnicodeEncodeError:  # Python represents bytes that are not UTF-8 by characters that UTF-8 cannot encode
        raise OSError(f"{os.fsencode(path)!r}: cannot be opened because its name is not UTF-8; rename it") from None


def require_size(path: Path, height: int, width: int, channels: int, max_pixels: int) -> None:
    """Raise ValueError if the declared size is above the limit, before anything is decoded."""
    pixels = height * width
    if pixels <= max_pixels and pixels * channels <= MAX_CHANNELS * max_pixels:
        return
    size = f"{height} x {width} pixels"
    if pixels <= max_pixels:
        size += f" of {channels} channels"
    raise _Refused(f"{path}: declares {size}, above the limit of {max_pixels}; split it, or raise max_pixels")


# -- OpenImageIO -------------------------------------------------------------------------------------------------------


def open_image(path: Path, may_have_alpha: bool = True) -> Any:
    """Open OpenImageIO's reader of a file, which does not multiply colours by their alpha."""
    oiio = load_oiio()
    if may_have_alpha:
        config = oiio.ImageSpec()
        config.attribute("oiio:UnassociatedAlpha", 1)
        source = oiio.ImageInput.open(str(path), config)
    else:
        source = oiio.ImageInput.open(str(path))
    if source is None:
        raise OSError(f"{path}: cannot be read as a picture (OpenImageIO: {reason(oiio) or 'no reason given'})")
    return source


def load_oiio() -> Any:
    """Import OpenImageIO, which is not done before a picture is read or written."""
    with extra("raw"):
        import OpenImageIO

    return OpenImageIO


def reason(source: Any) -> str:
    """Return the first line of OpenImageIO's message, if there is one."""
    try:
        lines = source.geterror().strip().splitlines()
    except UnicodeDecodeError:  # the message quotes the damaged file
        return "its header is damaged"
    if not lines:
        return ""
    return lines[0]


def _decode_with_oiio(path: Path, name: str, max_pixels: int, coarse: bool, headers: Headers) -> Decoded:
    source = open_image(path, name != "JPEG")
    spec = source.spec()
    require_size(path, spec.height * spec.depth, spec.width, spec.nchannels, max_pixels)
    stored = str(spec.format)
    if name == "JPEG" and stored in FLOATS:
        source.close()
        return _decode_with_pillow(path, "JPEG", max_pixels, headers)

    has_alpha = require_grey_or_rgb(spec, path)
    colour = _find_colour(spec, name, headers)
    kind = choose_number_type(stored, path)
    if coarse and kind == "uint16" and colour.is_srgb and not has_alpha:
        kind = "uint8"

    try:
        pixels = source.read_image(kind)
    except UnicodeDecodeError as error:  # from OpenImageIO's binding, for texts in the header
        raise OSError(f"{path}: cannot be read as a picture (its header is damaged: {error}); copy it again") from error
    fault = reason(source)  # also set if a decoder padded a truncated file
    moves = name != "JPEG" and _moves(source, spec)
    source.close()
    if moves:
        raise ValueError(f"{path}: is an animation; save a single frame")
    if pixels is None or fault:
        raise OSError(f"{path}: cannot be read as a picture (OpenImageIO: {fault or 'no reason given'})")

    associated = name in _WITH_ASSOCIATED_ALPHA and not spec.get_int_attribute("oiio:UnassociatedAlpha")
    orientation = headers.orientation
    if orientation is None:
        orientation = spec.get_int_attribute("Orientation", 1)
    if name in _UPRIGHT:
        orientation = 1
    colours, alpha = _split_alpha(pixels, has_alpha)
    return Decoded(
        colours=colours,
        alpha=alpha,
        associated=associated,
        format=name,
        colour=colour,
        orientation=orientation,
        headers=headers,
    )


def _find_colour(spec: Any, name: str, headers: Headers) -> Colour:
    """Find the space: what the header states before a profile, the profile, or linear light with its chromaticities."""
    if headers.colour is not None:
        return headers.colour
    profile = spec.getattribute("ICCProfile")
    if profile is not None:
        return Colour(bytes(profile))
    if name not in _LINEAR_FORMATS:
        return Colour()

    chromaticities = spec.getattribute("chromaticities")
    return colour_from_chromaticities(chromaticities, 1.0)


def decode_part(
    path: Path, choose: Callable[[int, int], tuple[int, int, int, int]], max_pixels: int = MAX_PIXELS
) -> np.ndarray | None:
    """Decode a JPEG no further than the last row of a part, to the numbers that :func:`decode` gives.

    Args:
        path: the file.
        choose: a function from the height and width of the picture to the top, left, rows and columns of the part.
        max_pixels: larger pictures are refused before anything is decoded.

    Returns:
        The part ``(rows, columns, 3)``, uint8. None if the file is no upright sRGB JPEG of 8 bits, these rows or those
        above are damaged, or it does not end as a JPEG does (so a truncated one is found out whichever part is read):
        then :func:`decode` decides.
    """
    require_utf8(path)
    with path.open("rb") as file:
        if identify_opened(file, path).format != "JPEG":
            return None
        headers = headers_of_opened(file, "JPEG")
        file.seek(-len(_END_OF_JPEG), os.SEEK_END)
        if file.read() != _END_OF_JPEG or headers.animated or headers.unread:
            return None

    oiio = load_oiio()
    source = oiio.ImageInput.open(str(path))
    if source is None:
        return None
    spec = source.spec()
    is_plain = str(spec.format) == "uint8" and spec.nchannels == 3 and _find_colour(spec, "JPEG", headers).is_srgb
    is_upright = (headers.orientation or spec.get_int_attribute("Orientation", 1)) == 1
    if not is_plain or not is_upright or spec.height * spec.width > max_pixels:
        source.close()
        return None

    top, left, rows, columns = choose(spec.height, spec.width)
    pixels = source.read_scanlines(top, top + rows, 0, 0, 3, oiio.UINT8)
    fault = reason(source)
    source.close()
    if pixels is None or fault:
        return None
    return np.asarray(pixels).reshape(rows, spec.width, 3)[:, left : left + columns]


def _split_alpha(pixels: np.ndarray, has_alpha: bool) -> tuple[np.ndarray, np.ndarray | None]:
    """Split pixels whose last channel may be alpha into colours ``(H, W, C)`` and alpha ``(H, W, 1)``."""
    if not has_alpha:
        return pixels, None
    return pixels[..., :-1], pixels[..., -1:]


def _moves(source: Any, spec: Any) -> bool:
    """Tell whether there are several frames; a GIF is only marked as such if they have a duration."""
    if spec.get_int_attribute("oiio:Movie"):
        return True
    return source.format_name() == "gif" and bool(source.seek_subimage(1, 0))


# -- other decoders ----------------------------------------------------------------------------------------------------


def _decode_with_pillow(path: Path, name: str, max_pixels: int, headers: Headers) -> Decoded:
    """Decode the first picture of a BMP or JPEG with 8 bits."""
    with extra("raw"):
        from PIL import Image

    with _pillow_damage(path), Image.open(path, formats=(name,)) as image:
        require_size(path, image.height, image.width, len(image.getbands()), max_pixels)
        if name == "BMP" and is_rle4(path):
            image = Image.open(BytesIO(unpack_rle4(path)), formats=(name,))
        return _of_pillow(image, path, name, headers)


def _pillow_damage(path: Path) -> Any:
    """Turn Pillow's errors into an OSError that names the file, except ours."""
    return damage_as_os_error(path, "cannot be read as a picture", _Refused)


def _of_pillow(image: Any, path: Path, name: str, headers: Headers, orientation: int | None = None) -> Decoded:
    if image.mode in ("CMYK", "YCCK", "LAB"):
        raise _Refused(f"{path}: is {image.mode}; convert it to sRGB first")
    if "transparency" in image.info or image.mode == "PA":
        image = image.convert("RGBA")
    elif image.mode == "1":
        image = image.convert("L")
    elif image.mode not in ("L", "LA", "RGB", "RGBA"):
        image = image.convert("RGB")

    profile = image.info.get("icc_profile")
    pixels = np.array(image)
    if pixels.ndim == 2:
        pixels = pixels[..., None]
    colours, alpha = _split_alpha(pixels, image.mode in ("LA", "RGBA"))
    return Decoded(
        colours=colours,
        alpha=alpha,
        associated=False,
        format=name,
        colour=headers.colour or Colour(profile or None),
        orientation=orientation or headers.orientation or 1,
        headers=headers,
    )


def _decode_avif(path: Path, max_pixels: int, headers: Headers) -> Decoded:
    if not reads_avif():
        raise ValueError(f"{path}: is AVIF, and this Pillow does not read AVIF; {how_to_install('heif')}")
    with extra("heif"):
        from PIL import Image

    with _pillow_damage(path), Image.open(path, formats=("AVIF",)) as image:
        require_size(path, image.height, image.width, len(image.getbands()), max_pixels)
        if getattr(image, "n_frames", 1) > 1:
            raise _Refused(f"{path}: is an animation; save a single frame")
        # Pillow leaves the pixels as they are, and says how they are turned
        orientation = image.getexif().get(274, 1)
        return _of_pillow(image, path, "AVIF", headers._replace(exif=image.info.get("exif")), orientation)


def _decode_heic(path: Path, max_pixels: int, headers: Headers) -> Decoded:
    """Decode HEIC of 8, 10 or 12 bits. libheif turns it upright; 10 and 12 bits come as 16."""
    if not reads_heic():
        raise ValueError(f"{path}: is HEIC, and pillow_heif is not installed; {how_to_install('heif')}")
    with extra("heif"):
        import pillow_heif

    with _pillow_damage(path):
        image = pillow_heif.open_heif(path, convert_hdr_to_8bit=False)
        width, height = image.size
        if max_pixels < height * width:
            raise _Refused(f"{path}: declares {height} x {width} pixels, above the limit of {max_pixels}; split it")
        pixels = np.array(image)
        info, mode = image.info, image.mode

    if pixels.ndim == 2:
        pixels = pixels[..., None]
    colours, alpha = _split_alpha(pixels, pixels.shape[-1] in (2, 4))
    exif = info.get("exif") or None
    if exif is not None:
        exif = exif.removeprefix(b"Exif\0\0")
    return Decoded(
        colours=colours,
        alpha=alpha,
        associated="a" in mode,  # "RGBa" is multiplied by alpha, "RGBA" is not
        format="HEIC",
        colour=headers.colour or Colour(info.get("icc_profile") or None),
        orientation=1,
        headers=Headers(exif=exif, xmp=info.get("xmp") or None),
    )


def _decode_with_tifffile(path: Path, max_pixels: int, headers: Headers, kind: TiffKind) -> Decoded:
    with extra("raw"):
        import tifffile

    with _pillow_damage(path), warnings.catch_warnings(), tifffile.TiffFile(path) as tiff:
        page = tiff.pages[0]
        require_size(path, page.imagelength, page.imagewidth, page.samplesperpixel, max_pixels)
        codes = page.asarray()
        if kind.planes == 2:
            codes = np.moveaxis(codes, 0, -1)
        codes = codes.reshape(page.imagelength, page.imagewidth, -1)
        profile = page.tags.valueof(ICC_TAG)

    colours, alpha = _split_alpha(decode_tiff_codes(codes, kind), bool(kind.extra))
    colour = headers.colour or Colour(profile)
    return Decoded(colours, alpha, kind.extra == (1,), "TIFF", colour, headers.orientation or 1, headers)
