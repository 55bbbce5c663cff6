"""Embedded ICC profiles: pictures of other colour spaces (Display P3, Adobe RGB, grey of another gamma) to sRGB.

The conversion is LittleCMS's, relative colorimetric with black point compensation, in 8 bits. Source of the format:
ICC.1:2022, "Image technology colour management".
"""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from rawaug.extras import extra

_MODES = {"RGB": "RGB", "GRAY": "L"}


def to_srgb(pixels: np.ndarray, profile: bytes, path: Path) -> np.ndarray:
    """Pixels uint8 ``(H, W, 3)`` in the space of ``profile`` as sRGB; the same pixels where that is sRGB by name.

    A grey profile takes the first channel.

    Raises:
        ValueError: if the profile is damaged, or is neither of RGB nor of grey.
    """
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
    from io import BytesIO

    with extra("raw"):
        from PIL import ImageCms

    source = ImageCms.ImageCmsProfile(BytesIO(profile))
    mode = _MODES[source.profile.xcolor_space.strip()]
    if (source.profile.profile_description or "").startswith("sRGB"):
        return mode, None
    target = ImageCms.createProfile("sRGB")
    intent, flags = ImageCms.Intent.RELATIVE_COLORIMETRIC, ImageCms.Flags.BLACKPOINTCOMPENSATION
    return mode, ImageCms.buildTransform(source, target, mode, "RGB", intent, flags)
