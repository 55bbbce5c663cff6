r"""The colour space of a picture's numbers, and conversion to sRGB.

A file states its space by an ICC profile, or by chromaticities and a transfer function: by the numbers of ITU-T H.273
(cICP of PNG, nclx of HEIF), by gAMA and cHRM (PNG), by EXIF (Adobe RGB, as cameras write it), or by chromaticities
alone (OpenEXR). Each reader fills a :class:`Colour` in the order of its standard; :func:`to_srgb` converts, or refuses.

LittleCMS converts, relative colorimetric with black point compensation; of chromaticities and a transfer function a
profile is made. Pillow converts 8 bits in 8 bits, which is fast. 16 bits and floating point are converted in floating
point, since 8 bits of a linear profile are too coarse in the shadows, and are rounded once, afterwards.

Source: ICC.1:2022; ITU-T H.273; PNG 3, 11.3.2 (cICP, iCCP, sRGB, gAMA and cHRM, in this order); DCF 2.0 and Exif 2.32
(InteroperabilityIndex R03); Adobe RGB (1998).
"""

from __future__ import annotations

import re
import struct
from collections.abc import Sequence
from functools import lru_cache
from io import BytesIO
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rawaug.errors import extra

_MODES = {"RGB": "RGB", "GRAY": "L"}
_DATE = slice(24, 36)
"""Place of a profile's date in its header."""

Chromaticities = tuple[float, float, float, float, float, float, float, float]
"""x and y of red, green, blue and white."""

_D65, _C, _DCI, _E = (0.3127, 0.3290), (0.310, 0.316), (0.314, 0.351), (1 / 3, 1 / 3)
SRGB: Chromaticities = (0.640, 0.330, 0.300, 0.600, 0.150, 0.060, *_D65)
_ADOBE: Chromaticities = (0.640, 0.330, 0.210, 0.710, 0.150, 0.060, *_D65)
_PRIMARIES: dict[int, Chromaticities] = {
    1: SRGB,
    2: SRGB,
    4: (0.670, 0.330, 0.210, 0.710, 0.140, 0.080, *_C),
    5: (0.640, 0.330, 0.290, 0.600, 0.150, 0.060, *_D65),
    6: (0.630, 0.340, 0.310, 0.595, 0.155, 0.070, *_D65),
    7: (0.630, 0.340, 0.310, 0.595, 0.155, 0.070, *_D65),
    8: (0.681, 0.319, 0.243, 0.692, 0.145, 0.049, *_C),
    9: (0.708, 0.292, 0.170, 0.797, 0.131, 0.046, *_D65),
    10: (1.0, 0.0, 0.0, 1.0, 0.0, 0.0, *_E),
    11: (0.680, 0.320, 0.265, 0.690, 0.150, 0.060, *_DCI),
    12: (0.680, 0.320, 0.265, 0.690, 0.150, 0.060, *_D65),
    22: (0.630, 0.340, 0.295, 0.605, 0.155, 0.077, *_D65),
}
"""Chromaticities by the numbers of H.273: BT.709, unspecified, BT.470 M and B/G, SMPTE 170M and 240M, film, BT.2020,
XYZ, P3 of cinemas and of displays, EBU 3213."""
_TRANSFERS: dict[int, str | float] = {4: 2.2, 5: 2.8, 8: 1.0, 16: "PQ", 17: 2.6, 18: "HLG"}
"""Transfer functions by the numbers of H.273: names, or exponents."""
_LIKE_SRGB = (1, 2, 6, 7, 13, 14, 15)
"""These transfer functions are taken for that of sRGB, as on phones and in browsers."""

_ADOBE_EXPONENT = 563 / 256
_NEAR = 0.01
"""Chromaticities, and exponents in parts of theirs, that differ by less count as those of sRGB, as in libpng."""
_SRGB_EXPONENT = 2.2
_HDR_PROFILE = re.compile(r"2100|2084|\bPQ\b|HLG")
_HDR_TRANSFERS = {16: "PQ", 18: "HLG"}


