r"""Frames without a clean RAW: real noisy ones, and those that are made once and for all from sRGB pictures.

Noise that is drawn anew whenever a picture comes up is averaged out over the epochs, and in effect the network would be
shown clean RAW. The camera setting and the noise of a picture are therefore keyed by (seed, index) for good; only
crops, turns and what an estimator adds change from step to step.

Estimators add noise of the noise's own variance, ``shot_var x + read_var``, to a frame. Taken at the noisy signal y in
place of x, that variance is right on average, but large where the noise happens to be positive. The added noise then
depends on the noise, which their derivation excludes. The signal of a real frame is therefore estimated first, by
non-local means. (At ``shot_var`` 0.008 and ``read_var`` 3e-4 on the demo camera's frames, the noise of r2r's input
explains 0.3 standard deviations of its target with y, 0.06 in flat areas and 0.11 at edges with the estimate.)
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from statistics import median
from typing import Any

import torch
from torch import Tensor

from denoisers.classical import NonLocalMeans, Stabilised
from rawaug import bayer
from rawaug.bayer import CFA, crop_to_cfa
from rawaug.data.development import develop_packed
from rawaug.data.frames import Frames
from rawaug.data.pairs import Pair
from rawaug.evaluation.trials import Trial
from rawaug.noise import ShotReadModel, camera_law
from rawaug.plugin.augment import RawAugment
from rawaug.plugin.pictures import to_rgb_tensor, trim_to_even
from rawaug.progress import progress
from rawaug.seeding import keyed_generator
from rawaug.training.estimators import R2R, NoisyCrop, SelfSupervised
from rawaug.training.sources import packed_crop


def signal_estimate(noisy: Tensor, shot_var: float, read_var: float, cfa: CFA) -> Tensor:
    """Estimate the signal of a noisy mosaic, ``(1, H, W)``, by non-local means.

    Without shot noise the signal does not matter, and the mosaic is returned as it is.

    Args:
        noisy: ``(1, H, W)``.
        shot_var: slope of the noise's variance over the signal.
        read_var: its variance at black.
        cfa: pattern of the mosaic.
    """
    if not shot_var > 0:
        return noisy

    packed = bayer.pack(noisy[None], cfa)
    denoised = Stabilised(NonLocalMeans())(packed, shot_var=shot_var, read_var=read_var)
    return bayer.unpack(denoised, cfa)[0]


CACHED = 64
"""At most this many frames made of pictures stay in memory."""


@dataclass(frozen=True, eq=False)
class NoisyFrame:
    """Noisy RAW of one scene.

    Attributes:
        name: name of the frame.
        shots: mosaics ``(N, H, W)`` of the scene.
        shot_var: slope of the noise's variance over the signal.
        read_var: its variance at black.
        cfa: pattern of the mosaics.
        clean: the scene without noise ``(1, H, W)``, if it was made from a picture.
    """

    name: str
    shots: Tensor
    shot_var: float
    read_var: float
    cfa: CFA
    clean: Tensor | None = None

    @cached_property
    def signal(self) -> Tensor:
        """The scene without noise ``(1, H, W)``; for a real frame it is an estimate, which takes 0.5 s a megapixel."""
        if self.clean is not None:
            return self.clean

        return signal_estimate(self.shots[:1], self.shot_var, self.read_var, self.cfa)


def drop_clean(pair: Pair) -> Pair:
    """Return the pair without anything that was derived from a clean frame.

    A noisy capture, if there is one, replaces ``clean``, and the camera's picture of it replaces ``srgb``; without such
    a picture, the capture is developed (bilinear demosaic, the camera's white balance and matrix, the sRGB curve). A
    pair without a capture is a RAW file as shot, which is noisy itself.
    """
    if pair.noisy is None:
        return pair
    if pair.noisy_srgb is not None:
        return replace(pair, clean=pair.noisy, srgb=pair.noisy_srgb)

    packed = bayer.pack(pair.noisy.mosaic[None], pair.cfa)
    developed = develop_packed(packed, pair.cfa, pair)
    srgb = (developed * 255.0).round().to(torch.uint8)
    return replace(pair, clean=pair.noisy, srgb=srgb, registered=True)


def frame_levels(pair: Pair, camera: Mapping[str, Any] | None) -> tuple[float, float]:
    """Look up (shot_var, read_var) of a real noisy frame: its own levels, or those of its camera's law at its ISO.

    Raises:
        ValueError: if it has neither.
    """
    if pair.noisy is not None and pair.noisy.noise_profile is not None:
        return pair.noisy.noise_profile

    if camera is None:
        raise ValueError(
            f"{pair.name}: has no noise levels, and those of noise are the pictures'; "
            "set noise: camera to measure them on the frames that the ISP is fitted to"
        )

    try:
        return camera_law(camera).at(pair.clean.iso)
    except ValueError as error:
        raise ValueError(f"{pair.name}: {error}") from None


def noisy_frame(pair: Pair, camera: Mapping[str, Any] | None) -> NoisyFrame:
    """Make a real noisy frame with its levels; ``camera`` is a noise law as an ISP's file holds it."""
    shot_var, read_var = frame_levels(pair, camera)
    return NoisyFrame(pair.name, pair.clean.mosaic, shot_var, read_var, pair.cfa)


FAINT = 45.0
"""Noisy frames above this PSNR, in dB, have hardly any noise to remove."""


def faintness_note(frames: Sequence[NoisyFrame]) -> str:
    """Write a line that warns of frames with hardly any noise, by their levels; it is empty if there is enough."""
    if not frames:
        return ""

    decibels = []
    for frame in frames:
        variance = float(bayer.noise_variance(frame.shots, frame.shot_var, frame.read_var).mean())
        decibels.append(-10.0 * math.log10(max(variance, 1e-12)))
    typical = median(decibels)

    if typical < FAINT:
        return ""
    return (
        f"these frames have next to no noise ({typical:.1f} dB PSNR): a denoiser can learn little from them; take "
        "frames of a higher ISO, or these as clean ones with stronger noise added: rawaug run fewshot --noise "
        "cycleisp_sidd"
    )


class FrozenPictures(Frames[NoisyFrame]):
    """Noisy RAW frames of sRGB pictures, which never change; up to :data:`CACHED` of them stay in memory.

    Args:
        pictures: a Dataset of pictures.
        augment: makes RAW of them; its noise must be shot and read noise.
        seed: seed of the camera settings and the noise.
        shots: number of noisy shots of each scene.
    """

    def __init__(self, pictures: Any, augment: RawAugment, seed: int, shots: int = 1) -> None:
        if not isinstance(augment.noise, ShotReadModel):
            raise ValueError("self-supervised training needs noise with known shot_var and read_var, such as a preset")
        super().__init__([f"picture {index}" for index in range(len(pictures))])
        self.pictures = pictures
        self.augment = augment
        self.seed = seed
        self.shots = shots
        self._cache: dict[int, NoisyFrame] = {}

    def read(self, index: int) -> NoisyFrame:
        """Return the frame of a picture, the same at every call."""
        if index in self._cache:
            return self._cache[index]

        frame = self._make(index)
        if len(self._cache) < CACHED:
            self._cache[index] = frame
        return frame

    def _make(self, index: int) -> NoisyFrame:
        srgb = trim_to_even(to_rgb_tensor(self.pictures[index]))[None]
        params = self.augment.sample(srgb, keyed_generator(self.seed, "frozen", index))
        cfa = self.augment.isp.cfa

        shots = []
        for shot in range(self.shots):
            seed = torch.randint(2**62, (1,), generator=keyed_generator(self.seed, "shot", index, shot))
            pair = self.augment.apply(srgb, params._replace(noise={**params.noise, "seed": seed}))
            shots.append(bayer.unpack(pair.noisy, cfa)[0])

        return NoisyFrame(
            self.names[index],
            torch.cat(shots),
            shot_var=params.noise["shot_var"].item(),
            read_var=params.noise["read_var"].item(),
            cfa=cfa,
            clean=bayer.unpack(pair.clean, cfa)[0],
        )


class NoisyCrops:
    """Crops of noisy frames, in eight views that keep the CFA, as an estimator's training samples.

    Args:
        frames: frames of any patterns.
        estimator: makes a sample of a crop.
        crop: side in pixels.
        cfa: the pattern in which all crops are packed.
    """

    def __init__(self, frames: Sequence[NoisyFrame], estimator: SelfSupervised, crop: int, cfa: CFA) -> None:
        self.frames = frames
        self.estimator = estimator
        self.crop = crop
        self.cfa = cfa

        if estimator.adds_noise and not isinstance(frames, FrozenPictures):  # before processes share them
            for frame in progress(frames, label="signal of noisy frames", unit="frame"):
                _ = frame.signal

    def draw(self, generator: torch.Generator) -> Any:
        """Draw a sample of packed RAW ``(4, crop / 2, crop / 2)``; raise ValueError if the frame has too few shots."""
        frame = self.frames[int(torch.randint(len(self.frames), (), generator=generator))]
        if len(frame.shots) < self.estimator.shots:
            name = type(self.estimator).__name__
            count = len(frame.shots)
            raise ValueError(f"{frame.name}: {name} needs {self.estimator.shots} shots of a scene, got {count}")

        signal = frame.shots[:1]
        if self.estimator.adds_noise:
            signal = frame.signal
        packed = packed_crop(frame.name, [frame.shots, signal], frame.cfa, self.crop, self.cfa, generator)

        crop = NoisyCrop(packed[:-1], packed[-1], frame.shot_var, frame.read_var)
        params = self.estimator.sample(packed.shape[1:], generator)
        return self.estimator.apply(crop, params)


def r2r_trials(frames: Sequence[NoisyFrame], cfa: CFA) -> list[Trial]:
    """Make r2r pairs ``(1, 4, h, w)`` of whole noisy frames, whose score needs no clean frame.

    The error against a target of independent noise is the error against the clean frame plus that noise's variance,
    which is constant. The weights that score best are therefore the best, as far as the estimate of the signal is
    right, though the decibels are lower than against a clean frame.
    """
    estimator = R2R()
    trials = []
    for frame in frames:
        images = torch.cat([frame.shots[:1], frame.signal])
        packed = bayer.pack(crop_to_cfa(images, frame.cfa, cfa)[:, None], cfa)

        crop = NoisyCrop(packed[:1], packed[1], frame.shot_var, frame.read_var)
        params = estimator.sample(packed.shape[1:], keyed_generator(0, "held out", frame.name))
        sample = estimator.apply(crop, params)
        trials.append(Trial(sample.noisy[None], sample.clean[None], sample.variance[None]))
    return trials
