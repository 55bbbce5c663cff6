"""A camera's own noise levels, from the RAW files that its ISP is fitted on: photon transfer, dark frames if there are.

The captured noisy mosaic of a pair is measured where it has one, else the RAW file itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from rawaug.bayer import CFA
from rawaug.data import RawFolder
from rawaug.data.pairs import Pair
from rawaug.experiment.stream import aligned
from rawaug.noise import NoiseEstimate, estimate_noise, from_dark_frames


def measure_camera_noise(pairs: Sequence[Pair], dark: str | Path | None = None) -> NoiseEstimate:
    """(shot_var, read_var) of the camera at the ISO of its files, with the measured points.

    Args:
        pairs: frames of one camera at one ISO; others blur the line, which its R^2 shows.
        dark: folder of dark frames, which then tell the read variance.

    Raises:
        ValueError: if the frames have too few flat regions, or a dark frame is clipped at black.
    """
    cfa = CFA(pairs[0].cfa)
    read_var = None
    if dark is not None:
        frames = [aligned(frame.raw, frame.cfa, cfa) for frame in RawFolder(dark, camera_jpeg=False)]
        read_var = from_dark_frames(frames, cfa).read_var
    mosaics = [aligned(pair.raw if pair.noisy is None else pair.noisy, pair.cfa, cfa) for pair in pairs]
    return estimate_noise(mosaics, cfa, read_var=read_var)


def as_info(estimate: NoiseEstimate) -> dict[str, float]:
    """What stands in the ISP's file under ``noise``."""
    return {"shot_var": estimate.shot_var, "read_var": estimate.read_var, "r2": estimate.r2}
