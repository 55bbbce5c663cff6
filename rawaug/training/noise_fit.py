"""The noise of a camera, measured at each ISO of its files by photon transfer, and by dark frames if there are any."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path

from torch import Tensor

from rawaug.bayer import CFA, crop_to_cfa
from rawaug.data import RawFolder
from rawaug.data.frames import Readable, as_frames
from rawaug.data.pairs import Pair
from rawaug.errors import count_of
from rawaug.io import RawFrame
from rawaug.noise import IsoLevel, MeasuredLevels, NoiseEstimate, estimate_dark_noise, estimate_noise, plot_noise
from rawaug.noise.estimate import WORST_FIT

MOST_FRAMES = 32
"""At most this many frames are measured, as all of them are in memory."""
_UNKNOWN = "unknown"
"""Files that do not name a camera have this one."""


def plot_camera_noise(law: MeasuredLevels, estimates: Mapping[float | None, NoiseEstimate], path: str | Path) -> None:
    """Draw the measured points and the line of each ISO, one file for each, see :func:`noise_figures`."""
    for file, (iso, estimate) in zip(noise_figures(path, law), estimates.items(), strict=True):
        title = law.camera
        if iso is not None:
            title = f"{law.camera}, ISO {iso:g}"
        plot_noise(estimate, file, title=title)


def measure_camera_noise(
    pairs: Sequence[Pair], dark: str | Path | None = None
) -> tuple[MeasuredLevels, dict[float | None, NoiseEstimate]]:
    """Measure (shot_var, read_var) of one camera at each ISO of its files.

    Args:
        pairs: the frames, flat areas among them.
        dark: folder of dark frames to measure the read variance.

    Returns:
        The camera's levels by ISO, and the measured points of each.

    Raises:
        ValueError: if the frames are of several cameras, have no common noise law, or cannot be read.
    """
    by_iso = _group_by_iso(_read_frames(pairs))
    dark_by_iso = None
    if dark is not None:
        dark_by_iso = _group_by_iso(_read_frames(RawFolder(dark)))

    camera = _UNKNOWN
    estimates = {}
    levels = []
    for iso, frames in by_iso.items():
        estimate = _measure(iso, frames, dark_by_iso)
        estimates[iso] = estimate
        levels.append(IsoLevel(iso, estimate.shot_var, estimate.read_var, round(estimate.r2, 4), len(frames)))
        for frame in frames:
            if camera == _UNKNOWN:
                camera = frame.camera

    return MeasuredLevels(levels, camera), estimates


def _measure(
    iso: float | None, frames: Sequence[RawFrame], dark: dict[float | None, list[RawFrame]] | None
) -> NoiseEstimate:
    """Fit the line of the frames of one ISO."""
    at_iso = "" if iso is None else f" at ISO {iso:g}"

    read_var = None
    if dark is not None:
        matching = dark.get(iso) or dark.get(None)
        if matching is None:
            raise ValueError(f"dark: has no frame{at_iso}; give dark frames at every measured ISO")
        read_var = estimate_dark_noise(*_align(matching)).read_var

    try:
        estimate = estimate_noise(*_align(frames), read_var=read_var)
    except ValueError as error:
        raise ValueError(f"noise{at_iso}: {error}") from None

    if estimate.shot_var <= 0.0 or estimate.r2 < WORST_FIT:
        advice = "use one camera at one ISO" if iso is None else "use unprocessed RAW files with flat areas"
        raise ValueError(f"noise{at_iso}: the frames do not fit one noise law (R^2 {estimate.r2:.2f}); {advice}")
    return estimate


def _group_by_iso(frames: Sequence[RawFrame]) -> dict[float | None, list[RawFrame]]:
    """Group frames by ISO, ascending; raise ValueError if they are of two cameras, which share no law."""
    cameras: Counter[str] = Counter()
    by_iso: dict[float | None, list[RawFrame]] = defaultdict(list)
    for frame in frames:
        by_iso[frame.iso].append(frame)
        if frame.camera != _UNKNOWN:
            cameras[frame.camera] += 1

    if len(cameras) > 1:
        counts = ", ".join(f"{name} ({count})" for name, count in cameras.items())
        raise ValueError(f"noise: the frames are from {len(cameras)} cameras, {counts}; measure each separately")

    if None in by_iso and len(by_iso) > 1:
        raise ValueError(f"noise: {len(by_iso[None])} of {len(frames)} frames have no ISO; measure them separately")
    return dict(sorted(by_iso.items(), key=lambda item: item[0] or 0.0))


def _read_frames(pairs: Sequence[Pair]) -> list[RawFrame]:
    """Read frames spread over ``pairs``, and of :class:`Readable` ones only sound ones. None is developed."""
    last = len(pairs) - 1
    indices = list(range(len(pairs)))
    if last >= MOST_FRAMES:
        indices = [round(k * last / (MOST_FRAMES - 1)) for k in range(MOST_FRAMES)]

    read: Callable[[int], RawFrame | None]
    if isinstance(pairs, Readable):
        read = partial(pairs.attempt, read=as_frames(pairs.pairs).frame)
    else:
        read = as_frames(pairs).frame

    frames = []
    for index in indices:
        frame = read(index)
        if frame is not None:
            frames.append(frame)

    if isinstance(pairs, Readable) and pairs.broken and not frames:
        raise ValueError(f"noise: none of {count_of(len(indices), 'frame')} can be read; {pairs.reasons()[0]}")
    return frames


def _align(frames: Sequence[RawFrame]) -> tuple[list[Tensor], str]:
    """Bring the mosaics of frames to the first one's pattern, and return that too; Bayer's four are cropped to it."""
    cfa = frames[0].cfa
    patterns = {frame.cfa for frame in frames}
    if len(patterns) == 1:
        return [frame.mosaic for frame in frames], cfa
    if not patterns <= set(CFA):
        raise ValueError(f"the frames are of several patterns, {', '.join(sorted(patterns))}; measure each separately")

    mosaics = []
    for frame in frames:
        mosaics.append(crop_to_cfa(frame.mosaic, CFA(frame.cfa), CFA(cfa)))
    return mosaics, cfa


def noise_figures(path: str | Path, law: MeasuredLevels) -> list[Path]:
    """List the files of the drawn points: ``path``, with the ISO in its name if there are several."""
    path = Path(path)
    if len(law.levels) == 1:
        return [path]
    return [path.with_name(f"{path.stem}-iso{level.iso:g}{path.suffix}") for level in law.levels]
