r"""Denoisers of developed pictures: trained on sRGB, tested on camera frames with noise in RAW that LibRaw develops,
or on real pairs (``cc15:DIR``, see :mod:`rawaug.data.picture_pairs`).

.. math:: x = L(y + n), \qquad \operatorname{var}(n) = \mathrm{shot\_var} \cdot y + \mathrm{read\_var}

L is LibRaw's own way from a DNG to sRGB: its demosaicing (AHD), its colours and its tone curve, not the forward pass
that a training with camera noise has seen, though ``ahd`` is a relative. The truth is L(y). Noise is keyed by (frame,
levels), the same for every method. Beside the arms stand classical filters on sRGB, whose strength validation chooses
for each level, and trained RAW denoisers, which are given the levels and developed after.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path
from statistics import fmean
from tempfile import TemporaryDirectory
from typing import Any, ClassVar

import torch
from torch import Tensor

from denoisers.files import DEFAULT
from rawaug import bayer
from rawaug.bayer import noise_variance
from rawaug.data.pairs import Pair
from rawaug.data.picture_pairs import PicturePair
from rawaug.denoising.denoiser import Levels, Noisy, RawDenoiser
from rawaug.denoising.pictures import PictureDenoiser
from rawaug.evaluation.figures import Panels, find_detail, panels_of
from rawaug.evaluation.page import Figure, Page
from rawaug.evaluation.picture_trials import picture_trials
from rawaug.evaluation.scores import NoisyInput, Row, score
from rawaug.evaluation.tables import print_rows
from rawaug.evaluation.trials import Trial
from rawaug.experiment.denoising import Results, TrainingRun
from rawaug.experiment.recipe import EXPERIMENTS, Recipe
from rawaug.files import write_json
from rawaug.io import RawFrame, develop, write_dng
from rawaug.io.pictures import encode_png, write_picture
from rawaug.isp.model import DictionaryISP
from rawaug.noise import noise_model
from rawaug.plugin.augment import RawAugment
from rawaug.plugin.dataset import RawPairs
from rawaug.plugin.targets import Target
from rawaug.progress import progress
from rawaug.registry import Spec, spec_label, split_spec
from rawaug.seeding import derive_seed, keyed_generator
from rawaug.training.srgb_noise import NoisyPictures, SrgbSamples, noise_on_srgb
from rawaug.training.stream import PictureCrops, TrainingStream

BLACK, WHITE = 8192.0, 65535.0
"""Of the DNG: room for noise below black."""
DEVIATIONS = (0.01, 0.015, 0.022, 0.033, 0.05, 0.075, 0.11, 0.16)
"""Of the white noise that a filter is told, to choose from."""
PANEL = 192
"""Side of the crops of the picture."""
REAL = "real"
"""What stands for a level in the tables of real pairs."""
_WITHOUT_PLANES = ("NonLocalMeans", "TotalVariation", "Wavelet")

Scores = dict[str, dict[str, float]]
"""By level, ``psnr`` and ``ssim`` on sRGB."""


@dataclass
class SrgbRecipe(Recipe):
    """A comparison of blind denoisers of sRGB by what they are trained on.

    Of the keys ``noise`` is that of training; ``views`` and ``self_ensemble``, which are for RAW, change nothing.
    ``data.validation`` and ``data.test`` may be real pairs of developed pictures, too; networks are told no level.

    Args:
        rivals: denoisers of RAW to compare with, by name or file, in place of ``untouched``.
        levels: (shot_var, read_var) of the RAW noise of validation and test frames, a row of the table each.
    """

    target: ClassVar[Target] = "srgb"
    rivals: list[str] = field(default_factory=lambda: [DEFAULT])
    levels: list[tuple[float, float]] = field(default_factory=lambda: [(5e-4, 1e-6), (2e-3, 1e-5), (8e-3, 1e-4)])

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.levels or self.data.validation is None:
            raise ValueError("levels and data.validation: give at least one level and frames to choose weights on")
        if self.untouched:
            raise ValueError("untouched: denoisers to compare with are named in rivals")
        for label in self.arms:
            network, told = self.network_of(label), self.arms[label].told is not None
            given = network.settings.get("channels"), network.settings.get("variance_map", True)
            if network.start is None and given != (3, told):
                wanted = f"channels: 3, variance_map: {str(told).lower()}"
                raise ValueError(f"denoiser.settings: the network of arms.{label} has {wanted}, as told says")
        for spec in self.classical:
            if (name := split_spec(spec)[0]) not in _WITHOUT_PLANES:
                raise ValueError(f"classical: {name} is for RAW; on sRGB use one of {', '.join(_WITHOUT_PLANES)}")

    @property
    def validation_noise(self) -> object:
        """``levels``."""
        return self.levels


@EXPERIMENTS.register("srgb")
def run(recipe: SrgbRecipe, overwrite: bool = False) -> Results:
    """Train the arms and score them on developed frames; by arm, a table of :data:`Scores` a seed."""
    return SrgbRun(recipe, overwrite, {}).run_stages()


class SrgbRun(TrainingRun):
    """The stages of a training, with tests on sRGB."""

    recipe: SrgbRecipe

    def __init__(self, recipe: SrgbRecipe, overwrite: bool, given: Mapping[str, Any]) -> None:
        super().__init__(recipe, overwrite, given)
        self.rivals = [RawDenoiser.of(name, recipe.device).require_mosaic() for name in recipe.rivals]

    @cached_property
    def tests(self) -> list[Trial]:
        """The test frames at every level."""
        return srgb_trials(self.test, self.recipe.levels, "develop test")

    @cached_property
    def validations(self) -> list[Trial]:
        """The validation frames at every level."""
        return srgb_trials(self.validation, self.recipe.levels, "develop validation")

    def stream(self, arm: str, isp: DictionaryISP, seed: int) -> TrainingStream:
        recipe, own = self.recipe, self.recipe.arms[arm]
        camera = drawn = None
        if own.srgb_noise is None or own.srgb_share < 1.0:
            augment = RawAugment(isp, self.noise, draw=own.draw, target=own.srgb or "srgb")
            camera = PictureCrops(RawPairs(self.pictures, augment, recipe.train.crop, zoom=own.zoom))
        if own.srgb_noise is not None:
            drawn = NoisyPictures(self.pictures, noise_on_srgb(own.srgb_noise), recipe.train.crop, own.zoom)
        samples = SrgbSamples(camera, drawn, own.srgb_share, own.told)
        return TrainingStream(None, samples, recipe.train.batch, 1.0, derive_seed(seed, "stream"))

    def test_trials(self) -> Sequence[Trial]:
        """The test frames at every level."""
        return self.tests

    def validation_trials(self, isp: DictionaryISP) -> list[Trial]:
        """The validation frames at every level."""
        return self.validations

    def evaluate(self, arm: str, seed: int) -> dict[str, Any]:
        """PSNR and SSIM by level."""
        scores = means(score([self.picture_denoiser(arm)], self.tests, f"seed {seed}, {arm}"))[arm]
        write_json(scores, self.arm_folder(arm, seed) / "evaluation.json")
        return scores

    def picture_denoiser(self, arm: str) -> PictureDenoiser:
        """An arm's network of sRGB as it is tested."""
        return PictureDenoiser.of_network(arm, self.models[arm], self.recipe.device)

    @cached_property
    def methods(self) -> dict[str, list[Any]]:
        """What the arms are compared with, by level: the noisy picture, filters on sRGB, RAW denoisers."""
        found: dict[str, list[Any]] = {}
        for level in dict.fromkeys(trial.strength for trial in self.tests):
            like = at_level(self.validations, level) or self.validations
            filters = [best_filter(spec, like) for spec in self.recipe.classical]
            found[level] = [NoisyInput("noisy"), *filters] + (self.rivals if level != REAL else [])
        return found

    def report(self) -> None:
        """Write ``results.json``, the table, crops at 100 % and the page."""
        results = self.results
        rows = [row for level, some in self.methods.items() for row in score(some, at_level(self.tests, level), level)]
        scores = means(rows)
        known = [
            (p.name, noise_variance(p.raw, *p.own_noise)) for p in self.test if isinstance(p, Pair) and p.own_noise
        ]
        own = {name: variance.mean().item() for name, variance in known}
        content = {"recipe": asdict(self.recipe), "results": results, "others": scores, "own_noise": own}
        write_json(content, self.folder / "results.json")
        arms = [self.picture_denoiser(arm) for arm in self.models]
        firsts = [panels_of([*some[1:], *arms], at_level(self.tests, level)[0]) for level, some in self.methods.items()]
        picture = crops(firsts)
        write_picture(self.folder / "picture.png", picture)
        cells = {name: [one] for name, one in scores.items()} | results
        table = {name: [_cell(runs, level) for level in self.methods] for name, runs in cells.items()}
        head = ["sRGB PSNR / SSIM", *self.methods]
        title = f"{self.recipe.name} on {self.data.test}, steps: {self.recipe.train.steps}, seeds: {len(self.seeds)}"
        page = Page(title)
        page.add_curves(self.curves())
        page.add("Scores", head=head, rows=table)
        caption = f"crops at 100 %, a level in each row: {', '.join(firsts[0].images)}"
        page.add("Pictures", figures=[Figure(encode_png(picture), "crops", caption=caption)])
        page.write(self.folder / "report.html", asdict(self.recipe))
        print_rows(title, head, [[name, *row] for name, row in table.items()])
        print(f"table: {self.folder / 'results.json'}\npicture: {self.folder / 'picture.png'}")


