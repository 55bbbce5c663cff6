"""``rawaug hdr``: sRGB exposures of a scene to RAW, merged or scaled there, and back to one sRGB picture.

RAW files are developed by LibRaw first, each with its own white balance. :func:`rawaug.fit` learns to reverse this, so
``--isp`` is best a camera that was fitted to such files. The formulas are in :mod:`rawaug.isp.exposures`. Source: the
HDR application of Conde et al., AAAI 2022.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

from torch import Tensor

from rawaug.commands import YAML
from rawaug.files import require_writable
from rawaug.io import write_picture
from rawaug.io.content import content_of
from rawaug.io.isolated import isolated
from rawaug.io.shots import read_shot, read_shot_exposure
from rawaug.isp.exposures import merge_exposures, render_exposure
from rawaug.isp.model import DictionaryISP
from rawaug.registry import require_between

MOST_STOPS = 30.0
"""The exposure can be at most this many stops."""


def run(
    pictures: list[str],
    /,
    *,
    out: str,
    ev: Annotated[list[float] | None, YAML] = None,
    exposure: float = 0.0,
    isp: str = "universal",
    overwrite: bool = False,
) -> None:
    """Merge exposures of a scene in RAW, or change the exposure of a single picture.

    Args:
        pictures: sRGB pictures of one scene, aligned and of one size, or its RAW files, which LibRaw develops; or a
            single one.
        out: the picture to write, 8-bit sRGB.
        ev: exposure of each picture in stops, as [-2,0,2]; by default from EXIF, relative to the median exposure.
        exposure: exposure of the result in stops, relative to the picture at 0 EV.
        isp: ISP file of the camera, or the name of a shipped ISP.
        overwrite: replace the output file if it exists.
    """
    target = Path(out)
    require_writable(target)
    if target.exists() and not overwrite:
        raise FileExistsError(f"{out}: exists; choose another name, or add --overwrite")

    srgb = hdr(pictures, ev, exposure, isp)
    target.parent.mkdir(parents=True, exist_ok=True)
    write_picture(target, srgb)
    print(out)


def hdr(
    pictures: Sequence[str | Path],
    ev: Sequence[float] | None = None,
    exposure: float = 0.0,
    isp: str | Path = "universal",
) -> Tensor:
    """Return the merged picture ``(3, H, W)`` in [0, 1]; arguments and errors are as in :func:`run`."""
    if not pictures:
        raise ValueError("hdr: no picture is given")
    _require_one_kind(pictures)

    stops = exposures(pictures, ev)
    for value in (*stops, exposure):
        require_between("an exposure", value, -MOST_STOPS, MOST_STOPS)

    camera = DictionaryISP.from_pretrained(isp)
    merged = merge_exposures(camera, [srgb[None] for srgb in _read(pictures)], stops)
    return render_exposure(camera, merged.image, merged.params, exposure)[0]


def exposures(pictures: Sequence[str | Path], ev: Sequence[float] | None) -> list[float]:
    """Return the stops of each picture: as given, else from EXIF relative to the median; a single picture has 0."""
    if ev is not None and len(ev) != len(pictures):
        raise ValueError(f"--ev: one exposure for each picture is needed, got {len(ev)} for {len(pictures)}")
    if ev is not None:
        return list(ev)
    if len(pictures) == 1:
        return [0.0]

    absolute = [isolated(read_shot_exposure, path) for path in pictures]
    median = sorted(absolute)[(len(absolute) - 1) // 2]
    return [stops - median for stops in absolute]


def _read(paths: Sequence[str | Path]) -> list[Tensor]:
    """Read the pictures, which must have one size."""
    pictures = [isolated(read_shot, path) for path in paths]
    height, width = pictures[0].shape[1:]
    for path, picture in zip(paths, pictures, strict=True):
        if picture.shape[1:] != (height, width):
            size = f"{picture.shape[1]} x {picture.shape[2]}"
            raise ValueError(f"{path}: is {size}, but {paths[0]} is {height} x {width}; align and crop them")
    return pictures


def _require_one_kind(paths: Sequence[str | Path]) -> None:
    """Raise ValueError for RAW beside developed pictures, whose tone curves and white balance differ."""
    first = content_of(paths[0])
    for path in paths:
        content = content_of(path)
        if (content.kind == "raw") != (first.kind == "raw"):
            kinds = f"{content.format}, but {paths[0]} is {first.format}"
            raise ValueError(f"{path}: is {kinds}; give RAW files or developed pictures, not both")
