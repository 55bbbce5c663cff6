"""Exposure of a picture as its EXIF states it: ``EV = log2(t S / (100 N^2))``, with seconds t, ISO S and f-number N.

One stop more is twice the RAW value. Unlike the exposure value of ISO 2720 it grows with exposure.
"""

from __future__ import annotations

import math
from pathlib import Path

from rawaug.extras import extra
from rawaug.io.picture_files import require_utf8

_ISO = ("Exif:PhotographicSensitivity", "Exif:ISOSpeedRatings")


def read_exposure(path: str | Path) -> float:
    """The exposure in stops, up to a constant of the scene.

    Raises:
        FileNotFoundError, OSError: if there is no such file, or it is not a picture.
        ValueError: if its EXIF lacks exposure time, f-number or ISO.
    """
    with extra("raw"):
        import OpenImageIO as oiio

    if not Path(path).is_file():
        raise FileNotFoundError(f"{path}: no such picture file")
    require_utf8(Path(path))
    source = oiio.ImageInput.open(str(path))
    if source is None:
        raise OSError(f"{path}: cannot be read as a picture (OpenImageIO: {oiio.geterror().strip()})")
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