class Colour(NamedTuple):
    """The space of a picture's numbers.

    Args:
        profile: the ICC profile; without one, the other two count.
        chromaticities: x and y of red, green, blue and white.
        transfer: "sRGB", "PQ", "HLG", or the exponent that takes numbers to light; 1 is linear light.
    """

    profile: bytes | None = None
    chromaticities: Chromaticities = SRGB
    transfer: str | float = "sRGB"

    @property
    def is_srgb(self) -> bool:
        """Whether nothing has to be converted."""
        return self == Colour()

    @property
    def is_linear(self) -> bool:
        """Whether the numbers are light itself, by sRGB's primaries or others."""
        return self.profile is None and self.transfer == 1.0

    def icc(self) -> bytes | None:
        """The profile of the file, or one that is made; None for sRGB."""
        if self.profile is not None or self.is_srgb:
            return self.profile
        return _make_profile(self.chromaticities, float(self.transfer) if self.transfer != "sRGB" else None)


SRGB_COLOUR = Colour()
ADOBE_RGB = Colour(None, _ADOBE, _ADOBE_EXPONENT)


def colour_from_code_points(primaries: int, transfer: int) -> Colour:
    """Find the space that numbers of H.273 name; raise ValueError for numbers that are unknown."""
    if primaries not in _PRIMARIES:
        raise ValueError(f"its colour primaries (H.273, {primaries}) are unknown")
    if transfer in _LIKE_SRGB:
        return Colour(None, _PRIMARIES[primaries])
    if transfer not in _TRANSFERS:
        raise ValueError(f"its transfer function (H.273, {transfer}) is unknown")
    return Colour(None, _PRIMARIES[primaries], _TRANSFERS[transfer])


def colour_from_chromaticities(chromaticities: Sequence[float] | None, exponent: float | None) -> Colour:
    """Make the space of chromaticities and an exponent, of which any may be unknown; nonsense counts as unknown."""
    corners = SRGB
    if chromaticities is not None and len(chromaticities) == 8 and _are_a_triangle(chromaticities):
        red_x, red_y, green_x, green_y, blue_x, blue_y, white_x, white_y = map(float, chromaticities)
        corners = (red_x, red_y, green_x, green_y, blue_x, blue_y, white_x, white_y)
    if max(abs(a - b) for a, b in zip(corners, SRGB, strict=True)) <= _NEAR:
        corners = SRGB

    transfer: str | float = "sRGB"
    if exponent is not None and 0.1 < exponent < 10 and abs(exponent / _SRGB_EXPONENT - 1) > _NEAR:
        transfer = exponent
    return Colour(None, corners, transfer)


def _are_a_triangle(chromaticities: Sequence[float]) -> bool:
    """Tell whether red, green and blue are no line and white is within them."""
    red, green, blue, white = (chromaticities[k : k + 2] for k in (0, 2, 4, 6))
    if not np.isfinite(chromaticities).all() or white[1] <= 0:
        return False
    corners = np.array([(*corner, 1.0) for corner in (red, green, blue)]).T
    if abs(np.linalg.det(corners)) < 1e-4:
        return False
    return bool((np.linalg.solve(corners, [*white, 1.0]) > 0).all())


def require_sdr(colour: Colour, path: Path) -> None:
    """Raise ValueError if a picture is HDR, which has to be tone-mapped first."""
    hdr: str | float | None = None
    if colour.profile is not None:
        hdr = _find_hdr_transfer(colour.profile)
    elif colour.transfer in _HDR_TRANSFERS.values():
        hdr = colour.transfer
    if hdr is not None:
        raise ValueError(f"{path}: is HDR ({hdr}); tone-map it, or export it as sRGB")


@lru_cache(maxsize=8)
def _find_hdr_transfer(profile: bytes) -> str | None:
    """Find the HDR transfer function that a profile states in its tag cicp, or else in its description."""
    from PIL import ImageCms

    count = int.from_bytes(profile[128:132], "big")
    for offset in range(132, min(132 + 12 * count, len(profile) - 11), 12):
        name, start, size = struct.unpack_from(">4sII", profile, offset)
        if name == b"cicp" and size >= 12 and start + 12 <= len(profile):
            return _HDR_TRANSFERS.get(profile[start + 9])

    try:
        description = ImageCms.ImageCmsProfile(BytesIO(profile)).profile.profile_description or ""
    except OSError:  # damaged, which the conversion will say
        return None
    match = _HDR_PROFILE.search(description)
    if match is None:
        return None
    return description


