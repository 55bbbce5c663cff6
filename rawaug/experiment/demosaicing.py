r"""Joint demosaicing and denoising beside one after the other, on a truth that no demosaicing has made.

.. math:: x = (R, (G_r + G_b) / 2, B), \qquad y \sim N(M x, \mathrm{shot\_var}\, M x + \mathrm{read\_var})

The full-colour truth x takes each pixel from one 2 x 2 cell of a finer frame, whose four sites are means around the
cell's centre (:func:`rawaug.bayer.bin_mosaic`, ``together``), so that it has real optics, colours in register and
little noise of its own; M keeps one colour a site. A denoiser of RAW is followed by each demosaicing: those of
:func:`rawaug.bayer.demosaic`, and LibRaw's, which works on white-balanced RAW, as in its own pictures. PSNR and SSIM
are those of linear camera RGB, and of one fixed development of it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, ClassVar

import torch
from torch import Tensor

from denoisers.files import DEFAULT
from denoisers.network import PACKED, Denoiser
from rawaug import bayer
from rawaug.bayer import CFA
from rawaug.data.development import exposure_of, rendered
from rawaug.data.pairs import Pair, Sample
from rawaug.errors import extra
from rawaug.evaluation.contestants import Contestant, contestant
from rawaug.evaluation.scores import Score, network_method, require_numbers, summary
from rawaug.evaluation.tables import print_table
from rawaug.experiment.denoising import Results, TrainingRun
from rawaug.experiment.recipe import Recipe
from rawaug.files import write_json
from rawaug.io import RawFrame, write_dng
from rawaug.isp.model import DictionaryISP
from rawaug.kernels.runtime import find_device
from rawaug.metrics import psnr, ssim
from rawaug.noise import NoiseModel, noise_model
from rawaug.plugin.targets import Target
from rawaug.progress import progress
from rawaug.registry import EXPERIMENTS
from rawaug.seeding import keyed_generator
from rawaug.training.validation import Watched

LIBRAW = ("VNG", "PPG", "AHD", "DCB", "DHT", "AAHD")
"""LibRaw's demosaicings by its names."""
BLACK, WHITE = 1024, 65535
"""Of the DNGs that LibRaw demosaics."""


@dataclass
class JointRecipe(Recipe):
    """Networks that demosaic and denoise at once.

    Args:
        test_noise: of validation and test frames, in place of ``noise``.
        rivals: denoisers of RAW to compare with, as ``rawaug benchmark`` names them, in place of ``classical`` and
            ``untouched``.
        demosaicing: what each of them is followed by: bilinear, malvar, or LibRaw's VNG, PPG, AHD, DCB, DHT or AAHD.
    """

    target: ClassVar[Target] = "rgb"
    test_noise: tuple[float, float] | str = "cycleisp_sidd"
    rivals: list[str] = field(default_factory=lambda: ["NonLocalMeans", DEFAULT])
    demosaicing: list[str] = field(default_factory=lambda: ["malvar", "AHD", "DCB"])

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in self.demosaicing:
            if name not in (*bayer.STENCILS, *LIBRAW):
                known = ", ".join((*bayer.STENCILS, *LIBRAW))
                raise ValueError(f"demosaicing {name!r} is unknown; use one of {known}")
        if self.classical or self.untouched:
            raise ValueError("classical and untouched: denoisers to compare with are named in rivals")


@EXPERIMENTS.register("demosaic")
def run(recipe: JointRecipe, overwrite: bool = False, **given: Sequence[Pair]) -> Results:
    """Train the arms of a recipe and compare them with its rivals; arguments as of the kind ``training``."""
    return JointRun(recipe, overwrite, given).all_stages()


