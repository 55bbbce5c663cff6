r"""Denoisers of developed pictures: trained on sRGB, tested on camera frames with noise in RAW that LibRaw develops.

.. math:: x = L(y + n), \qquad \operatorname{var}(n) = \mathrm{shot\_var} \cdot y + \mathrm{read\_var}

L is LibRaw's own way from a DNG to sRGB: its demosaicing (AHD), its colours and its tone curve, not the forward pass
that a training with camera noise has seen, though ``ahd`` is a relative. The truth is L(y). Noise is keyed by (frame,
levels), the same for every method. Beside the arms stand classical filters on sRGB, whose strength validation chooses
for each level, and trained RAW denoisers, which are given the levels and developed after.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import cached_property
from pathlib import Path
from statistics import fmean
from tempfile import TemporaryDirectory
from typing import Any, ClassVar, NamedTuple

import torch
from torch import Tensor

import denoisers
from denoisers.files import DEFAULT
from denoisers.network import Denoiser
from rawaug import bayer
from rawaug.data.pairs import Pair, Sample
from rawaug.evaluation.contestants import Contestant, contestant
from rawaug.evaluation.page import Figure, Page, Part, draw_curves, most_detailed
from rawaug.evaluation.scores import label_of
from rawaug.evaluation.tables import print_rows
from rawaug.experiment.denoising import Results, TrainingRun
from rawaug.experiment.recipe import Recipe
from rawaug.files import write_json
from rawaug.io import RawFrame, develop, write_dng
from rawaug.io.pictures import encode_png, write_picture
from rawaug.isp.model import DictionaryISP
from rawaug.kernels.runtime import find_device
from rawaug.metrics import psnr, ssim
from rawaug.noise import NoiseModel, noise_model
from rawaug.plugin.targets import Target
from rawaug.progress import progress
from rawaug.registry import EXPERIMENTS, FILTERS, name_and_settings
from rawaug.seeding import keyed_generator
from rawaug.training.validation import Watched

BLACK, WHITE = 8192.0, 65535.0
"""Of the DNG: room for noise below black."""
DEVIATIONS = (0.01, 0.015, 0.022, 0.033, 0.05, 0.075, 0.11, 0.16)
"""Of the white noise that a filter is told, to choose from."""
PANEL = 192
"""Side of the crops of the picture."""
_WITHOUT_PLANES = ("NonLocalMeans", "TotalVariation", "Wavelet")

Levels = tuple[float, float]
Scores = dict[str, dict[str, float]]
"""By level, ``psnr`` and ``ssim`` on sRGB."""


@dataclass
class SrgbRecipe(Recipe):
    """A comparison of blind denoisers of sRGB by what they are trained on.

    Of the keys ``noise`` is that of training; ``views`` and ``self_ensemble``, which are for RAW, change nothing.

    Args:
        rivals: denoisers of RAW to compare with, as ``rawaug benchmark`` names them, in place of ``untouched``.
        levels: (shot_var, read_var) of the RAW noise of validation and test, a row of the table each.
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
            network = self.network_of(label)
            given = network.settings.get("channels"), network.settings.get("variance_map")
            if network.start is None and given != (3, False):
                raise ValueError("denoiser.settings: a blind network of sRGB has channels: 3, variance_map: false")
        for spec in self.classical:
            if (name := name_and_settings(spec)[0]) not in _WITHOUT_PLANES:
                raise ValueError(f"classical: {name} is for RAW; on sRGB use one of {', '.join(_WITHOUT_PLANES)}")


@EXPERIMENTS.register("srgb")
def run(recipe: SrgbRecipe, overwrite: bool = False) -> Results:
    """Train the arms and score them on developed frames; by arm, a table of :data:`Scores` a seed."""
    return SrgbRun(recipe, overwrite, {}).all_stages()


class Shot(NamedTuple):
    """A frame at one level: packed RAW as a :class:`Sample`, and both as LibRaw develops them, ``(1, 3, H, W)``."""

    pair: Pair
    levels: Levels
    raw: Sample
    noisy: Tensor
    clean: Tensor


Method = Callable[[Shot], Tensor]
"""The denoised sRGB ``(1, 3, H, W)`` of a shot, whose clean parts it does not look at."""


