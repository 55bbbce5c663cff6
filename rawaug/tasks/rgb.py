"""Linear camera RGB: networks turn noisy packed RAW into full colour; baselines are RAW denoisers and a demosaicing.

The demosaicings are those of :func:`rawaug.bayer.demosaic`, and LibRaw's.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

from torch import Tensor

from denoisers.files import DEFAULT
from rawaug import bayer
from rawaug.denoising.denoiser import Noisy
from rawaug.evaluation.scores import NOISY
from rawaug.evaluation.trials import Trial, make_trials
from rawaug.isp.model import DictionaryISP
from rawaug.noise import NoiseModel
from rawaug.plugin.targets import Target
from rawaug.tasks.base import TASKS
from rawaug.tasks.full_colour import LIBRAW, FullColourRecipe, FullColourTask, rgb_trial


@dataclass
class RgbRecipe(FullColourRecipe):
    """Networks that demosaic and denoise at once.

    Args:
        demosaicing: the demosaicings that follow each denoiser of RAW in ``classical`` and ``baselines``: bilinear,
            malvar, or LibRaw's VNG, PPG, AHD, DCB, DHT or AAHD.
    """

    kind: ClassVar[str] = "rgb"
    target: ClassVar[Target] = "rgb"
    classical: list[str | dict[str, Any]] = field(default_factory=lambda: ["NonLocalMeans"])
    baselines: list[str] = field(default_factory=lambda: [DEFAULT])
    demosaicing: list[str] = field(default_factory=lambda: ["malvar", "AHD", "DCB"])

    def __post_init__(self) -> None:
        super().__post_init__()
        choices = *bayer.STENCILS, *LIBRAW
        for name in self.demosaicing:
            if name not in choices:
                raise ValueError(f"demosaicing {name!r} is unknown; use one of {', '.join(choices)}")


class _MalvarInput:
    """The noisy input, demosaiced by Malvar, He and Cutler's interpolation."""

    name, takes = NOISY.name, "raw"

    def __call__(self, noisy: Noisy, /) -> Tensor:
        return bayer.demosaic(bayer.unpack(noisy.image, noisy.cfa), noisy.cfa, "malvar")


@TASKS.register("rgb")
class RgbTask(FullColourTask):
    """Networks that also demosaic."""

    settings = RgbRecipe
    upscale = 2
    input = _MalvarInput()

    def validation_trials(
        self, frames: Sequence[Any], pictures: Any, isp: DictionaryISP, noise: NoiseModel
    ) -> Sequence[Trial]:
        """Take the frames with the noise of the test; without any frames, take pictures as RAW."""
        if not frames:
            return super().validation_trials(frames, pictures, isp, noise)

        return [rgb_trial(pair, self.noise) for pair in frames]

    def test_trials(self, frames: Sequence[Any], isp: DictionaryISP, noise: NoiseModel) -> Sequence[Trial]:
        """Take the frames in RGGB, with every demosaicing."""
        ways = {method: method for method in self.recipe.demosaicing}
        return make_trials(frames, lambda pair: rgb_trial(pair, self.noise, ways))

    def trials_key(self) -> Sequence[Any]:
        """Return the noise of the test."""
        return (self.recipe.test_noise,)
