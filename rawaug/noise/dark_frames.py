"""A camera's own dark frames as its read noise: ``y + shot_var (Poisson(y / shot_var) - y / shot_var) + dark``."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from rawaug.bayer import pack
from rawaug.files import files_in
from rawaug.io import read_raw
from rawaug.io.raw import RAW_EXTENSIONS
from rawaug.noise.effects import Range, draw_between, require_not_negative
from rawaug.noise.estimate import estimate_dark_noise
from rawaug.noise.models import NOISE, Params, PoissonGaussianNoise, draw_seeds


@NOISE.register("DarkFrames")
class DarkFrames(PoissonGaussianNoise):
    """Photons, and read noise cut out of a camera's own dark frames: ``shot_var Poisson(y / shot_var) + dark``.

    Every picture gets a patch of a random frame, from a random place of the same CFA phase, with everything that the
    sensor does in it: tails, banding, offsets, hot pixels, rounding. A frame wraps around at its edges.

    Args:
        path: a RAW file taken with the lens capped, or a folder of such files from one camera; they are kept in memory.
        shot_var: shot variance of the photons at the frames' ISO, white = 1, or limits to draw it between. The default
            is that of each file's NoiseProfile tag.

    Example:
        >>> model = DarkFrames("darks/iso1600", shot_var=2e-3)  # doctest: +SKIP
    """

    by_plane = True

    def __init__(self, path: str, shot_var: Range | None = None) -> None:
        if shot_var is not None:
            require_not_negative(shot_var=shot_var)

        self.planes: list[Tensor] = []
        self.shot_var: list[Range] = []
        read_var = []
        for file in files_in(path, "RAW", RAW_EXTENSIONS):
            frame = read_raw(file)
            if shot_var is not None:
                self.shot_var.append(shot_var)
            elif frame.noise_profile is not None:
                self.shot_var.append(frame.noise_profile[0])
            else:
                raise ValueError(f"DarkFrames: {frame.name} has no NoiseProfile tag; give shot_var, the photons' share")

            self.planes.append(pack(frame.mosaic[None], frame.cfa)[0])
            read_var.append(estimate_dark_noise([frame.mosaic], frame.cfa).read_var)
        self.read_var = torch.tensor(read_var)

    def sample(self, batch: int, generator: torch.Generator) -> Params:
        """Draw a dark frame for each picture with its levels, and the seeds, each ``(batch,)``."""
        frames = torch.randint(len(self.planes), (batch,), generator=generator, device=generator.device)

        shot_var = []
        for frame in frames.tolist():
            shot_var.append(draw_between(self.shot_var[frame], 1, generator)[0])

        return {
            "shot_var": torch.stack(shot_var),
            "read_var": self.read_var.to(generator.device)[frames],
            "dark_frame": frames,
            "seed": draw_seeds(batch, generator),
        }

    def read_noise(self, like: Tensor, params: Params, generators: Sequence[torch.Generator]) -> Tensor:
        """Cut a patch for each picture out of its dark frame, ``(B, 4, h, w)``."""
        height, width = like.shape[-2:]
        noise = torch.empty_like(like, memory_format=torch.contiguous_format)
        for picture, frame, generator in zip(noise, params["dark_frame"].tolist(), generators, strict=True):
            planes = self.planes[frame].to(like)
            rows = _draw_interval(height, planes.shape[-2], generator)
            columns = _draw_interval(width, planes.shape[-1], generator)
            picture.copy_(planes[:, rows[:, None], columns])
        return noise


def _draw_interval(length: int, side: int, generator: torch.Generator) -> Tensor:
    """Draw ``(length,)`` consecutive line numbers out of ``side``, wrapping around after the last."""
    first = int(torch.randint(side, (), generator=generator, device=generator.device))
    return (torch.arange(length) + first) % side
