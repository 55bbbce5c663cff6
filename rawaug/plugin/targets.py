r"""What a pair holds besides RAW of one shot: linear camera RGB, developed sRGB, or a burst.

*sRGB* is developed by the camera setting that made the RAW,

.. math:: x = t(C^{-1} (g \cdot \mathrm{demosaic}(y)))

with the gains g, matrix C and tone curve t of the draw (:class:`rawaug.isp.fast.FastForward`). Noisy and clean RAW are
developed alike, by a demosaicing drawn from those at hand, so that the two differ by the sensor's noise alone: the
developed clean RAW is the target, not the picture, which demosaicing alone would leave at 29 to 31 dB.

*Bursts* are several noisy frames of one scene, moved by the hand that holds the camera. Frame k shows the scene of the
first frame at ``R(angle) (p - c) + c + (dy, dx)`` for pixel p and centre c, in sensor pixels: light is interpolated
(bicubic, and clipped at black) before the mosaic, so that each frame samples the scene at other places, and has noise
of its own. Lens shading and defects of the sensor stay where they are. What comes into view at the edges is reflected.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Literal, get_args

import torch
import torch.nn.functional as F
from torch import Tensor

from rawaug import bayer
from rawaug.isp.config import ISPParams
from rawaug.isp.fast import FastForward
from rawaug.kernels.runtime import one_thread
from rawaug.noise.models import draw_seeds
from rawaug.plugin.finishing import Finish
from rawaug.plugin.params import AugmentParams

Target = Literal["raw", "rgb", "srgb"]


class Targets:
    """The target of a :class:`rawaug.RawAugment`, whose settings these are, and what is drawn for it."""

    def __init__(
        self,
        target: Target,
        demosaicing: str | Sequence[str] | None,
        jpeg: tuple[int, int] | None,
        pattern: str,
        finish: Finish | bool = False,
    ) -> None:
        if target not in get_args(Target):
            raise ValueError(f"target {target!r} is unknown; use one of {', '.join(get_args(Target))}")
        if target != "srgb" and ((demosaicing, jpeg) != (None, None) or finish):
            raise ValueError(f"demosaicing, jpeg and finish are for target 'srgb', not {target!r}; omit them")
        if target == "srgb" and pattern not in bayer.CFA.__members__:
            raise ValueError(f"target 'srgb' demosaics Bayer patterns, not {pattern}; use target 'rgb' or 'raw'")
        if jpeg is not None and not (len(jpeg) == 2 and 1 <= jpeg[0] <= jpeg[1] <= 100):
            raise ValueError(f"jpeg must be (lowest, highest) quality within 1 to 100, got {jpeg}")
        names = list(bayer.METHODS) if demosaicing is None else demosaicing
        self.names = (names,) if isinstance(names, str) else tuple(names)
        for name in self.names:
            bayer.require_method(name)
        self.finish = Finish() if finish is True else finish or None
        if self.finish is not None and jpeg is None:
            jpeg = self.finish.quality
        self.target, self.jpeg = target, jpeg

    def sample(self, batch: int, generator: torch.Generator) -> dict[str, Tensor]:
        """Number of the demosaicing and quality of the JPEG, each ``(batch,)``; nothing for RAW and linear RGB."""
        if self.target != "srgb":
            return {}
        drawn = {"demosaicing": torch.randint(len(self.names), (batch,), generator=generator)}
        if self.jpeg is not None:
            drawn["quality"] = torch.randint(self.jpeg[0], self.jpeg[1] + 1, (batch,), generator=generator)
        return drawn if self.finish is None else drawn | self.finish.sample(batch, generator)

    def develop(self, forward: FastForward, raws: Sequence[Tensor], params: AugmentParams) -> list[Tensor]:
        """Mosaics of the same pictures, ``(B, 1, H, W)`` each, to sRGB in [0, 1]; a saturated sensor is white."""
        if min(raws[0].shape[-2:]) < 4:
            raise ValueError(f"target 'srgb' demosaics pictures of at least 4 x 4, got {tuple(raws[0].shape[-2:])}")
        methods = [self.names[number] for number in params.extras["demosaicing"].tolist()]
        return forward.develop(raws, methods, reaching_white(params.isp), params.place)


def reaching_white(setting: ISPParams) -> ISPParams:
    """The setting with gains of at least 1: with RAW darkened to its picture, the sensor's white would be grey."""
    return setting._replace(gains=setting.gains / setting.gains.amin(dim=-1, keepdim=True).clamp_max(1.0))


def through_jpeg(srgb: Tensor, quality: Tensor, chroma_420: Tensor | None = None) -> Tensor:
    """sRGB ``(B, 3, H, W)`` in [0, 1] as JPEGs of these qualities ``(B,)`` show it.

    Chroma is 4:2:2, or, where ``chroma_420`` ``(B,)`` is given, 4:2:0 where it says so and 4:4:4 elsewhere.
    """
    from rawaug.io.pictures import through_jpeg  # OpenImageIO

    in_bytes = (srgb * 255.0).round().to("cpu", torch.uint8)
    halved = ["4:2:2"] * len(srgb) if chroma_420 is None else ["4:2:0" if x else "4:4:4" for x in chroma_420.tolist()]
    shown = [through_jpeg(*one) for one in zip(in_bytes, quality.tolist(), halved, strict=True)]
    return torch.stack(shown).to(srgb) / 255.0


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
        return {"motion": motion, "frame_seed": draw_seeds(batch * self.frames, generator).reshape(batch, self.frames)}

    def frames_of(self, scene: Tensor, motion: Tensor) -> Tensor:
        """Linear light ``(B, 3, H, W)`` as the frames see it, ``(B * N, 3, H, W)``."""
        moving = moved(scene.repeat_interleave(self.frames, 0), motion.flatten(0, 1))
        moving.clamp_(min=0.0)  # beside edges a bicubic curve undershoots
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
