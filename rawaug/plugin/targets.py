r"""Targets other than RAW of one shot: linear camera RGB, developed sRGB, and bursts.

*sRGB* is developed by the camera setting that made the RAW,

.. math:: x = t(C^{-1} (g \cdot \mathrm{demosaic}(y)))

with the gains g, matrix C and tone curve t of the draw (:class:`rawaug.isp.fast.FastForward`). Noisy and clean RAW are
developed alike, by a demosaicing method drawn from those available, so that the two differ by the sensor's noise alone.
The target is the developed clean RAW, not the picture: demosaicing alone would leave the picture at 29 to 31 dB.

The mean of many developed shots is another picture, :math:`E[x(y + n)]`. Where noise is clipped at black, the mean is
brighter than the developed clean RAW, and where the tone curve bends, darker. References of real pictures are such
means. With ``shots`` the target is

.. math:: \frac{1}{2 K} \sum_{k=1}^{K} x(y + n_k) + x(y - n_k)

with noise :math:`n_k` that is independent of the input's. Opposite noise cancels wherever developing is linear, so a
pair or two are enough.

*Bursts* are several noisy frames of one scene, moved by the hand that holds the camera. Frame k shows the scene of the
first frame at ``R(angle) (p - c) + c + (dy, dx)`` for pixel p and centre c, in sensor pixels. Light is interpolated
(bicubic, and clipped at black) before the mosaic, so that each frame samples the scene at other places, and each has
its own noise. Lens shading and defects of the sensor stay where they are. Whatever comes into view at the edges is
filled by reflection.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from numbers import Real
from typing import Literal

import torch
import torch.nn.functional as F
from torch import Tensor

from rawaug import bayer
from rawaug.errors import count_of
from rawaug.isp.config import ISPParams
from rawaug.isp.fast import FastForward
from rawaug.kernels.runtime import move_together, one_thread, replace_pictures
from rawaug.noise.models import draw_seeds
from rawaug.plugin.finishing import Finish
from rawaug.plugin.jpeg import compress_jpeg
from rawaug.plugin.params import AugmentParams

Target = Literal["raw", "rgb", "srgb"]


@dataclass(frozen=True, kw_only=True)
class Srgb:
    """The target ``"srgb"``: noisy and clean developed pictures, and how they are developed.

    Args:
        demosaicing: a name from :data:`rawaug.bayer.METHODS`, or several, of which one is drawn for each picture. The
            default is all of them.
        jpeg: lowest and highest quality of the JPEG that the noisy picture goes through. The default is that of
            ``finish``, or no JPEG without it.
        finish: finish both pictures as cameras do, by noise reduction and sharpening, and the noisy one by JPEG: a
            :class:`rawaug.Finish`, or true for its defaults.
        shots: pairs of further shots with opposite noise, whose mean is the target of a picture that is finished, or
            of every picture without ``finish``. With 0 the target is the developed clean RAW.

    Raises:
        ValueError: if a demosaicing method is unknown, the quality is out of range, or the number of shots is negative.
    """

    demosaicing: tuple[str, ...] | str | None = None
    jpeg: tuple[int, int] | None = None
    finish: Finish | bool = False
    shots: int = 0

    def __post_init__(self) -> None:
        if self.jpeg is not None and (len(self.jpeg) != 2 or not 1 <= self.jpeg[0] <= self.jpeg[1] <= 100):
            raise ValueError(f"jpeg must be (lowest, highest) quality within 1 to 100, got {self.jpeg}")
        if not isinstance(self.shots, int) or self.shots < 0:
            raise ValueError(f"shots must be a number of pairs of shots, at least 0, got {self.shots!r}")
        for name in self.methods:
            bayer.require_method(name)

    @property
    def methods(self) -> tuple[str, ...]:
        """The names of the demosaicing methods to draw from."""
        if self.demosaicing is None:
            return tuple(bayer.METHODS)
        if isinstance(self.demosaicing, str):
            return (self.demosaicing,)
        return tuple(self.demosaicing)

    @property
    def finishing(self) -> Finish | None:
        """The ranges of the finishing; None without it."""
        if self.finish is True:
            return Finish()
        return self.finish or None

    @property
    def quality(self) -> tuple[int, int] | None:
        """The range of the JPEG's quality; None without it."""
        if self.jpeg or self.finishing is None:
            return self.jpeg
        return self.finishing.quality

    def sample(self, batch: int, generator: torch.Generator) -> dict[str, Tensor]:
        """Draw for ``batch`` pictures what :class:`AugmentParams` keeps as ``extras``, each ``(batch, ...)``."""
        extras = {"demosaicing": torch.randint(len(self.methods), (batch,), generator=generator)}
        if self.quality is not None:
            lowest, highest = self.quality
            extras["quality"] = torch.randint(lowest, highest + 1, (batch,), generator=generator)
        if self.finishing is not None:
            extras |= self.finishing.sample(batch, generator)
        if self.shots > 0:
            extras["shot_seed"] = draw_seeds(batch * self.shots, generator).reshape(batch, self.shots)
        return extras

    def needs_shots(self, params: AugmentParams) -> Tensor:
        """Say of each picture, ``(B,)``, whether its target is the mean of further shots."""
        if self.finishing is not None:
            return params.extras["finish"].any(dim=1) & (self.shots > 0)
        return torch.full_like(params.extras["demosaicing"], self.shots > 0, dtype=torch.bool)

    def develop(
        self,
        forward: FastForward,
        noisy: Tensor,
        clean: Tensor,
        params: AugmentParams,
        shots: Sequence[Tensor] = (),
    ) -> tuple[Tensor, Tensor]:
        """Develop noisy and clean mosaics ``(B, 1, H, W)`` of the same pictures alike.

        Args:
            forward: the ISP's forward pass.
            noisy: mosaics ``(B, 1, H, W)`` of at least 4 x 4; a saturated sensor becomes white.
            clean: mosaics of the same shape.
            params: the parameters that were drawn for them, on the host.
            shots: further noisy mosaics ``(b, 1, H, W)`` of the b pictures whose target is the mean of such shots.

        Returns:
            Noisy and clean sRGB ``(B, 3, H, W)`` in [0, 1], the noisy one after its JPEG.
        """
        if min(noisy.shape[-2:]) < 4:
            raise ValueError(f"target 'srgb' demosaics pictures of at least 4 x 4, got {tuple(noisy.shape[-2:])}")

        methods = [self.methods[number] for number in params.extras["demosaicing"].tolist()]
        noisy, clean = forward.develop((noisy, clean), methods, keep_white(params.isp), params.crop)
        if shots:
            is_averaged = self.needs_shots(params)
            own = params.map(lambda tensor: tensor[is_averaged])
            own_methods = [self.methods[number] for number in own.extras["demosaicing"].tolist()]

            pictures = forward.develop(shots, own_methods, keep_white(own.isp), own.crop)
            clean = replace_pictures(clean, is_averaged, torch.stack(pictures).mean(0))

        if self.finishing is not None:
            noisy, clean = self.finishing.apply(noisy, clean, params.extras["finish"])
        if "quality" in params.extras:
            noisy = compress_jpeg(noisy, params.extras["quality"], params.extras.get("chroma_420"))
        return noisy, clean


