"""``rawaug hdr``: sRGB exposures of a scene to RAW, merged or scaled there, and back to one sRGB picture.

RAW files are developed by LibRaw first, each with its own white balance. :func:`rawaug.fit` learns to reverse this, so
``--isp`` is best a camera that was fitted to such files. The formulas are in :mod:`rawaug.isp.exposures`. Source: the
HDR application of Conde et al., AAAI 2022.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import numpy as np
from torch import Tensor

from rawaug.commands import YAML
from rawaug.errors import count_of
from rawaug.files import require_output
from rawaug.io.content import identify_content
from rawaug.io.exif import mend_exif, read_exif
from rawaug.io.isolated import isolated
from rawaug.io.metadata import Metadata
from rawaug.io.pictures import decode_srgb, write_linear
from rawaug.io.shots import read_shot, read_shot_exposure
from rawaug.io.stored import PICTURE_FORMATS, StoredPicture, write_stored
from rawaug.isp.alignment import Motion, find_motion
from rawaug.isp.config import ISPResult
from rawaug.isp.exposures import confidence, linear_light, merge_exposures, reference_exposure, render_exposure
from rawaug.isp.functional import as_display_referred
from rawaug.isp.model import DictionaryISP
from rawaug.registry import require_between

MOST_STOPS = 30.0
"""Largest exposure in stops."""


def run(
    pictures: list[str],
    /,
    *,
    out: str,
    ev: Annotated[list[float] | None, YAML] = None,
    exposure: float = 0.0,
    isp: str = "universal",
    align: bool = True,
    overwrite: bool = False,
) -> None:
    """Merge exposures of a scene in RAW, or change the exposure of a single picture.

    Args:
        pictures: sRGB pictures of one scene and of one size, or its RAW files, which LibRaw develops; or a single one.
        out: the picture to write: sRGB, in 16 bits as .tif, else in 8; or linear light as .exr, not compressed. It has
            the EXIF of the picture nearest to 0 EV.
        ev: exposure of each picture in stops, as [-2,0,2]; by default from EXIF, relative to the median exposure.
        exposure: exposure of the result in stops, relative to the picture at 0 EV.
        isp: ISP file of the camera, or the name of a shipped ISP.
        align: bring pictures that were taken by hand to the one nearest to 0 EV, and leave out what moved in the scene.
        overwrite: replace the output file if it exists.
    """
    target = require_output(out, overwrite, (*PICTURE_FORMATS, ".exr"), pictures)

    stops = exposures(pictures, ev)
    merged, camera, lines = _merge(pictures, stops, exposure, isp, align)
    for line in lines:
        print(line)

    nearest = pictures[reference_exposure(stops)]
    if target.suffix.lower() == ".exr":
        light = linear_light(camera, merged.image * 2.0**exposure, merged.params)
        write_linear(target, light[0])
    else:
        _write(target, render_exposure(camera, merged.image, merged.params, exposure)[0], Path(nearest))
    print(out)


def hdr(
    pictures: Sequence[str | Path],
    ev: Sequence[float] | None = None,
    exposure: float = 0.0,
    isp: str | Path = "universal",
    align: bool = True,
) -> Tensor:
    """Return the merged picture ``(3, H, W)`` in [0, 1]; arguments and errors are as in :func:`run`."""
    merged, camera, _ = _merge(pictures, exposures(pictures, ev), exposure, isp, align)
    return render_exposure(camera, merged.image, merged.params, exposure)[0]


def _merge(
    paths: Sequence[str | Path], stops: Sequence[float], exposure: float, isp: str | Path, align: bool
) -> tuple[ISPResult, DictionaryISP, list[str]]:
    """Read and merge pictures; return RAW ``(1, 3, H, W)``, the camera, and a line about each that was aligned."""
    for value in (*stops, exposure):
        require_between("an exposure", value, -MOST_STOPS, MOST_STOPS)
    _require_one_kind(paths)

    camera = DictionaryISP.from_pretrained(isp)
    pictures = _read(paths)
    motions = None
    lines: list[str] = []
    if align and len(pictures) > 1:
        motions, lines = _find_motions(paths, pictures, stops)
    return merge_exposures(camera, [srgb[None] for srgb in pictures], stops, motions), camera, lines


def _find_motions(
    paths: Sequence[str | Path], pictures: Sequence[Tensor], stops: Sequence[float]
) -> tuple[list[Motion], list[str]]:
    """Find how each picture moved against the reference, and write a line about each."""
    nearest = reference_exposure(stops)
    lights, clear = [], []
    for picture, ev in zip(pictures, stops, strict=True):
        display = as_display_referred(picture[None])
        lights.append(decode_srgb(display[0, 1]) / 2.0**ev)
        clear.append(confidence(display)[0, 0])

    motions, lines = [], []
    for number, path in enumerate(paths):
        try:
            motion = find_motion(lights[nearest], lights[number], clear[nearest] * clear[number])
        except ValueError as error:
            raise ValueError(f"{path}: {error}; --align false merges it as it is") from None
        motions.append(motion)
        if number == nearest:
            continue

        if motion.tiles == 0:
            lines.append(f"{path}: has too little detail in common with {paths[nearest]} to be aligned; taken as it is")
            continue
        line = f"{path}: moved by {motion.pixels:.1f} pixels and aligned"
        if motion.astray:
            line += f"; {motion.astray} of {count_of(motion.tiles, 'part')} moved by themselves"
        lines.append(line)
    return motions, lines


def _write(target: Path, srgb: Tensor, source: Path) -> None:
    """Write sRGB ``(3, H, W)``, in 16 bits as TIFF, with the EXIF of ``source``."""
    content = identify_content(source)
    exif = read_exif(source, "TIFF" if content.kind == "raw" else content.format)
    if exif is not None:
        exif = mend_exif(exif, None, upright=True)

    bits = np.uint16 if target.suffix.lower() in (".tif", ".tiff") else np.uint8
    like = StoredPicture(np.zeros((1, 1, 3), bits), None, Metadata(source, content.format, exif, None, None))
    write_stored(target, srgb, like)


def exposures(pictures: Sequence[str | Path], ev: Sequence[float] | None) -> list[float]:
    """Return the stops of each picture: as given, else from EXIF relative to the median; a single picture has 0."""
    if not pictures:
        raise ValueError("hdr: no picture is given")
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
    first = identify_content(paths[0])
    for path in paths:
        content = identify_content(path)
        if (content.kind == "raw") != (first.kind == "raw"):
            kinds = f"{content.format}, but {paths[0]} is {first.format}"
            raise ValueError(f"{path}: is {kinds}; give RAW files or developed pictures, not both")
