"""A camera's own noise levels, from the RAW files that its ISP is fitted on: photon transfer, and dark frames if given.

The captured noisy mosaic of a pair is measured where it has one, else the RAW file itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from torch import Tensor

from rawaug.bayer import CFA, aligned
from rawaug.data import RawFolder
from rawaug.data.pair import Pair
from rawaug.io import read_raw
from rawaug.io.apart import apart
from rawaug.noise import NoiseEstimate, estimate_noise, from_dark_frames

WORST_FIT = 0.5
"""R^2 below which the points do not follow a line."""
MOST_FRAMES = 16
"""Largest number of frames measured, since all are in memory."""


def measure_camera_noise(pairs: Sequence[Pair], dark: str | Path | None = None) -> NoiseEstimate:
    """(shot_var, read_var) of the camera at the ISO of its files, with the measured points.

    Args:
        pairs: frames of one camera at one ISO (others blur the line, which its R^2 shows); at most
            :data:`MOST_FRAMES` are used, evenly spaced.
        dark: folder of dark frames to measure the read variance.

    Raises:
        ValueError: if the frames have too few flat regions, or a dark frame is clipped at black.
    """
    mosaics, cfa = _mosaics(pairs)
    read_var = None
    if dark is not None:
        frames, dark_cfa = _mosaics(RawFolder(dark))
        read_var = from_dark_frames(frames, dark_cfa).read_var
    estimate = estimate_noise(mosaics, cfa, read_var=read_var)
    if estimate.shot_var <= 0.0 or estimate.r2 < WORST_FIT:
        raise ValueError(
            f"noise: the frames do not fit one noise law (R^2 {estimate.r2:.2f}); use one camera at one ISO"
        )
    return estimate


def _mosaics(pairs: Sequence[Pair]) -> tuple[list[Tensor], CFA]:
    """The mosaics of frames spread over ``pairs``, brought to the pattern of the first. RAW files are not developed."""
    chosen = [round(k * (len(pairs) - 1) / max(1, MOST_FRAMES - 1)) for k in range(MOST_FRAMES)]
    indices = range(len(pairs)) if len(pairs) <= MOST_FRAMES else chosen
    found: list[tuple[Tensor, CFA]] = []
    for index in indices:
        if isinstance(pairs, RawFolder):
            frame = apart(read_raw, pairs.files[index])
            found.append((frame.mosaic, frame.cfa))
        else:
            pair = pairs[index]
            found.append((pair.raw if pair.noisy is None else pair.noisy, pair.cfa))
    cfa = found[0][1]
    return [aligned(mosaic, own, cfa) for mosaic, own in found], cfa


def as_info(estimate: NoiseEstimate) -> dict[str, float]:
    """The entry ``noise`` of the ISP's file."""
    return {"shot_var": estimate.shot_var, "read_var": estimate.read_var, "r2": estimate.r2}