def full_colour(pair: Pair) -> Tensor:
    """The truth of a frame: linear camera RGB ``(1, 3, H/2, W/2)`` cut to even sides, each pixel from one cell."""
    red, green, other_green, blue = bayer.pack(pair.raw[None], pair.cfa).unbind(1)
    rgb = torch.stack([red, (green + other_green) / 2, blue], dim=1)
    height, width = (side // 2 * 2 for side in rgb.shape[-2:])
    return rgb[..., :height, :width].contiguous()


def frozen_mosaic(pair: Pair, noise: NoiseModel, seed: int = 0) -> Sample:
    """A frame as a test case: noisy packed RGGB RAW, full-colour truth, variance; noise keyed by (seed, name)."""
    rgb = full_colour(pair)
    clean = bayer.pack_rgb(rgb, CFA.RGGB)
    params = noise.sample(1, keyed_generator(seed, "test noise", pair.name))
    noisy = noise.apply(clean, params)
    return Sample(noisy, rgb, noise.variance(noisy, params))


def demosaiced(packed: Tensor, pair: Pair, method: str) -> Tensor:
    """Packed RGGB RAW ``(1, 4, h, w)`` of a frame as linear camera RGB ``(1, 3, 2h, 2w)``."""
    mosaic = bayer.unpack(packed, CFA.RGGB)
    return _by_libraw(mosaic, pair, method) if method in LIBRAW else bayer.demosaic(mosaic, CFA.RGGB, method)


def _by_libraw(mosaic: Tensor, pair: Pair, method: str) -> Tensor:
    with extra("raw"):
        import rawpy

    gains = torch.tensor(pair.white_balance).reshape(3, 1, 1) / min(pair.white_balance)
    room = gains.max()  # LibRaw clips at white what the gains lift beyond it
    mosaic = (mosaic[0] / room).clamp(-BLACK / (WHITE - BLACK), 1.0)
    colour = pair.white_balance, pair.white_balance, pair.color_matrix
    frame = RawFrame(mosaic, CFA.RGGB, (BLACK,) * 4, WHITE, *colour, pair.camera, name=pair.name)
    settings = {"output_color": rawpy.ColorSpace.raw, "gamma": (1, 1), "no_auto_bright": True, "output_bps": 16}
    settings |= {"adjust_maximum_thr": 0, "user_flip": 0, "user_wb": [*gains.flatten().tolist(), gains[1].item()]}
    with TemporaryDirectory() as folder:
        path = Path(folder) / "frame.dng"
        write_dng(path, frame)
        with rawpy.imread(str(path)) as raw:
            rgb = raw.postprocess(demosaic_algorithm=rawpy.DemosaicAlgorithm[method], **settings)
    return (torch.from_numpy(rgb).permute(2, 0, 1).float() / 65535 * room / gains)[None]


class Scene:
    """A test case and how it is developed."""

    def __init__(self, pair: Pair, noise: NoiseModel) -> None:
        self.pair, self.sample = pair, frozen_mosaic(pair, noise)
        self.exposure = exposure_of(bayer.pack_rgb(self.sample.clean, CFA.RGGB), pair)

    def develop(self, image: Tensor) -> Tensor:
        """Linear RGB ``(1, 3, H, W)``, or packed RAW at its own size, as sRGB ``(3, H, W)``."""
        rgb = image[0, [0, 1, 3]] if image.shape[1] == PACKED else image[0]
        return rendered(rgb, self.pair.white_balance, self.pair.color_matrix, self.exposure, least=None)

    def score(self, rgb: Tensor) -> Score:
        """Of a result, beside that of the noisy RAW demosaiced as it is."""
        noisy = demosaiced(self.sample.noisy, self.pair, "malvar")
        return Score(self.pair.name, *self._compared(rgb), *self._compared(noisy))

    def _compared(self, rgb: Tensor) -> tuple[float, float, float, float]:
        clean = self.sample.clean
        shown = [self.develop(image)[None] for image in (rgb, clean)]
        return psnr(rgb, clean).item(), ssim(rgb, clean).item(), psnr(*shown).item(), ssim(*shown).item()


class JointRun(TrainingRun):
    """A run whose arms give full colour."""

    recipe: JointRecipe

    def __init__(self, recipe: JointRecipe, overwrite: bool, given: Mapping[str, Sequence[Pair]]) -> None:
        self.test_noise = noise_model(recipe.test_noise)
        self.rivals = [contestant(name, find_device(recipe.device)) for name in recipe.rivals]
        super().__init__(recipe, overwrite, given)

    def pattern(self, arm: str, isp: DictionaryISP) -> CFA:
        return CFA.RGGB

    def watched(self, isp: DictionaryISP, noise: NoiseModel) -> list[Watched]:
        scenes = [Scene(pair, self.test_noise) for pair in self.frames["validation"]]
        return [Watched(*scene.sample, scene.develop) for scene in scenes] or super().watched(isp, noise)

    def evaluated(self, arm: str, model: Denoiser, noise: NoiseModel, isp: DictionaryISP, seed: int) -> dict[str, Any]:
        model, result = model.to(find_device(self.recipe.device)), {}
        for kind, views in {"plain": 1, "self_ensemble": self.recipe.views}.items():
            if kind == "plain" or self.recipe.self_ensemble:
                method = network_method(model, CFA.RGGB, views=views)
                scores = [scene.score(method(scene.pair, scene.sample)) for scene in self.scenes(f"{arm}, {kind}")]
                result[kind] = summary(scores)
        return result

    def scenes(self, label: str) -> Iterator[Scene]:
        """The test cases, one in memory at a time."""
        for pair in progress(self.test, label=f"evaluate {label}", unit="image"):
            yield Scene(pair, self.test_noise)

    def reported(self, results: Results, models: dict[str, Denoiser], noise: NoiseModel, isp: DictionaryISP) -> None:
        others = {name: scores for rival in self.rivals for name, scores in self.followed(rival).items()}
        file = self.folder / "results.json"
        write_json({"recipe": asdict(self.recipe), "results": results, "rivals": others}, file)
        title = f"{self.recipe.name} tested on {self.data.test}: linear camera RGB"
        print_table(results, title, others)
        print(f"table: {file}")
        require_numbers([*(run[kind] for runs in results.values() for run in runs for kind in run), *others.values()])

    def followed(self, rival: Contestant) -> dict[str, Any]:
        """Summaries of a denoiser of RAW, by the demosaicing that follows."""
        scores: dict[str, list[Score]] = {f"{rival.name}, {method}": [] for method in self.recipe.demosaicing}
        for scene in self.scenes(rival.name):
            denoised = rival.run(scene.sample.noisy, scene.sample.variance, CFA.RGGB)
            for method in self.recipe.demosaicing:
                scores[f"{rival.name}, {method}"].append(scene.score(demosaiced(denoised, scene.pair, method)))
        return {name: summary(found) for name, found in scores.items()}
