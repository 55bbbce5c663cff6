"""One denoiser for mosaics of every pattern, on frames of full colour that are mosaicked anew in each.

The truth is that of :mod:`rawaug.experiment.demosaicing`: a pixel of full colour from each cell of a finer frame.
Results are demosaiced by LibRaw, X-Trans by Markesteijn's interpolation, and compared with it; Quad-Bayer, which LibRaw
does not know, by :meth:`rawaug.bayer.Pattern.demosaic`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import partial
from typing import Any, ClassVar

from torch import Tensor

from denoisers.mosaic import with_planes
from denoisers.network import Denoiser
from rawaug import bayer
from rawaug.bayer import CFA
from rawaug.data.development import exposure_of
from rawaug.data.pairs import Pair
from rawaug.denoise.denoiser import RawDenoiser
from rawaug.evaluation.scores import Row, require_numbers, score, summary
from rawaug.evaluation.tables import print_table
from rawaug.evaluation.trials import Trial
from rawaug.experiment.demosaicing import by_libraw, developed, full_colour
from rawaug.experiment.denoising import Results, TrainingRun
from rawaug.experiment.recipe import Recipe
from rawaug.files import fingerprint, write_json
from rawaug.isp.model import DictionaryISP
from rawaug.noise import NoiseModel, noise_model
from rawaug.plugin.augment import RawAugment
from rawaug.registry import EXPERIMENTS
from rawaug.seeding import derive_seed, keyed_generator
from rawaug.training.mosaics import MosaicCrops
from rawaug.training.stream import TrainingStream


@dataclass
class MosaicRecipe(Recipe):
    """Networks for mosaics of every pattern.

    Args:
        patterns: shares of the patterns in training, by name.
        test_patterns: those of validation and test frames.
        test_noise: of validation and test frames, in place of ``noise``.
        rivals: denoisers of Bayer RAW to compare with, as ``rawaug benchmark`` names them.
    """

    together: ClassVar[bool] = True
    patterns: dict[str, float] = field(default_factory=lambda: {"RGGB": 0.4, "XTRANS": 0.4, "QUAD-RGGB": 0.2})
    test_patterns: list[str] = field(default_factory=lambda: ["RGGB", "XTRANS", "QUAD-RGGB"])
    test_noise: tuple[float, float] | str = "cycleisp_sidd"
    rivals: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in (*self.patterns, *self.test_patterns):
            bayer.pattern(name)
        if not self.patterns or min(self.patterns.values()) < 0 or not sum(self.patterns.values()) > 0:
            raise ValueError(f"patterns: shares must be at least 0, and one above, got {self.patterns}")
        if any(arm.augmented < 1.0 or not arm.sees_clean for arm in self.arms.values()):
            raise ValueError("arms: mosaics of every pattern are made from pictures; set augmented: 1 and no estimator")


@EXPERIMENTS.register("mosaics")
def run(recipe: MosaicRecipe, overwrite: bool = False, **given: Sequence[Pair]) -> Results:
    """Train the arms of a recipe and score them by pattern; arguments as of the kind ``training``."""
    return MosaicRun(recipe, overwrite, given).all_stages()


def mosaic_trial(pair: Pair, cfa: str, noise: NoiseModel, seed: int = 0) -> Trial:
    """A frame as a test case of a pattern, in the domain ``rgb``; the noise is keyed by (seed, name) alone.

    Packed RAW of Bayer's patterns, the mosaic ``(1, 1, H, W)`` of others.
    """
    rgb = full_colour(pair)
    squares = bayer.pack(bayer.pattern(cfa).mosaic(rgb), CFA.RGGB)
    params = noise.sample(1, keyed_generator(seed, "test noise", pair.name))
    noisy = noise.apply(squares, params)
    raw, variance = (_as_given(x, cfa) for x in (noisy, noise.variance(noisy, params)))
    levels = (params["shot_var"].item(), params["read_var"].item()) if "shot_var" in params else None
    develop = partial(developed, pair=pair, exposure=exposure_of(bayer.pack_rgb(rgb, CFA.RGGB), pair))
    way = {"demosaiced": partial(demosaiced, pair=pair, cfa=cfa)}
    about: dict[str, Any] = {"condition": cfa, "levels": levels, "cfa": bayer.canonical_cfa(cfa), "develop": develop}
    return Trial(raw, rgb, variance, pair.name, "rgb", ways=way, **about)


def _as_given(squares: Tensor, cfa: str) -> Tensor:
    """Squares of 2 x 2 pixels as they come, ``(1, 4, h, w)``, as a denoiser gets RAW of the pattern."""
    mosaic = bayer.unpack(squares, CFA.RGGB)
    return bayer.pack(mosaic, cfa) if cfa in CFA.__members__ else mosaic


def mosaic_of(image: Tensor, cfa: str) -> Tensor:
    """RAW as a denoiser gets it, packed or not, as the mosaic ``(1, 1, H, W)``."""
    return image if image.shape[1] == 1 else bayer.unpack(image, cfa)


def demosaiced(image: Tensor, pair: Pair, cfa: str) -> Tensor:
    """RAW of a frame in a pattern as linear camera RGB ``(1, 3, H, W)``."""
    mosaic = mosaic_of(image, cfa)
    return bayer.pattern(cfa).demosaic(mosaic) if cfa.startswith("QUAD") else by_libraw(mosaic, pair, "AHD", cfa)


def watched_trial(pair: Pair, cfa: str, noise: NoiseModel) -> Trial:
    """A frame as a network of mosaics itself gets it, the planes of its colours beside it, in the domain ``raw``."""
    trial = mosaic_trial(pair, cfa, noise)
    assert trial.variance is not None
    known = bayer.pattern(cfa)
    raw, variance = (mosaic_of(x, cfa) for x in (trial.noisy, trial.variance))
    return Trial(with_planes(raw, known), known.mosaic(trial.clean), variance, pair.name, condition=cfa)


class MosaicRun(TrainingRun):
    """A run on patterns drawn at random."""

    recipe: MosaicRecipe

    def __init__(self, recipe: MosaicRecipe, overwrite: bool, given: Mapping[str, Sequence[Pair]]) -> None:
        self.test_noise = noise_model(recipe.test_noise)
        self.rivals = [RawDenoiser.of(name, recipe.device).require_mosaic() for name in recipe.rivals]
        super().__init__(recipe, overwrite, given)

    def pattern(self, arm: str, isp: DictionaryISP) -> CFA:
        return CFA.RGGB

    def stream(self, arm: str, isp: DictionaryISP, noise: NoiseModel, seed: int) -> TrainingStream:
        recipe, own = self.recipe, self.recipe.arms[arm]
        augment = RawAugment(isp, noise, draw=own.draw)
        crops = MosaicCrops(self.pictures, augment, recipe.train.crop, own.zoom, recipe.patterns)
        return TrainingStream(None, crops, recipe.train.batch, 1.0, derive_seed(seed, "stream"))

    def watched(self, isp: DictionaryISP, noise: NoiseModel) -> list[Trial]:
        frames = self.frames["validation"]
        return [watched_trial(pair, cfa, self.test_noise) for cfa in self.recipe.test_patterns for pair in frames]

    def weights_key(self, arm: str, isp: DictionaryISP, seed: int) -> str:
        return fingerprint(super().weights_key(arm, isp, seed), self.recipe.patterns, self.recipe.test_patterns)

    def evaluated(self, arm: str, model: Denoiser, noise: NoiseModel, isp: DictionaryISP, seed: int) -> dict[str, Any]:
        rows = self._rows(self.denoiser(arm, model, isp), f"evaluate {arm}")
        return {cfa: summary(found, self._noisy_of(cfa)) for cfa, found in rows.items()}

    def _rows(self, denoiser: Any, label: str = "") -> dict[str, list[Row]]:
        """Of a denoiser, by the patterns that it takes."""
        bayer_only = isinstance(denoiser, RawDenoiser) and denoiser.of_any is None
        patterns = [cfa for cfa in self.recipe.test_patterns if cfa in CFA.__members__ or not bayer_only]
        trials = (mosaic_trial(pair, cfa, self.test_noise) for cfa in patterns for pair in self.test)
        rows = list(score([denoiser], trials, label))
        return {cfa: [row for row in rows if row.condition == cfa] for cfa in patterns}

    def _noisy_of(self, cfa: str) -> list[Row]:
        if not hasattr(self, "_inputs"):
            self._inputs = self._rows(self.input)
        return self._inputs[cfa]

    def reported(self, results: Results, models: dict[str, Denoiser], noise: NoiseModel, isp: DictionaryISP) -> None:
        others = {rival.name: self._rows(rival, rival.name) for rival in self.rivals}
        tables = {}
        for cfa in self.recipe.test_patterns:
            found = {arm: [{"plain": run[cfa]} for run in runs] for arm, runs in results.items()}
            known = {name: summary(rows[cfa], self._noisy_of(cfa)) for name, rows in others.items() if cfa in rows}
            tables[cfa] = {"results": found, "rivals": known}
            print_table(found, f"{self.recipe.name} tested on {self.data.test}: {cfa}, linear camera RGB", known)
        file = self.folder / "results.json"
        write_json({"recipe": asdict(self.recipe), **tables}, file)
        print(f"table: {file}")
        require_numbers([run[cfa] for runs in results.values() for run in runs for cfa in run])
