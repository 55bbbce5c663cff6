r"""Developed pictures: sRGB in and out, tested on real pairs, or on frames with noise in RAW that LibRaw develops.

.. math:: x = L(y + n), \qquad \operatorname{var}(n) = \mathrm{shot\_var} \cdot y + \mathrm{read\_var}

L is LibRaw's own way from a DNG to sRGB: its demosaicing (AHD), its colours and its tone curve. It is not the forward
pass that a training with camera noise has seen, though ``ahd`` is a relative. The truth is L(y). Noise is keyed by
(frame, levels), so it is the same for every method. The arms are compared with classical filters on sRGB, whose
strength validation chooses for each level, and with trained RAW denoisers, which are given the levels and whose results
are developed afterwards. Real pairs are those of :mod:`rawaug.data.picture_pairs`, as ``cc15:DIR``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path
from statistics import fmean
from tempfile import TemporaryDirectory
from typing import Any, ClassVar

from torch import Tensor, nn

from denoisers.files import DEFAULT
from rawaug import bayer
from rawaug.bayer import CFA
from rawaug.data.pairs import Pair
from rawaug.data.picture_pairs import PicturePair
from rawaug.denoising.denoiser import Levels, Noisy, RawDenoiser
from rawaug.denoising.pictures import PictureDenoiser
from rawaug.evaluation.picture_trials import picture_trials
from rawaug.evaluation.scores import score
from rawaug.evaluation.trials import Trial
from rawaug.experiment.settings import Recipe
from rawaug.experiment.task import TASKS, Task, change_cfa
from rawaug.io import RawFrame, develop, write_dng
from rawaug.noise import noise_model
from rawaug.plugin.augment import RawAugment
from rawaug.plugin.dataset import RawPairs
from rawaug.plugin.targets import Target
from rawaug.progress import progress
from rawaug.registry import Spec, spec_label, split_spec
from rawaug.seeding import derive_seed, keyed_generator
from rawaug.training.sources import PictureCrops
from rawaug.training.srgb_noise import noise_on_srgb
from rawaug.training.srgb_samples import NoisyPictures, SrgbSamples
from rawaug.training.stream import TrainingStream

BLACK, WHITE = 8192.0, 65535.0
"""Black and white levels of the DNG, which leave room for noise below black."""

_DEVIATIONS = (0.01, 0.015, 0.022, 0.033, 0.05, 0.075, 0.11, 0.16)
"""The standard deviations of white noise among which validation chooses a filter's strength."""

REAL_PAIRS = "real"
"""The name of the table of real pairs, whose level is not known."""

_WITHOUT_PLANES = ("NonLocalMeans", "TotalVariation", "Wavelet")


@dataclass
class SrgbRecipe(Recipe):
    """A comparison of blind denoisers of sRGB that differ in what they are trained on.

    ``noise`` is the noise of training. ``data.validation`` and ``data.test`` may also be real pairs of developed
    pictures. Networks are given no level.

    Args:
        baselines: denoisers of RAW to compare with, by name or file.
        levels: (shot_var, read_var) of the RAW noise of validation and test frames, with a table for each.
    """

    kind: ClassVar[str] = "srgb"
    target: ClassVar[Target] = "srgb"
    from_pictures: ClassVar[bool] = True
    baselines: list[str] = field(default_factory=lambda: [DEFAULT])
    self_ensemble: bool = False
    levels: list[tuple[float, float]] = field(default_factory=lambda: [(5e-4, 1e-6), (2e-3, 1e-5), (8e-3, 1e-4)])

    @property
    def noise_in_test(self) -> None:
        """None, since the noise is that of each table's level."""
        return None

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.levels or self.data.validation is None:
            raise ValueError("levels and data.validation: give at least one level and frames to choose weights on")

        for label, arm in self.arms.items():
            network = self.network(label)
            reads_level = arm.noise_level is not None
            settings = network.settings.get("channels"), network.settings.get("variance_map", True)
            if network.start is None and settings != (3, reads_level):
                raise ValueError(
                    f"denoiser.settings: set channels: 3, variance_map: {str(reads_level).lower()} for the network of "
                    f"arms.{label}, as noise_level requires"
                )

        for spec in self.classical:
            name, _ = split_spec(spec)
            if name not in _WITHOUT_PLANES:
                raise ValueError(f"classical: {name} filters RAW; for sRGB use one of {', '.join(_WITHOUT_PLANES)}")


