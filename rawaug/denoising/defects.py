r"""Defective sites of a sensor: left alone, or replaced by a map of them that several frames of a camera settle.

A single site that lies far beyond its neighbours may be a hot pixel or a star, and one frame does not say which. Frames
of different scenes do: a defect stays at its site. A map lists the sites beyond all others of their colour nearby, on
the same side in every frame.

A map is a text file of dcraw, which LibRaw and RawTherapee read as well (``.badpixels``): a line for each site with its
column and its row, counted from 0 in the picture without the sensor's margins. Whatever follows them in a line is
ignored, and so is what follows a ``#``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from denoisers.defects import find_outliers, mend_mosaic, mend_planes
from denoisers.domains import DOMAINS
from rawaug import bayer
from rawaug.bayer import CFA
from rawaug.denoising.denoiser import Levels
from rawaug.denoising.levels import Noise, find_levels
from rawaug.files import write_text
from rawaug.io import RawFrame, read_raw
from rawaug.io.cells import MONOCHROME

MOST_DEFECTS = 0.01
"""A larger share of the sites is no map of defects: the frames show the same scene, or hardly any signal but noise."""

_REACHES = (2, 4, 8)
"""A defect is replaced by the mean of its colour within the first of these distances at which there is any."""


def find_defects(frames: Sequence[str | Path | RawFrame], noise: Noise = "auto") -> Tensor:
    """Find the sites that are defective in all of several frames of a camera.

    Args:
        frames: two RAW files or more of one camera, of different scenes: what stays in its place, as a lamp before a
            tripod, is taken for a defect.
        noise: where the levels of their noise come from, see :data:`rawaug.denoising.levels.Noise`.

    Returns:
        A mask of the mosaic, bool ``(H, W)``.

    Raises:
        ValueError: if there are fewer than two frames, they are not of one sensor, or too many sites stand out.

    Example:
        >>> mask = rawaug.find_defects(["a.dng", "b.dng"])  # doctest: +SKIP
        >>> rawaug.denoising.defects.write_defects(mask, "mine.badpixels")  # doctest: +SKIP
    """
    if len(frames) < 2:
        raise ValueError(f"defects: give two frames or more, of different scenes, got {len(frames)}")

    first: RawFrame | None = None
    common = torch.zeros(())
    for source in frames:
        frame = source if isinstance(source, RawFrame) else read_raw(source, monochrome=True)
        if frame.cfa == MONOCHROME:  # the mosaic of a grey scene
            frame = replace(frame, cfa=CFA.RGGB)
        if first is not None and (frame.mosaic.shape, frame.cfa) != (first.mosaic.shape, first.cfa):
            raise ValueError(f"{frame.name}: is not of the same sensor as {first.name}, or was cropped otherwise")

        shot_var, read_var, _ = find_levels(frame, noise)
        levels = shot_var, read_var
        above_black = _stabilise(frame.mosaic[None], levels) - _stabilise(torch.zeros(1, 1, 1, 1), levels)
        outliers = find_outliers(above_black, _planes(frame))[0, 0]
        if first is None:
            first, common = frame, outliers
        else:
            common = common * (outliers == common)

    mask = common != 0
    share = float(mask.float().mean())
    if share > MOST_DEFECTS:
        raise ValueError(f"defects: {share:.1%} of the sites stand out in all frames; give frames of different scenes")
    return mask


def write_defects(mask: Tensor, path: str | Path) -> None:
    """Write a mask of defects, bool ``(H, W)``, as a map."""
    lines = ["# column row"]
    for row, column in mask.nonzero().tolist():
        lines.append(f"{column} {row}")
    write_text("\n".join(lines) + "\n", path)


def read_defects(path: str | Path) -> Tensor:
    """Read a map: the rows and columns of its sites, int64 ``(N, 2)``.

    Raises:
        FileNotFoundError, OSError: if the file is missing or cannot be read.
        ValueError: if a line does not begin with a column and a row.
    """
    sites = []
    for number, line in enumerate(Path(path).read_text(encoding="utf-8", errors="replace").splitlines(), start=1):
        words = line.partition("#")[0].split()
        if not words:
            continue
        if len(words) < 2 or not (words[0].isdecimal() and words[1].isdecimal()):
            raise ValueError(f"{path}: line {number} is not the column and the row of a site")
        sites.append((int(words[1]), int(words[0])))
    return torch.tensor(sites, dtype=torch.int64).reshape(-1, 2)


def mend_sites(frame: RawFrame, sites: Tensor) -> RawFrame:
    """Replace the sites of a map, rows and columns ``(N, 2)``, by the mean of their colour around them.

    Raises:
        ValueError: if a site is not within the frame.
    """
    height, width = frame.mosaic.shape[-2:]
    rows, columns = sites.unbind(1)
    is_outside = (rows >= height) | (columns >= width)
    if is_outside.any():
        row, column = sites[is_outside][0].tolist()
        raise ValueError(
            f"{frame.name}: the map of defects has column {column}, row {row}, but the frame is {width} x {height}; "
            "is it of another camera?"
        )

    usable = torch.ones(height, width)
    usable[rows, columns] = 0.0
    colours = bayer.pattern(frame.cfa).channels(height, width)
    mosaic = frame.mosaic.clone()

    for row, column in sites.tolist():
        for reach in _REACHES:
            window = slice(max(0, row - reach), row + reach + 1), slice(max(0, column - reach), column + reach + 1)
            weights = usable[window] * (colours[window] == colours[row, column])
            if weights.any():
                mosaic[0, row, column] = (frame.mosaic[0][window] * weights).sum() / weights.sum()
                break
    return replace(frame, mosaic=mosaic)


def find_lone_sites(frame: RawFrame, levels: Levels) -> Tensor:
    """Mark the sites that networks take for hot and dead pixels of a frame, bool ``(1, H, W)``.

    Args:
        frame: with noise of these levels.
        levels: (shot_var, read_var).
    """
    if frame.cfa in CFA.__members__:
        signal = _stabilise(bayer.pack(frame.mosaic[None], frame.cfa), levels)
        lone = (mend_planes(signal) != signal).float()
        return bayer.unpack(lone, frame.cfa)[0] > 0

    signal = _stabilise(frame.mosaic[None], levels)
    return (mend_mosaic(signal, _planes(frame)) != signal)[0]


def _planes(frame: RawFrame) -> Tensor:
    return bayer.pattern(frame.cfa).planes(*frame.mosaic.shape[-2:])[None]


def _stabilise(image: Tensor, levels: Levels) -> Tensor:
    """Transform RAW to a signal whose noise has deviation 1."""
    shot_var, read_var = (torch.full((1, 1, 1, 1), level) for level in levels)
    return DOMAINS["anscombe"].forward(image, shot_var, read_var)