def key_of(levels: Levels) -> str:
    """A level's name in tables and files."""
    return f"{levels[0]:g}, {levels[1]:g}"


def at_level(trials: Sequence[Trial], level: str) -> list[Trial]:
    """The trials whose noise has this level."""
    return [trial for trial in trials if trial.strength == level]


def means(rows: Iterable[Row]) -> dict[str, Scores]:
    """Mean PSNR and SSIM by denoiser and level."""
    found: dict[str, dict[str, list[Row]]] = {}
    for row in rows:
        found.setdefault(row.denoiser, {}).setdefault(row.strength, []).append(row)
    return {
        name: {
            level: {key: fmean(getattr(row, key) for row in some) for key in ("psnr", "ssim")}
            for level, some in by_level.items()
        }
        for name, by_level in found.items()
    }


def _cell(runs: Sequence[Scores], level: str) -> str:
    return f"{fmean(run[level]['psnr'] for run in runs):.2f} / {fmean(run[level]['ssim'] for run in runs):.3f}"


def srgb_trials(pairs: Sequence[Pair], levels: Sequence[Levels], label: str) -> list[Trial]:
    """Every frame at every level as LibRaw develops it, in the domain ``srgb``, with the RAW before; a pair of pictures
    as it is.
    """
    found: list[Trial] = []
    for pair in progress(pairs, label=label, unit="frame"):
        if isinstance(pair, PicturePair):
            found.append(replace(picture_trials([pair])[0], condition="", strength=REAL))
            continue
        packed, clean = bayer.pack(pair.raw[None], pair.cfa), developed(pair.raw, pair)
        ways = {"then LibRaw": partial(_unpacked_and_developed, pair=pair)}
        for level in levels:
            noise = noise_model(level)
            params = noise.sample(1, keyed_generator("developed noise", pair.name, *map(str, level)))
            noisy, told = noise.apply_with_variance(packed, params)
            shown, raw = ways["then LibRaw"](noisy), Noisy(noisy, told, level, pair.cfa)
            found.append(Trial(shown, clean, None, pair.name, "srgb", strength=key_of(level), raw=raw, ways=ways))
    return found


