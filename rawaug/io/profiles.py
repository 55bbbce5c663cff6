"""ICC profiles: conversion to sRGB by LittleCMS, relative colorimetric with black point compensation.

Pillow converts 8 bits in 8 bits, which is fast. 16 bits and floating point are converted in floating point, since 8
bits of a linear profile are too coarse in the shadows, and are rounded once, afterwards. HEIF files without a profile
name primaries and a transfer function by the numbers of ITU-T H.273 instead, from which a profile is made. Source:
ICC.1:2022.
"""

from __future__ import annotations

from functools import lru_cache
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from rawaug.errors import extra

_MODES = {"RGB": "RGB", "GRAY": "L"}
_D65 = (0.3127, 0.3290)
_PRIMARIES = {
    9: ((0.708, 0.292), (0.170, 0.797), (0.131, 0.046)),
    11: ((0.680, 0.320), (0.265, 0.690), (0.150, 0.060)),
    12: ((0.680, 0.320), (0.265, 0.690), (0.150, 0.060)),
}
"""The primaries of BT.2020 and of P3 have these chromaticities."""
_HDR_TRANSFERS = {16: "PQ", 18: "HLG"}


def to_srgb(pixels: np.ndarray, profile: bytes, path: Path) -> np.ndarray:
    """Convert pixels in the space of ``profile`` to sRGB; return the same pixels if it is sRGB by name.

    Args:
        pixels: ``(H, W, 3)``, uint8, uint16 or float32 in [0, 1]; grey has three equal channels.
        profile: the ICC profile of the file.
        path: the file, for errors.

    Returns:
        uint8 for uint8; float32 in [0, 1] for others, unless nothing had to be done.

    Raises:
        ValueError: if the profile is damaged, or of another kind of space.
    """
    with extra("raw"):
        from PIL import ImageCms

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


def profile_of_code_points(primaries: int, transfer: int, path: Path) -> bytes | None:
    """Make the profile of the primaries and transfer function that a HEIF file names; return None for sRGB's.

    All transfer functions of standard dynamic range are taken for that of sRGB, as on phones and in browsers.

    Raises:
        ValueError: if the picture is HDR, which has to be tone-mapped first.
    """
    if transfer in _HDR_TRANSFERS:
        raise ValueError(f"{path}: is HDR ({_HDR_TRANSFERS[transfer]}); tone-map it, or export it as sRGB")
    if primaries not in _PRIMARIES:
        return None

    with extra("raw"):
        import imagecodecs

    levels = np.linspace(0.0, 1.0, 4096)
    linear = np.where(levels <= 0.04045, levels / 12.92, ((levels + 0.055) / 1.055) ** 2.4)
    corners = [number for corner in _PRIMARIES[primaries] for number in (*corner, 1.0)]
    return bytes(
        imagecodecs.cms_profile(
            "rgb", whitepoint=(*_D65, 1.0), primaries=corners, transferfunction=np.rint(65535.0 * linear).astype("u2")
        )
    )