class SrgbRun(TrainingRun):
    """The stages of a training, with tests on sRGB."""

    recipe: SrgbRecipe

    def __init__(self, recipe: SrgbRecipe, overwrite: bool, given: Mapping[str, Any]) -> None:
        super().__init__(recipe, overwrite, given)
        self.rivals = [contestant(name, find_device(recipe.device)) for name in recipe.rivals]

    @cached_property
    def test_shots(self) -> dict[Levels, list[Shot]]:
        """The test frames by level."""
        return shots_of(self.test, self.recipe.levels, "develop test")

    @cached_property
    def validation_shots(self) -> dict[Levels, list[Shot]]:
        """The validation frames by level."""
        return shots_of(self.validation, self.recipe.levels, "develop validation")

    def watched(self, isp: DictionaryISP, noise: NoiseModel) -> list[Watched]:
        shots = [shot for found in self.validation_shots.values() for shot in found]
        told = [torch.full_like(shot.noisy, sum(shot.levels)) for shot in shots]  # their order alone counts
        return [Watched(shot.noisy, shot.clean, level) for shot, level in zip(shots, told, strict=True)]

    def evaluated(self, arm: str, model: Denoiser, noise: NoiseModel, isp: DictionaryISP, seed: int) -> dict[str, Any]:
        scores = scored(self.applied(model), self.test_shots, f"seed {seed}, {arm}")
        write_json(scores, self.place(arm, seed) / "evaluation.json")
        return scores

    def applied(self, model: Denoiser) -> Method:
        """A network of sRGB as a method."""
        device = find_device(self.recipe.device)
        model = model.to(device)
        return lambda shot: denoisers.tiled(model, shot.noisy.to(device)).cpu()

    def others(self) -> dict[str, dict[Levels, Method]]:
        """What the arms are compared with, by level: the noisy picture, filters on sRGB, RAW denoisers."""
        found: dict[str, dict[Levels, Method]] = {"noisy": dict.fromkeys(self.recipe.levels, lambda shot: shot.noisy)}
        for spec in self.recipe.classical:
            chosen = {level: best_filter(spec, shots) for level, shots in self.validation_shots.items()}
            found[label_of(spec)] = chosen
        for rival in self.rivals:
            found[f"{rival.name}, then LibRaw"] = dict.fromkeys(self.recipe.levels, raw_way(rival))
        return found

    def reported(self, results: Results, models: dict[str, Denoiser], noise: NoiseModel, isp: DictionaryISP) -> None:
        """``results.json``, the table, crops at 100 % and the page."""
        others, test = self.others(), self.test_shots
        scores = {name: scored(by_level, test, name) for name, by_level in others.items()}
        own = {name: one.own for name, one in self.own.items()}
        content = {"recipe": asdict(self.recipe), "results": results, "others": scores, "own_noise": own}
        write_json(content, self.folder / "results.json")
        arms = {arm: dict.fromkeys(test, self.applied(model)) for arm, model in models.items()}
        picture = crops({**others, **arms}, test)
        write_picture(self.folder / "picture.png", picture)
        means = {**{name: [one] for name, one in scores.items()}, **results}
        rows = [[name, *(_cell(runs, key_of(level)) for level in test)] for name, runs in means.items()]
        head = ["sRGB PSNR / SSIM", *(key_of(level) for level in test)]
        title = f"{self.recipe.name} on {self.data.test}, steps: {self.recipe.train.steps}, seeds: {len(self.seeds)}"
        page = Page(title)
        page.add_curves(draw_curves({arm: [self.place(arm, s) / "log.csv" for s in self.seeds] for arm in models}))
        page.parts.append(Part("Scores", head=head, rows={name: cells for name, *cells in rows}))
        caption = f"crops at 100 %, a level in each row: {', '.join([*others, *arms, 'clean'])}"
        page.parts.append(Part("Pictures", figures=[Figure(encode_png(picture), "crops", caption=caption)]))
        page.write(self.folder / "report.html", asdict(self.recipe))
        print_rows(title, head, rows)
        print(f"table: {self.folder / 'results.json'}\npicture: {self.folder / 'picture.png'}")


def key_of(levels: Levels) -> str:
    """A level's name in tables and files."""
    return f"{levels[0]:g}, {levels[1]:g}"


