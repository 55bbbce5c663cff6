"""The noise of one camera at each ISO of its files, by photon transfer on what was fitted, and on dark frames if given.

It is measured on the captured noisy mosaic of a pair where it has one, else on the RAW file itself.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

from torch import Tensor

from rawaug.bayer import CFA, aligned
from rawaug.data import RawFolder
from rawaug.data.folders import Readable
from rawaug.data.pairs import Pair
from rawaug.io import RawFrame, read_raw
from rawaug.noise import IsoLevel, MeasuredLevels, NoiseEstimate, estimate_noise, from_dark_frames, plot_noise
from rawaug.noise.estimate import WORST_FIT

MOST_FRAMES = 32
"""Largest number of frames measured, since all are in memory."""
_UNKNOWN = "unknown"


class CameraNoise(NamedTuple):
    law: MeasuredLevels
    estimates: dict[float | None, NoiseEstimate]

    def plot(self, path: str | Path) -> None:
        for file, (iso, estimate) in zip(noise_figures(path, self.law), self.estimates.items(), strict=True):
            plot_noise(estimate, file, title=self.law.camera if iso is None else f"{self.law.camera}, ISO {iso:g}")


def measure_camera_noise(pairs: Sequence[Pair], dark: str | Path | None = None) -> CameraNoise:
    """(shot_var, read_var) of one camera at each ISO of its files, with the measured points."""
    by_iso = _by_iso(_frames(pairs))
    dark_by_iso = None if dark is None else _by_iso(_frames(RawFolder(dark)))
    estimates = {iso: _measured(iso, frames, dark_by_iso) for iso, frames in by_iso.items()}
    camera = next((f.camera for frames in by_iso.values() for f in frames if f.camera != _UNKNOWN), _UNKNOWN)
    levels = [IsoLevel(iso, e.shot_var, e.read_var, round(e.r2, 4), len(by_iso[iso])) for iso, e in estimates.items()]
    return CameraNoise(MeasuredLevels(levels, camera), estimates)


def _measured(
    iso: float | None, frames: Sequence[RawFrame], dark: dict[float | None, list[RawFrame]] | None
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
        advice = "use one camera at one ISO" if iso is None else "use unprocessed RAW files with flat areas"
        raise ValueError(f"noise{where}: the frames do not fit one noise law (R^2 {estimate.r2:.2f}); {advice}")
    return estimate


def _by_iso(frames: Sequence[RawFrame]) -> dict[float | None, list[RawFrame]]:
    """The frames by ISO, ascending; those of two cameras do not share a law."""
    cameras = dict.fromkeys(frame.camera for frame in frames if frame.camera != _UNKNOWN)
    if len(cameras) > 1:
        counted = ", ".join(f"{name} ({sum(f.camera == name for f in frames)})" for name in cameras)
        raise ValueError(f"noise: the frames are from {len(cameras)} cameras, {counted}; measure each separately")
    by_iso: dict[float | None, list[RawFrame]] = defaultdict(list)
    for frame in frames:
        by_iso[frame.iso].append(frame)
    if None in by_iso and len(by_iso) > 1:
        raise ValueError(f"noise: {len(by_iso[None])} of {len(frames)} frames have no ISO; measure them separately")
    return dict(sorted(by_iso.items(), key=lambda item: item[0] or 0.0))


def _frames(pairs: Sequence[Pair]) -> list[RawFrame]:
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


def _frame(pairs: Sequence[Pair], index: int) -> RawFrame:
    if isinstance(pairs, RawFolder):
        return read_raw(pairs.files[index])
    pair = pairs[index]
    return RawFrame(pair.raw if pair.noisy is None else pair.noisy, pair.cfa, camera=pair.camera, iso=pair.iso)


def _aligned(frames: Sequence[RawFrame]) -> tuple[list[Tensor], CFA]:
    cfa = frames[0].cfa
    return [aligned(frame.mosaic, frame.cfa, cfa) for frame in frames], cfa


def noise_figures(path: str | Path, law: MeasuredLevels) -> list[Path]:
    """Where the measured points are drawn: ``path``, with the ISO in its name where there are several."""
    path = Path(path)
    if len(law.levels) == 1:
        return [path]
    return [path.with_name(f"{path.stem}-iso{level.iso:g}{path.suffix}") for level in law.levels]
