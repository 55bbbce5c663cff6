"""Reading of a shot as sRGB, and of its exposure, from camera RAW or from a developed picture.

RAW is developed by LibRaw with the camera's white balance (:func:`rawaug.io.develop`), which is the rendering that
:func:`rawaug.fit` learns from. The thumbnails in RAW files are never shown.
"""

from __future__ import annotations

import math
from pathlib import Path

from torch import Tensor

from rawaug.bayer import turn
from rawaug.io.content import is_raw
from rawaug.io.decoding import MAX_PIXELS
from rawaug.io.pictures import read_exposure, read_picture
from rawaug.io.raw import read_raw, read_raw_and_develop


def read_shot(path: str | Path, max_pixels: int = MAX_PIXELS) -> Tensor:
    """Read a picture, or develop RAW, as upright sRGB, uint8 ``(3, H, W)``.

    Args:
        path: a file of either kind, which is recognised by its content.
        max_pixels: a larger picture is refused before it is decoded.

    Raises:
        FileNotFoundError, OSError, ValueError: as :func:`rawaug.io.read_picture` and :func:`rawaug.io.read_raw` do.

    Example:
        >>> read_shot("IMG_0001.dng").dtype  # doctest: +SKIP
        torch.uint8
    """
    if not is_raw(path):
        return read_picture(path, max_pixels)
    frame, srgb = read_raw_and_develop(path)
    return turn(srgb, frame.upright_view).contiguous()


def read_shot_exposure(path: str | Path) -> float:
    """Read the exposure in stops, ``log2(t S / (100 N^2))``, of seconds t, ISO S and f-number N.

    One stop more is twice the RAW value; unlike the exposure value of ISO 2720, it grows with exposure.

    Raises:
        FileNotFoundError, OSError: if the file is missing or damaged.
        ValueError: if it does not state one of the three.
    """
    path = Path(path)
    if is_raw(path):
        frame = read_raw(path)
        exposure = {
            "exposure time": frame.exposure.seconds or 0.0,
            "f-number": frame.exposure.f_number or 0.0,
            "ISO": frame.iso or 0.0,
        }
    else:
        exposure = read_exposure(path)

    missing = [name for name, value in exposure.items() if not 0 < value < math.inf]
    if missing:
        raise ValueError(f"{path}: does not state its {' or '.join(missing)}; give the exposures as ev=")
    seconds, f_number, speed = exposure.values()
    return math.log2(seconds * speed / (100.0 * f_number**2))