def _cell(runs: Sequence[Scores], level: str) -> str:
    return f"{fmean(run[level]['psnr'] for run in runs):.2f} / {fmean(run[level]['ssim'] for run in runs):.3f}"


def shots_of(pairs: Sequence[Pair], levels: Sequence[Levels], label: str) -> dict[Levels, list[Shot]]:
    """Every frame at every level, by level."""
    found: dict[Levels, list[Shot]] = {level: [] for level in levels}
    for pair in progress(pairs, label=label, unit="frame"):
        packed, clean = bayer.pack(pair.raw[None], pair.cfa), developed(pair.raw, pair)
        for level in levels:
            noise = noise_model(level)
            params = noise.sample(1, keyed_generator("developed noise", pair.name, *map(str, level)))
            noisy, told = noise.apply_with_variance(packed, params)
            shown = developed(bayer.unpack(noisy, pair.cfa)[0], pair)
            found[level].append(Shot(pair, level, Sample(noisy, packed, told), shown, clean))
    return found


def developed(mosaic: Tensor, pair: Pair) -> Tensor:
    """What LibRaw makes of a mosaic ``(1, H, W)`` in the colours of its pair: sRGB ``(1, 3, H, W)`` of 8 bits."""
    mosaic = mosaic.clamp(-BLACK / (WHITE - BLACK), 1.0)
    colour = pair.white_balance, pair.white_balance, pair.color_matrix
    frame = RawFrame(mosaic, pair.cfa, (BLACK,) * 4, WHITE, *colour, "rawaug", name=pair.name)
    with TemporaryDirectory() as folder:
        write_dng(path := Path(folder) / "frame.dng", frame)
        return develop(path)[None] / 255.0


def raw_way(rival: Contestant) -> Method:
    """A denoiser of RAW before the development, told the levels."""

    def method(shot: Shot) -> Tensor:
        denoised = rival.run(shot.raw.noisy, shot.raw.variance, shot.pair.cfa)
        return developed(bayer.unpack(denoised, shot.pair.cfa)[0], shot.pair)

    return method


def filtered(spec: Any, deviation: float) -> Method:
    """A classical filter of white noise of this deviation, on the three colours."""
    denoiser = FILTERS.make(spec)

    def method(shot: Shot) -> Tensor:
        planes = (shot.noisy[0] / deviation).permute(1, 2, 0).contiguous().numpy()
        return torch.from_numpy(deviation * denoiser.denoise(planes)).permute(2, 0, 1)[None].float()

    return method


def best_filter(spec: Any, shots: Sequence[Shot]) -> Method:
    """The filter of the deviation with the highest mean PSNR on these shots."""
    methods = [filtered(spec, deviation) for deviation in DEVIATIONS]
    return max(methods, key=lambda method: fmean(_psnr(method(shot), shot) for shot in shots))


def _psnr(denoised: Tensor, shot: Shot) -> float:
    return psnr(denoised.clamp(0.0, 1.0), shot.clean).item()


def scored(method: Method | Mapping[Levels, Method], shots: Mapping[Levels, Sequence[Shot]], label: str) -> Scores:
    """Mean PSNR and SSIM by level."""
    scores: Scores = {}
    for level, found in progress(list(shots.items()), label=label, unit="level"):
        one = method[level] if isinstance(method, Mapping) else method
        pictures = [one(shot).clamp(0.0, 1.0) for shot in found]
        both = [[m(x, s.clean).item() for m in (psnr, ssim)] for x, s in zip(pictures, found, strict=True)]
        scores[key_of(level)] = dict(zip(("psnr", "ssim"), map(fmean, zip(*both, strict=True)), strict=True))
    return scores


def crops(methods: Mapping[str, Mapping[Levels, Method]], shots: Mapping[Levels, Sequence[Shot]]) -> Tensor:
    """Of the first frame at each level a row of crops, every method's and the clean one; sRGB ``(3, h, w)``."""
    rows = []
    for level, (shot, *_) in shots.items():
        top, left = (2 * place for place in most_detailed(shot.raw.clean))
        pictures = [*(by_level[level](shot) for by_level in methods.values()), shot.clean]
        rows.append(torch.cat([x[0, :, top : top + PANEL, left : left + PANEL] for x in pictures], dim=-1))
    return torch.cat(rows, dim=-2).clamp(0.0, 1.0)
