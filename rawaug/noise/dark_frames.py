"""A camera's own dark frames as its read noise: ``y + shot_var (Poisson(y / shot_var) - y / shot_var) + dark``."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from rawaug.bayer import pack
from rawaug.files import files_in
from rawaug.io import read_raw
from rawaug.io.raw import RAW_EXTENSIONS
from rawaug.noise.estimate import estimate_dark_noise
from rawaug.noise.models import NOISE, Params, PoissonGaussianNoise, draw_seeds
from rawaug.noise.sensor import Range, draw_between, require_not_negative


@NOISE.register("DarkFrames")
class DarkFrames(PoissonGaussianNoise):
    """Photons, and read noise cut out of a camera's own dark frames: ``shot_var Poisson(y / shot_var) + dark``.

    Every picture has a patch of a random frame at a random place of the same CFA phase, with all that the sensor does
    in it: tails, banding, offsets, hot pixels, rounding. At its edges a frame goes on at the other side.

    Args:
        path: a RAW file taken with the lens capped, or a folder of them, of one camera; kept in memory.
        shot_var: of the photons at the frames' ISO, white = 1, or limits that it is drawn between; by default that of
            each file's NoiseProfile tag.

    Example:
        >>> model = DarkFrames("darks/iso1600", shot_var=2e-3)  # doctest: +SKIP
    """

    by_plane = True

    def __init__(self, path: str, shot_var: Range | None = None) -> None:
        require_not_negative(shot_var=0.0 if shot_var is None else shot_var)
        frames = [read_raw(file) for file in files_in(path, "RAW", RAW_EXTENSIONS)]
        untagged = [frame.name for frame in frames if shot_var is None and frame.noise_profile is None]
        if untagged:
            raise ValueError(f"DarkFrames: {untagged[0]} has no NoiseProfile tag; give shot_var, the photons' share")
        self.planes = [pack(frame.mosaic[None], frame.cfa)[0] for frame in frames]
        self.read_var = torch.tensor([estimate_dark_noise([frame.mosaic], frame.cfa).read_var for frame in frames])
        self.shot_var = [frame.noise_profile[0] if shot_var is None else shot_var for frame in frames]  # type: ignore[index]

    def sample(self, batch: int, generator: torch.Generator) -> Params:
        """Draw a dark frame for each picture with its levels, and the seeds, each ``(batch,)``."""
        frame = torch.randint(len(self.planes), (batch,), generator=generator, device=generator.device)
        shot = torch.stack([draw_between(self.shot_var[k], 1, generator)[0] for k in frame.tolist()])
        read = self.read_var.to(generator.device)[frame]
        return {"shot_var": shot, "read_var": read, "dark_frame": frame, "seed": draw_seeds(batch, generator)}

    def read_noise(self, like: Tensor, params: Params, generators: Sequence[torch.Generator]) -> Tensor:
        """Cut a patch for each picture out of its dark frame, ``(B, 4, h, w)``."""
        noise = torch.empty_like(like, memory_format=torch.contiguous_format)
        for picture, index, generator in zip(noise, params["dark_frame"].tolist(), generators, strict=True):
            planes = self.planes[index].to(like)
            rows, columns = (
                (torch.arange(size) + int(torch.randint(side, (), generator=generator, device=like.device))) % side
                for side, size in zip(planes.shape[-2:], like.shape[-2:], strict=True)
            )
            picture.copy_(planes[:, rows[:, None], columns])
        return noise
