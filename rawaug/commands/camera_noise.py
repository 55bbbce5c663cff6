"""A camera's noise law, from the RAW files that its ISP is fitted on: photon transfer, and dark frames if given.

Frames of each ISO are measured together. The captured noisy mosaic of a pair is measured where it has one, else the
RAW file itself.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import NamedTuple

from torch import Tensor

from rawaug.bayer import CFA, aligned
from rawaug.data import RawFolder
from rawaug.data.pair import Pair
from rawaug.data.readable import Readable
from rawaug.io import read_raw
from rawaug.io.apart import apart
from rawaug.noise import IsoLevel, MeasuredLevels, NoiseEstimate, estimate_noise, from_dark_frames

WORST_FIT = 0.5
"""R^2 below which the points do not follow a line."""
MOST_FRAMES = 32
"""Largest number of frames measured, since all are in memory."""
_UNKNOWN = "unknown"


class Frame(NamedTuple):
    """What is measured: a mosaic, its pattern, and the camera and ISO that the file names."""

    mosaic: Tensor
    cfa: CFA
    camera: str
    iso: float | None


@dataclass(frozen=True)
class CameraNoise:
    """What was measured.

    Attributes:
        law: the levels over ISO.
        estimates: the line and points of each ISO; None is the ISO of files without one.
    """

    law: MeasuredLevels
    estimates: dict[float | None, NoiseEstimate]


def measure_camera_noise(pairs: Sequence[Pair], dark: str | Path | None = None) -> CameraNoise:
    """(shot_var, read_var) of one camera at each ISO of its files, with the measured points.

    Args:
        pairs: frames of one camera; at most :data:`MOST_FRAMES` are used, evenly spaced. Of
            :class:`rawaug.data.readable.Readable` those that cannot be read are left out.
        dark: folder of dark frames of the same ISO values to measure the read variance.

    Raises:
        ValueError: if the frames are of several cameras or only some have an ISO, an ISO has too few flat regions or
            follows no line, or the dark frames lack an ISO or are clipped at black.
    """
    by_iso = _by_iso(_frames(pairs))
    dark_by_iso = None if dark is None else _by_iso(_frames(RawFolder(dark)))
    estimates = {iso: _measured(iso, frames, dark_by_iso) for iso, frames in by_iso.items()}
    camera = next((f.camera for frames in by_iso.values() for f in frames if f.camera != _UNKNOWN), _UNKNOWN)
    levels = [IsoLevel(iso, e.shot_var, e.read_var, round(e.r2, 4), len(by_iso[iso])) for iso, e in estimates.items()]
    return CameraNoise(MeasuredLevels(levels, camera), estimates)


def _measured(
    iso: float | None, frames: Sequence[Frame], dark: dict[float | None, list[Frame]] | None
) -> NoiseEstimate:
    """The line of the frames of one ISO."""
    where = "" if iso is None else f" at ISO {iso:g}"
    read_var = None
    if dark is not None:
        matching = dark.get(iso) or dark.get(None)
        if matching is None:
            raise ValueError(f"dark: has no frame{where}; give dark frames at every measured ISO")
        read_var = from_dark_frames(*_aligned(matching)).read_var
    try:
        estimate = estimate_noise(*_aligned(frames), read_var=read_var)
    except ValueError as error:
        raise ValueError(f"noise{where}: {error}") from None
    if estimate.shot_var <= 0.0 or estimate.r2 < WORST_FIT:
        raise ValueError(f"noise{where}: the frames do not fit one noise law (R^2 {estimate.r2:.2f}); {_advice(iso)}")
    return estimate


def _advice(iso: float | None) -> str:
    return "use one camera at one ISO" if iso is None else "use unprocessed RAW files with flat areas"


def _by_iso(frames: Sequence[Frame]) -> dict[float | None, list[Frame]]:
    """The frames by ISO, ascending; those of two cameras do not share a law."""
    cameras = dict.fromkeys(frame.camera for frame in frames if frame.camera != _UNKNOWN)
    if len(cameras) > 1:
        counted = ", ".join(f"{name} ({sum(f.camera == name for f in frames)})" for name in cameras)
        raise ValueError(
            f"noise: the frames are from {len(cameras)} cameras, {counted}; measure each camera separately"
        )
    by_iso: dict[float | None, list[Frame]] = defaultdict(list)
    for frame in frames:
        by_iso[frame.iso].append(frame)
    if None in by_iso and len(by_iso) > 1:
        raise ValueError(
            f"noise: {len(by_iso[None])} of {len(frames)} frames have no ISO; omit them, or measure them separately"
        )
    return dict(sorted(by_iso.items(), key=lambda item: item[0] or 0.0))


def _frames(pairs: Sequence[Pair]) -> list[Frame]:
    """Frames spread over ``pairs``; of :class:`Readable` ones those that can be read. RAW files are not developed."""
    last = len(pairs) - 1
    spread = [round(k * last / (MOST_FRAMES - 1)) for k in range(MOST_FRAMES)]
    indices = range(len(pairs)) if last < MOST_FRAMES else spread
    if not isinstance(pairs, Readable):
        return [_frame(pairs, index) for index in indices]
    found = (pairs.attempt(index, partial(_frame, pairs.pairs)) for index in indices)
    frames = [frame for frame in found if frame is not None]
    if pairs.broken and not frames:
        raise ValueError(f"noise: none of {len(indices)} frames can be read; {pairs.reasons()[0]}")
    return frames


def _frame(pairs: Sequence[Pair], index: int) -> Frame:
    if isinstance(pairs, RawFolder):
        frame = apart(read_raw, pairs.files[index])
        return Frame(frame.mosaic, frame.cfa, frame.camera, frame.iso)
    pair = pairs[index]
    return Frame(pair.raw if pair.noisy is None else pair.noisy, pair.cfa, pair.camera, pair.iso)


def _aligned(frames: Sequence[Frame]) -> tuple[list[Tensor], CFA]:
    """The mosaics, brought to the pattern of the first."""
    cfa = frames[0].cfa
    return [aligned(frame.mosaic, frame.cfa, cfa) for frame in frames], cfa