def _unpacked_and_developed(packed: Tensor, pair: Pair) -> Tensor:
    return developed(bayer.unpack(packed, pair.cfa)[0], pair)


def developed(mosaic: Tensor, pair: Pair) -> Tensor:
    """What LibRaw makes of a mosaic ``(1, H, W)`` in the colours of its pair: sRGB ``(1, 3, H, W)`` of 8 bits."""
    mosaic = mosaic.clamp(-BLACK / (WHITE - BLACK), 1.0)
    colour = pair.white_balance, pair.white_balance, pair.color_matrix
    frame = RawFrame(mosaic, pair.cfa, (BLACK,) * 4, WHITE, *colour, "rawaug", name=pair.name)
    with TemporaryDirectory() as folder:
        write_dng(path := Path(folder) / "frame.dng", frame)
        return develop(path)[None] / 255.0


def best_filter(spec: Spec, trials: Sequence[Trial]) -> PictureDenoiser:
    """The filter of the deviation with the highest mean PSNR on these trials."""
    filters = [replace(PictureDenoiser.of_filter(spec, level), name=spec_label(spec)) for level in DEVIATIONS]
    return max(filters, key=lambda one: fmean(row.psnr for row in score([one], trials)))


def crops(rows: Sequence[Panels]) -> Tensor:
    """A row of crops of each frame, every image's where the clean one has most detail; sRGB ``(3, h, w)``."""
    found = []
    for row in rows:
        top, left = find_detail(row.trial.clean, PANEL)
        parts = [row.show(image[..., top : top + PANEL, left : left + PANEL]) for image in row.images.values()]
        found.append(torch.cat(parts, dim=-1))
    return torch.cat(found, dim=-2)