def keep_white(setting: ISPParams) -> ISPParams:
    """Raise the gains ``(B, 3)`` of a setting to at least 1, so that a saturated sensor is developed to white.

    With gains below 1, for RAW drawn brighter than its picture, the sensor's white would become grey.
    """
    return setting._replace(gains=setting.gains / setting.gains.amin(dim=-1, keepdim=True).clamp_max(1.0))


@dataclass(frozen=True)
class Burst:
    """Several noisy frames of a scene, taken by a moving hand.

    Args:
        frames: number N of frames.
        motion: largest shift in pixels and largest rotation in degrees.
        stops: exposure of each frame in stops, for brackets; all are equal by default.

    Raises:
        ValueError: if there is no frame, a motion is negative, or there is not one exposure for each frame.
    """

    frames: int
    motion: tuple[float, float] = (2.0, 0.5)
    stops: tuple[float, ...] | None = None

    def __post_init__(self) -> None:
        if not isinstance(self.frames, int) or self.frames < 1:
            raise ValueError(f"burst must be a number of frames, at least 1, got {self.frames!r}")
        if len(self.motion) != 2 or not all(_is_finite(most) and most >= 0 for most in self.motion):
            raise ValueError(f"motion must be (pixels, degrees), both at least 0, got {self.motion}")

        if self.stops is None:
            return
        if not all(_is_finite(stop) for stop in self.stops):
            raise ValueError(f"stops must be finite numbers, got {self.stops}")
        if len(self.stops) != self.frames:
            frames = count_of(self.frames, "frame")
            raise ValueError(f"stops must have an exposure for each of {frames}, got {len(self.stops)}")

    def sample(self, batch: int, generator: torch.Generator) -> dict[str, Tensor]:
        """Draw ``frame_seed`` ``(batch, N)`` and ``motion`` ``(batch, N, 3)``: dy, dx in pixels, angle in radians."""
        shift, degrees = self.motion
        motion = 2.0 * torch.rand(batch, self.frames, 3, generator=generator) - 1.0
        motion *= torch.tensor([shift, shift, math.radians(degrees)])
        motion[:, 0] = 0.0

        seeds = draw_seeds(batch * self.frames, generator)
        return {"motion": motion, "frame_seed": seeds.reshape(batch, self.frames)}

    def move(self, scene: Tensor, motion: Tensor) -> Tensor:
        """Make the frames ``(B * N, 3, H, W)`` that show light ``(B, 3, H, W)`` after their motions ``(B, N, 3)``."""
        frames = scene[:, None].expand(-1, self.frames, -1, -1, -1).flatten(0, 1)
        moving = move(frames, motion.flatten(0, 1))
        moving.clamp_(min=0.0)  # a bicubic curve undershoots beside edges

        still = (motion == 0.0).all(-1).flatten().nonzero()[:, 0]  # the first frame is not interpolated
        (still,) = move_together([still], scene.device)
        return moving.index_copy_(0, still, frames[still])

    def expose(self, frames: Tensor) -> Tensor:
        """Expose frames ``(B * N, 3, H, W)`` as their stops say, clipped at 1, the sensor's white."""
        if self.stops is None:
            return frames.clamp_max(1.0)
        factors = torch.exp2(torch.tensor(self.stops)).repeat(len(frames) // self.frames)
        (factors,) = move_together([factors], frames.device)
        return (frames * factors[:, None, None, None]).clamp_max_(1.0)


def _is_finite(value: object) -> bool:
    return isinstance(value, Real) and math.isfinite(value)


def move(image: Tensor, motion: Tensor) -> Tensor:
    """Move images ``(B, C, H, W)`` by motions ``(B, 3)``: dy and dx in pixels, angle in radians.

    Example:
        >>> image, motion = torch.rand(1, 3, 16, 16), torch.tensor([[1.0, 2.0, 0.0]])
        >>> torch.allclose(move(image, motion)[..., 4:12, 4:12], image[..., 5:13, 6:14], atol=1e-4)
        True
    """
    height, width = image.shape[-2:]
    dy, dx, angle = motion.to(image.dtype).unbind(1)
    cosine, sine = angle.cos(), angle.sin()
    across = torch.stack([cosine, -sine * height / width, 2.0 * dx / width], dim=1)
    down = torch.stack([sine * width / height, cosine, 2.0 * dy / height], dim=1)
    (affine,) = move_together([torch.stack([across, down], dim=1)], image.device)

    with one_thread():  # the same bits everywhere
        grid = F.affine_grid(affine, list(image.shape), align_corners=False)
        return F.grid_sample(image, grid, mode="bicubic", padding_mode="reflection", align_corners=False)
