"""Bursts: several noisy frames of one scene, moved by the hand that holds the camera.

Frame k shows the scene of the first frame at ``R(angle) (p - c) + c + (dy, dx)`` for pixel p and centre c, in sensor
pixels: light is interpolated (bicubic) before the mosaic, so that each frame samples the scene at other places, and has
noise of its own. Lens shading and defects of the sensor stay where they are. What comes into view at the edges is
reflected.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor

from rawaug.kernels.runtime import one_thread
from rawaug.noise.models import new_seeds

MOTION = (2.0, 0.5)
"""Largest shift in pixels, and rotation in degrees."""


class Burst:
    """How many frames there are, and how they move."""

    def __init__(
        self, frames: int, motion: tuple[float, float] | None = None, stops: Sequence[float] | None = None
    ) -> None:
        motion = MOTION if motion is None else motion
        if not isinstance(frames, int) or frames < 1:
            raise ValueError(f"burst must be a number of frames, at least 1, got {frames!r}")
        if len(motion) != 2 or not min(motion) >= 0:
            raise ValueError(f"motion must be (pixels, degrees), both at least 0, got {motion}")
        if stops is not None and len(stops) != frames:
            raise ValueError(f"stops must be one exposure for each of {frames} frames, got {len(stops)}")
        self.frames, self.motion, self.stops = frames, motion, tuple(stops or (0.0,) * frames)

    def sample(self, batch: int, generator: torch.Generator) -> dict[str, Tensor]:
        """``motion`` ``(batch, N, 3)``: dy, dx (pixels), angle (radians); and ``frame_seed`` ``(batch, N)``."""
        shift, degrees = self.motion
        motion = 2.0 * torch.rand(batch, self.frames, 3, generator=generator) - 1.0
        motion *= torch.tensor([shift, shift, math.radians(degrees)])
        motion[:, 0] = 0.0
        return {"motion": motion, "frame_seed": new_seeds(batch * self.frames, generator).reshape(batch, self.frames)}

    def frames_of(self, scene: Tensor, motion: Tensor) -> Tensor:
        """Linear light ``(B, 3, H, W)`` as the frames see it, ``(B * N, 3, H, W)``."""
        moving = moved(scene.repeat_interleave(self.frames, 0), motion.flatten(0, 1))
        first = (motion == 0.0).all(-1).flatten().nonzero()[:, 0].to(scene.device)
        moving[first] = scene[first // self.frames]  # which nothing interpolates
        return moving

    def exposed(self, frames: Tensor) -> Tensor:
        """Frames ``(B * N, 3, H, W)`` at their exposures, at most 1."""
        stops = torch.tensor(self.stops, device=frames.device).repeat(len(frames) // self.frames)
        return (frames * torch.exp2(stops)[:, None, None, None]).clamp_max(1.0)


def moved(image: Tensor, motion: Tensor) -> Tensor:
    """``(B, C, H, W)`` seen after a motion ``(B, 3)`` of dy, dx (pixels) and angle (radians) each.

    Example:
        >>> image, motion = torch.rand(1, 3, 16, 16), torch.tensor([[1.0, 2.0, 0.0]])
        >>> torch.allclose(moved(image, motion)[..., 4:12, 4:12], image[..., 5:13, 6:14], atol=1e-4)
        True
    """
    height, width = image.shape[-2:]
    dy, dx, angle = motion.to(image).unbind(1)
    cosine, sine = angle.cos(), angle.sin()
    across, down = (
        torch.stack([cosine, -sine * height / width, 2.0 * dx / width], dim=1),
        torch.stack([sine * width / height, cosine, 2.0 * dy / height], dim=1),
    )
    with one_thread():  # the same bits everywhere
        grid = F.affine_grid(torch.stack([across, down], dim=1), list(image.shape), align_corners=False)
        return F.grid_sample(image, grid, mode="bicubic", padding_mode="reflection", align_corners=False)