def to_srgb(pixels: np.ndarray, colour: Colour, path: Path) -> np.ndarray:
    """Convert pixels to sRGB; return the same pixels if they are sRGB.

    Args:
        pixels: ``(H, W, 3)``, uint8, uint16 or float32 in [0, 1]; grey has three equal channels.
        colour: their space.
        path: the file, for errors.

    Returns:
        uint8 for uint8; float32 in [0, 1] for others, unless nothing had to be done.

    Raises:
        ValueError: if the picture is HDR, or its profile is damaged or of another kind of space.
    """
    with extra("raw"):
        from PIL import ImageCms

    require_sdr(colour, path)
    profile = colour.icc()
    if profile is None:
        return pixels

    try:
        mode, transform = _transform(profile)
        if transform is None:
            return pixels
        if pixels.dtype == np.uint8:
            return _convert_8_bits(pixels, mode, transform)
        return _convert_fine(pixels, mode, profile)
    except (ImageCms.PyCMSError, OSError, KeyError, RuntimeError) as error:
        raise ValueError(f"{path}: its ICC profile cannot be used ({error}); convert the picture to sRGB") from error


def _convert_8_bits(pixels: np.ndarray, mode: str, transform: Any) -> np.ndarray:
    from PIL import Image, ImageCms

    channels = pixels if mode == "RGB" else pixels[..., 0]
    stored = Image.fromarray(np.ascontiguousarray(channels), mode)
    return np.array(ImageCms.applyTransform(stored, transform))


def _convert_fine(pixels: np.ndarray, mode: str, profile: bytes) -> np.ndarray:
    with extra("raw"):
        import imagecodecs

    channels, space = pixels, "rgb"
    if mode == "L":
        channels, space = pixels[..., 0], "gray"
    intent = imagecodecs.CMS.INTENT.RELATIVE_COLORIMETRIC
    flags = imagecodecs.CMS.FLAGS.BLACKPOINTCOMPENSATION
    converted = imagecodecs.cms_transform(
        np.ascontiguousarray(channels),
        profile,
        _srgb(),
        colorspace=space,
        outcolorspace="rgb",
        outdtype="float32",
        intent=int(intent),
        flags=int(flags),
    )
    return np.clip(converted, 0.0, 1.0)


@lru_cache(maxsize=1)
def _srgb() -> bytes:
    from PIL import ImageCms

    return ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()


@lru_cache(maxsize=8)
def _transform(profile: bytes) -> tuple[str, Any]:
    """Find the mode of the stored pixels, and the conversion of 8 bits, which is None for sRGB."""
    from PIL import ImageCms

    source = ImageCms.ImageCmsProfile(BytesIO(profile))
    mode = _MODES[source.profile.xcolor_space.strip()]
    if (source.profile.profile_description or "").startswith("sRGB"):
        return mode, None

    target = ImageCms.createProfile("sRGB")
    intent, flags = ImageCms.Intent.RELATIVE_COLORIMETRIC, ImageCms.Flags.BLACKPOINTCOMPENSATION
    return mode, ImageCms.buildTransform(source, target, mode, "RGB", intent, flags)


@lru_cache(maxsize=8)
def _make_profile(chromaticities: Chromaticities, exponent: float | None) -> bytes:
    """Make a profile of chromaticities and an exponent; None stands for the transfer function of sRGB."""
    with extra("raw"):
        import imagecodecs

    *primaries, x, y = chromaticities
    corners = [number for k in (0, 2, 4) for number in (*primaries[k : k + 2], 1.0)]
    curve: dict[str, Any] = {"gamma": exponent}
    if exponent is None:
        levels = np.linspace(0.0, 1.0, 4096)
        linear = np.where(levels <= 0.04045, levels / 12.92, ((levels + 0.055) / 1.055) ** 2.4)
        curve = {"transferfunction": np.rint(65535.0 * linear).astype("u2")}
    profile = bytearray(imagecodecs.cms_profile("rgb", whitepoint=(x, y, 1.0), primaries=corners, **curve))
    profile[_DATE] = struct.pack(">6H", 1998, 11, 1, 0, 0, 0)  # equal pictures become equal files, whatever the time
    return bytes(profile)
