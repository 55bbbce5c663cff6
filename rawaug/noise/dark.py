r"""Read noise, banding and black level from dark frames: pictures taken with the lens capped.

Without light, :math:`y = b_c + r_{row} + n`. Differences between horizontal neighbours of one colour hold n alone,
twice its variance; those between the means of successive sensor rows hold the banding as well (after Wei et al. 2020).
Slow gradients (amplifier glow) cancel in both. Signals are black-subtracted with the file's own black level, white = 1.

Or no model at all: :class:`DarkFrames` takes the frames as they are, with the photons that they lack.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from rawaug.bayer import CFA, pack
from rawaug.noise.models import Params, PoissonGaussianNoise, new_seeds
from rawaug.noise.sensor import Range, draw
from rawaug.registry import NOISE

_OUTLIER = 8.0  # in robust standard deviations: hot pixels, not tails
_PILED_UP = 0.25  # share of pixels at the lowest value, above which nothing can be measured


@dataclass(frozen=True)
class DarkNoise:
    """``read_var`` of pixels, ``row_var`` of banding (0 if not measurable), and the black level's error in
    R, Gr, Gb, B. Fixed pattern noise is part of ``read_var``."""

    read_var: float
    row_var: float
    black_offset: tuple[float, float, float, float]


def from_dark_frames(frames: Sequence[Tensor], cfa: CFA | str) -> DarkNoise:
    """The noise without light, the mean over the frames ``(1, H, W)`` or ``(1, 1, H, W)`` of one camera at one ISO.

    Raises:
        ValueError: if there is no frame, or one is clipped at black.

    Example:
        >>> frame = torch.randn(1, 256, 256, generator=torch.Generator().manual_seed(0)) * 1e-3
        >>> dark = from_dark_frames([frame], "RGGB")
        >>> 0.9e-6 < dark.read_var < 1.1e-6  # for estimate_noise(mosaics, cfa, read_var=dark.read_var)
        True
    """
    if not frames:
        raise ValueError("no dark frames given")
    measured = [_measure(pack(frame.reshape(1, *frame.shape[-2:]).double(), cfa)) for frame in frames]
    read_var, row_var, *offsets = torch.stack(measured).mean(0).tolist()
    return DarkNoise(read_var, max(row_var, 0.0), (offsets[0], offsets[1], offsets[2], offsets[3]))


def _measure(planes: Tensor) -> Tensor:
    """(read_var, row_var, offsets of R, Gr, Gb, B) of packed ``(4, h, w)``."""
    lowest = planes == planes.min()
    if float(lowest.double().mean()) > _PILED_UP:
        raise ValueError("a dark frame is clipped at black, so its noise cannot be measured")
    difference = planes.diff(dim=-1)
    scale = 1.4826 * difference.abs().median()
    regular = difference.abs() <= _OUTLIER * scale if scale > 0 else torch.ones_like(difference, dtype=torch.bool)
    read_var = difference[regular].square().mean() / 2
    # R and Gr share a row of the sensor, Gb and B the next. A median is coarse on digital numbers: cap the outliers.
    offsets = planes.flatten(1).median(-1).values
    limit = _OUTLIER * scale if scale > 0 else planes.abs().max()
    levelled = (planes - offsets[:, None, None]).clamp(-limit, limit)
    rows = levelled.reshape(2, 2, *planes.shape[1:]).mean((1, 3))
    row_var = rows.diff(dim=-1).square().mean() / 2 - read_var / (2 * planes.shape[-1])
    return torch.cat([read_var[None], row_var[None], levelled.mean((1, 2)) + offsets])


@NOISE.register("DarkFrames")
class DarkFrames(PoissonGaussianNoise):
    """Photons, and read noise cut out of a camera's own dark frames: ``shot_var Poisson(y / shot_var) + dark``.

    Every picture has a patch of a random frame at a random place of the same CFA phase, with all that the sensor does
    in it: tails, banding, offsets, hot pixels, rounding. At its edges a frame goes on at the other side.

    Args:
        path: a RAW file taken with the lens capped, or a folder of them, of one camera; kept in memory.
        shot_var: of the photons at the frames' ISO, or limits that it is drawn between; by default that of each file's
            NoiseProfile tag.

    Raises:
        FileNotFoundError, OSError: if there is no such file, or it cannot be read.
        ValueError: if there is no RAW file, one is clipped at black, or ``shot_var`` is neither given nor in the tags.

    Example:
        >>> model = DarkFrames("darks/iso1600", shot_var=2e-3)  # doctest: +SKIP
    """

    by_plane = True

    def __init__(self, path: str, shot_var: Range | None = None) -> None:
        from rawaug.data.folders import RawFolder
        from rawaug.io import read_raw

        frames = [read_raw(file) for file in RawFolder(path).files]
        untagged = [frame.name for frame in frames if shot_var is None and frame.noise_profile is None]
        if untagged:
            raise ValueError(f"DarkFrames: {untagged[0]} has no NoiseProfile tag; give shot_var, the photons' share")
        self.planes = [pack(frame.mosaic[None], frame.cfa)[0] for frame in frames]
        self.read_var = torch.tensor([from_dark_frames([frame.mosaic], frame.cfa).read_var for frame in frames])
        self.shot_var = [shot_var or frame.noise_profile[0] for frame in frames]  # type: ignore[index]

    def sample(self, batch: int, generator: torch.Generator) -> Params:
        frame = torch.randint(len(self.planes), (batch,), generator=generator, device=generator.device)
        shot = torch.stack([draw(self.shot_var[k], 1, generator)[0] for k in frame.tolist()])
        read = self.read_var.to(generator.device)[frame]
        return {"shot_var": shot, "read_var": read, "dark_frame": frame, "seed": new_seeds(batch, generator)}

    def read_noise(self, like: Tensor, params: Params, generators: Sequence[torch.Generator]) -> Tensor:
        noise = torch.empty_like(like, memory_format=torch.contiguous_format)
        for picture, index, generator in zip(noise, params["dark_frame"].tolist(), generators, strict=True):
            planes = self.planes[index].to(like)
            rows, columns = (
                (torch.arange(size) + int(torch.randint(side, (), generator=generator, device=like.device))) % side
                for side, size in zip(planes.shape[-2:], like.shape[-2:], strict=True)
            )
            picture.copy_(planes[:, rows[:, None], columns])
        return noise
