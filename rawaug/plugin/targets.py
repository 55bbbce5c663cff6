r"""What a pair holds besides RAW: linear camera RGB, or sRGB developed by the camera setting that made the RAW.

.. math:: x = t(C^{-1} (g \cdot \mathrm{demosaic}(y)))

with the gains g, matrix C and tone curve t of the draw (:class:`rawaug.isp.fast.FastForward`). Noisy and clean RAW are
developed alike, by a demosaicing drawn from those at hand, so that the two differ by the sensor's noise alone: the
developed clean RAW is the target, not the picture, which demosaicing alone would leave at 29 to 31 dB.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, get_args

import torch
from torch import Tensor

from rawaug import bayer
from rawaug.isp.config import ISPParams
from rawaug.isp.fast import FastForward
from rawaug.plugin.params import AugmentParams

Target = Literal["raw", "rgb", "srgb"]


class Targets:
    """The target of a :class:`rawaug.RawAugment`, whose settings these are, and what is drawn for it."""

    def __init__(
        self, target: Target, demosaicing: str | Sequence[str] | None, jpeg: tuple[int, int] | None, pattern: str
    ) -> None:
        if target not in get_args(Target):
            raise ValueError(f"target {target!r} is unknown; use one of {', '.join(get_args(Target))}")
        if target != "srgb" and (demosaicing, jpeg) != (None, None):
            raise ValueError(f"demosaicing and jpeg are for target 'srgb', not {target!r}; omit them")
        if target == "srgb" and pattern not in bayer.CFA.__members__:
            raise ValueError(f"target 'srgb' demosaics Bayer patterns, not {pattern}; use target 'rgb' or 'raw'")
        if jpeg is not None and not (len(jpeg) == 2 and 1 <= jpeg[0] <= jpeg[1] <= 100):
            raise ValueError(f"jpeg must be (lowest, highest) quality within 1 to 100, got {jpeg}")
        names = list(bayer.STENCILS) if demosaicing is None else demosaicing
        self.names = (names,) if isinstance(names, str) else tuple(names)
        for name in self.names:
            bayer.demosaicing("RGGB", name)  # an unknown one is refused
        self.target, self.jpeg = target, jpeg

    def sample(self, batch: int, generator: torch.Generator) -> dict[str, Tensor]:
        """Number of the demosaicing and quality of the JPEG, each ``(batch,)``; nothing for RAW and linear RGB."""
        if self.target != "srgb":
            return {}
        drawn = {"demosaicing": torch.randint(len(self.names), (batch,), generator=generator)}
        if self.jpeg is not None:
            drawn["quality"] = torch.randint(self.jpeg[0], self.jpeg[1] + 1, (batch,), generator=generator)
        return drawn

    def develop(self, forward: FastForward, raws: Sequence[Tensor], params: AugmentParams) -> list[Tensor]:
        """Mosaics of the same pictures, ``(B, 1, H, W)`` each, to sRGB in [0, 1]; a saturated sensor is white."""
        if min(raws[0].shape[-2:]) < 4:
            raise ValueError(f"target 'srgb' demosaics pictures of at least 4 x 4, got {tuple(raws[0].shape[-2:])}")
        methods = [self.names[number] for number in params.extras["demosaicing"].tolist()]
        return forward.develop(raws, methods, reaching_white(params.isp), params.place)


def reaching_white(setting: ISPParams) -> ISPParams:
    """The setting with gains of at least 1: with RAW darkened to its picture, the sensor's white would be grey."""
    return setting._replace(gains=setting.gains / setting.gains.amin(dim=-1, keepdim=True).clamp_max(1.0))


def through_jpeg(srgb: Tensor, quality: Tensor) -> Tensor:
    """sRGB ``(B, 3, H, W)`` in [0, 1] as JPEGs of these qualities ``(B,)`` show it."""
    from rawaug.io.pictures import through_jpeg  # OpenImageIO

    in_bytes = (srgb * 255.0).round().to("cpu", torch.uint8)
    shown = [through_jpeg(picture, q) for picture, q in zip(in_bytes, quality.tolist(), strict=True)]
    return torch.stack(shown).to(srgb) / 255.0