@TASKS.register("srgb")
class SrgbTask(Task):
    """Denoisers of developed pictures."""

    settings = SrgbRecipe

    def stream(self, arm: str, cfa: CFA, seed: int) -> TrainingStream:
        """Make crops of pictures with the camera's noise, noise drawn on them, or both in the arm's shares."""
        settings, train = self.recipe.arms[arm], self.recipe.loop(arm)
        pictures = self.frames["pictures"]

        camera = None
        if settings.srgb_noise is None or settings.srgb_share < 1.0:
            isp, draw = change_cfa(self.isp, cfa), settings.draw or self.recipe.draw
            augment = RawAugment(isp, self.noise, draw=draw, target=settings.srgb or "srgb")
            camera = PictureCrops(RawPairs(pictures, augment, train.crop, zoom=settings.zoom))

        on_pictures = None
        if settings.srgb_noise is not None:
            on_pictures = NoisyPictures(pictures, noise_on_srgb(settings.srgb_noise), train.crop, settings.zoom)

        samples = SrgbSamples(camera, on_pictures, settings.srgb_share, settings.noise_level)
        return TrainingStream(None, samples, train.batch, 1.0, derive_seed(seed, "stream"))

    def validation(self, cfa: CFA) -> Sequence[Trial]:
        """Take the frames at every level, developed."""
        return self.developed_validation

    @cached_property
    def developed_validation(self) -> list[Trial]:
        """The validation frames at every level; they choose weights, and the strength of filters."""
        return srgb_trials(self.watched, self.recipe.levels, "develop validation")

    def test(self) -> Sequence[Trial]:
        """Take the frames at every level, developed."""
        return srgb_trials(self.frames["test"], self.recipe.levels, "develop test")

    def denoiser(self, name: str, network: nn.Module, cfa: CFA, views: int = 1) -> PictureDenoiser:
        """Make a denoiser of the network, in tiles; one that reads a level estimates it."""
        return PictureDenoiser.of(network, self.recipe.device, name=name, views=views, checked=False)

    def filters(self, table: str) -> list[PictureDenoiser]:
        """Make the filters, each at its best strength on the validation frames of this level."""
        same_level = [trial for trial in self.developed_validation if trial.table == table]
        return [best_filter(spec, same_level or self.developed_validation) for spec in self.recipe.classical]

    def shown(self, trials: Sequence[Trial]) -> list[Trial]:
        """Choose the first frame of each level."""
        first: dict[str, Trial] = {}
        for trial in trials:
            first.setdefault(trial.table, trial)
        return list(first.values())


def srgb_trials(pairs: Sequence[Any], levels: Sequence[Levels], label: str) -> list[Trial]:
    """Make trials of frames in the domain ``srgb``: RAW at every level, pairs of pictures as they are."""
    trials: list[Trial] = []
    for pair in progress(pairs, label=label, unit="frame"):
        if isinstance(pair, PicturePair):
            (trial,) = picture_trials([pair])
            trials.append(replace(trial, condition="", strength=REAL_PAIRS))
        else:
            trials += _drawn_trials(pair, levels)

    return trials


def _drawn_trials(pair: Pair, levels: Sequence[Levels]) -> list[Trial]:
    """Make trials of a RAW frame at every level, as LibRaw develops it, with the RAW before."""
    clean = developed(pair.clean.mosaic, pair)
    packed = bayer.pack(pair.clean.mosaic[None], pair.cfa)
    ways = {"then LibRaw": partial(_unpacked_and_developed, pair=pair)}

    trials = []
    for level in levels:
        noise = noise_model(level)
        params = noise.sample(1, keyed_generator("developed noise", pair.name, *map(str, level)))
        noisy, variance = noise.apply_with_variance(packed, params)

        inputs: dict[str, Noisy] = {RawDenoiser.takes: Noisy(noisy, variance, level, pair.cfa)}
        image = _unpacked_and_developed(noisy, pair)
        strength = f"shot variance {level[0]:g}, read variance {level[1]:g}"
        trials.append(Trial(image, clean, None, pair.name, "srgb", strength=strength, inputs=inputs, ways=ways))

    return trials


def _unpacked_and_developed(packed: Tensor, pair: Pair) -> Tensor:
    return developed(bayer.unpack(packed, pair.cfa)[0], pair)


def developed(mosaic: Tensor, pair: Pair) -> Tensor:
    """Develop a mosaic ``(1, H, W)`` by LibRaw in the colours of its pair: sRGB ``(1, 3, H, W)`` of 8 bits."""
    mosaic = mosaic.clamp(-BLACK / (WHITE - BLACK), 1.0)
    colour = pair.clean.white_balance, pair.clean.white_balance, pair.clean.color_matrix
    frame = RawFrame(mosaic, pair.cfa, (BLACK,) * 4, WHITE, *colour, "rawaug", name=pair.name)

    with TemporaryDirectory() as folder:
        path = Path(folder) / "frame.dng"
        write_dng(path, frame)
        return develop(path)[None] / 255.0


def best_filter(spec: Spec, trials: Sequence[Trial]) -> PictureDenoiser:
    """Choose the filter of the deviation with the highest mean PSNR on these trials."""
    best, best_psnr = None, float("-inf")
    for deviation in _DEVIATIONS:
        denoiser = PictureDenoiser.of(spec, name=spec_label(spec), level=deviation)
        psnr = fmean(row.psnr for row in score([denoiser], trials))
        if best is None or psnr > best_psnr:
            best, best_psnr = denoiser, psnr

    assert best is not None
    return best
