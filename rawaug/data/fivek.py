"""MIT-Adobe FiveK: DNGs of the Canon EOS 5D and the Nikon D700, split as for InvISP.

Each DNG is developed by LibRaw with the camera's white balance and without automatic brightness (see
:func:`rawaug.io.read_raw_and_develop`), as the sRGB of the pair. ``fivek.json`` beside this file lists the numbers of
the splits: 650 and 127 frames of the Canon, 414 and 73 of the Nikon. InvISP's pictures (``invisp_canon:``,
``invisp_nikon:``) differ: LibRaw scales each frame by its own maximum (``adjust_maximum_thr`` 0.75, its default), and
they are stored as JPEGs of quality 90.

Source: V. Bychkovsky, S. Paris, E. Chan, F. Durand, "Learning photographic global tonal adjustment with a database of
input/output image pairs", CVPR 2011; Y. Xing, Z. Qian, Q. Chen, "Invertible image signal processing", CVPR 2021.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Sequence
from functools import cache, partial
from importlib import resources
from pathlib import Path

from rawaug.data.raw_folder import RawFolder
from rawaug.registry import DATASETS

CAMERAS = ("canon", "nikon")
_DNG = re.compile(r"a(\d{4})-.*\.dng", re.IGNORECASE)


@DATASETS.register("fivek")
def fivek_pairs(
    path: str | Path,
    split: str,
    cameras: Sequence[str] = CAMERAS,
    adjust_maximum_thr: float = 0.0,
    jpeg_quality: int | None = None,
) -> RawFolder:
    """The pairs of a split, Canon before Nikon, each sorted by number.

    Args:
        path: contains the DNGs under their published names, ``a0016-jmac_MG_0795.dng``, at any depth.
        split: ``"train"`` or ``"test"``.
        cameras: some of :data:`CAMERAS`.
        adjust_maximum_thr: LibRaw's scaling by the frame's own maximum.
        jpeg_quality: the pictures as JPEGs of this quality give them back; None leaves them as they are.

    Raises:
        FileNotFoundError: if there is no such folder, or one of the split's DNGs is missing.
        ValueError: if there is no such split or camera.
    """
    path = Path(path)
    if not path.is_dir():
        raise FileNotFoundError(f"{path}: no such folder of FiveK")
    wanted = [number for camera in cameras for number in fivek_numbers(camera, split)]
    files = {
        found[1]: Path(parent, file)
        for parent, _, names in os.walk(path)
        for file in names
        if (found := _DNG.fullmatch(file))
    }
    missing = [number for number in wanted if number not in files]
    if missing:
        raise FileNotFoundError(
            f"{path}: {len(missing)} of the {len(wanted)} DNGs of fivek {'+'.join(cameras)}, {split}, are missing, "
            f"first a{missing[0]}-*.dng"
        )
    chosen = [files[number] for number in wanted]
    return RawFolder(chosen, camera_jpeg=False, adjust_maximum_thr=adjust_maximum_thr, jpeg_quality=jpeg_quality)


_as_invisp = partial(fivek_pairs, adjust_maximum_thr=0.75, jpeg_quality=90)
"""As its published script makes the pictures."""

for _camera in CAMERAS:
    DATASETS.register(f"fivek_{_camera}")(partial(fivek_pairs, cameras=[_camera]))
    DATASETS.register(f"invisp_{_camera}")(partial(_as_invisp, cameras=[_camera]))


def fivek_numbers(camera: str, split: str) -> list[str]:
    """The numbers, four digits, of the DNGs of a split.

    Raises:
        ValueError: if there is no such camera or split.

    Example:
        >>> fivek_numbers("nikon", "test")[:3]
        ['0002', '0088', '0208']
    """
    splits = _splits()
    if camera not in CAMERAS:
        raise ValueError(f"fivek: no camera {camera}; use one of {', '.join(CAMERAS)}")
    if split not in splits[camera]:
        raise ValueError(f"fivek: no split {split}; use one of InvISP's: {', '.join(splits[camera])}")
    return splits[camera][split].split()


@cache
def _splits() -> dict[str, dict[str, str]]:
    content: dict[str, dict[str, str]] = json.loads(
        resources.files("rawaug.data").joinpath("fivek.json").read_text(encoding="utf-8")
    )
    return content
