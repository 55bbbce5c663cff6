r"""Experiments on a truth of full colour that no demosaicing has made.

.. math:: x = (R, (G_r + G_b) / 2, B), \qquad y \sim N(M x, \mathrm{shot\_var}\, M x + \mathrm{read\_var})

The truth x takes each pixel from one 2 x 2 cell of a finer frame, whose four sites are means around the cell's centre
(:func:`rawaug.bayer.bin_mosaic`, ``together``), so that it has real optics, colours in register and little noise of its
own; M keeps one colour a site. PSNR and SSIM are those of linear camera RGB, and of one fixed development of it.

``demosaic``: networks that demosaic and denoise at once, beside denoisers of RAW that are followed by each
demosaicing: those of :func:`rawaug.bayer.demosaic`, and LibRaw's, which works on white-balanced RAW, as in its own
pictures.

``mosaics``: one denoiser for mosaics of every pattern. The truth is mosaicked anew in each. Results are demosaiced by
LibRaw, X-Trans by Markesteijn's interpolation; Quad-Bayer, which LibRaw does not know, by
:meth:`rawaug.bayer.Pattern.demosaic`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, ClassVar

import torch
from torch import Tensor

from denoisers.files import DEFAULT
from denoisers.mosaic import lines_before, with_planes
from denoisers.network import PACKED
from rawaug import bayer
from rawaug.bayer import CFA
from rawaug.data.development import exposure_of, render_rgb
from rawaug.data.pairs import Pair
from rawaug.denoising.denoiser import Noisy, RawDenoiser
from rawaug.errors import extra
from rawaug.evaluation.scores import NOISY, group_rows, require_numbers, score, summary
from rawaug.evaluation.tables import print_table
from rawaug.evaluation.trials import TEST_NOISE, Trial, freeze_noise, make_trials
from rawaug.experiment.denoising import Results, TrainingRun
from rawaug.experiment.recipe import EXPERIMENTS, NoiseSetting, Recipe
from rawaug.files import fingerprint, write_json
from rawaug.io import RawFrame, write_dng
from rawaug.isp.model import DictionaryISP
from rawaug.noise import NoiseModel, noise_model
from rawaug.plugin.augment import RawAugment
from rawaug.plugin.targets import Target
from rawaug.seeding import derive_seed
from rawaug.training.stream import MosaicCrops, TrainingStream

LIBRAW = ("VNG", "PPG", "AHD", "DCB", "DHT", "AAHD")
"""LibRaw's demosaicings by its names."""
LEAST = 512
"""The smallest side that LibRaw's interpolation of X-Trans takes."""
BLACK, WHITE = 1024, 65535
"""Black and white level of the DNGs that LibRaw demosaics."""


def full_colour(pair: Pair) -> Tensor:
    """The truth of a frame: linear camera RGB ``(1, 3, H/2, W/2)`` cut to even sides, each pixel from one cell."""
    red, green, other_green, blue = bayer.pack(pair.raw[None], pair.cfa).unbind(1)
    rgb = torch.stack([red, (green + other_green) / 2, blue], dim=1)
    height, width = (side // 2 * 2 for side in rgb.shape[-2:])
    return rgb[..., :height, :width].contiguous()


def rgb_trial(
    pair: Pair, noise: NoiseModel, ways: Mapping[str, str] | None = None, cfa: str = CFA.RGGB, **about: Any
) -> Trial:
    """A frame as a test case in the domain ``rgb``: noisy RAW of a pattern against its truth of full colour.

    Args:
        pair: the frame, of which each cell becomes a pixel.
        noise: drawn on the mosaic of the truth; of every 2 x 2 square the same in all patterns.
        ways: the demosaicings, by the names of rows, that follow a denoiser of RAW.
        cfa: the pattern.
        about: other attributes of the trial, such as ``condition``.
    """
    rgb = full_colour(pair)
    squares = bayer.pack(bayer.pattern(cfa).mosaic(rgb), CFA.RGGB)
    noisy, variance, levels = freeze_noise(squares, noise, 0, TEST_NOISE, pair.name)
    if cfa != CFA.RGGB:
        mosaics = (bayer.unpack(image, CFA.RGGB) for image in (noisy, variance))
        noisy, variance = (bayer.pack(x, cfa) if cfa in CFA.__members__ else x for x in mosaics)
    about |= {"levels": levels, "cfa": bayer.canonical_cfa(cfa), "ways": {}}
    about["develop"] = partial(develop, pair=pair, exposure=exposure_of(bayer.pack_rgb(rgb, CFA.RGGB), pair))
    for name, method in (ways or {}).items():
        about["ways"][name] = partial(demosaic, pair=pair, method=method, cfa=cfa)
    return Trial(noisy, rgb, variance, pair.name, "rgb", **about)


def develop(image: Tensor, pair: Pair, exposure: float) -> Tensor:
    """Linear RGB ``(1, 3, H, W)``, or packed RAW at its own size, to sRGB ``(3, H, W)`` in the frame's colours."""
    rgb = image[0, [0, 1, 3]] if image.shape[1] == PACKED else image[0]
    return render_rgb(rgb, pair.white_balance, pair.color_matrix, exposure, least=None)


def mosaic_of(image: Tensor, cfa: str) -> Tensor:
    """RAW as a denoiser takes it, packed or not, as the mosaic ``(1, 1, H, W)``."""
    return image if image.shape[1] == 1 else bayer.unpack(image, cfa)


def demosaic(image: Tensor, pair: Pair, method: str, cfa: str = CFA.RGGB) -> Tensor:
    """RAW as a denoiser gives it to linear camera RGB ``(1, 3, H, W)``.

    Args:
        image: packed RAW ``(1, 4, H/2, W/2)``, or a mosaic ``(1, 1, H, W)``.
        pair: the frame that it is of.
        method: one of :data:`LIBRAW`, or of :func:`rawaug.bayer.demosaic` for Bayer's patterns; others have their own.
        cfa: the pattern.
    """
    mosaic = mosaic_of(image, cfa)
    if method in LIBRAW:
        return libraw_demosaic(mosaic, pair, method, cfa)
    return bayer.demosaic(mosaic, cfa, method) if cfa in CFA.__members__ else bayer.pattern(cfa).demosaic(mosaic)


def libraw_demosaic(mosaic: Tensor, pair: Pair, method: str, cfa: str = CFA.RGGB, **more: Any) -> Tensor:
    """A mosaic ``(1, 1, H, W)`` to linear camera RGB ``(1, 3, H, W)`` by LibRaw.

    Args:
        mosaic: a small one is continued by its whole cells.
        pair: the frame that it is of, whose colours LibRaw is given.
        method: one of :data:`LIBRAW`; X-Trans has Markesteijn's interpolation, whatever is given.
        cfa: the pattern of the mosaic.
        more: arguments of rawpy's ``postprocess``.
    """
    with extra("raw"):
        import rawpy

    gains = torch.tensor(pair.white_balance).reshape(3, 1, 1) / min(pair.white_balance)
    room = gains.max()  # LibRaw clips at white what the gains lift beyond it
    height, width = mosaic.shape[-2:]
    rows, columns = (_repeat_cells(side, bayer.pattern(cfa).period) for side in (height, width))
    mosaic = (mosaic[0][:, rows][..., columns] / room).clamp(-BLACK / (WHITE - BLACK), 1.0)
    colour = pair.white_balance, pair.white_balance, pair.color_matrix
    frame = RawFrame(mosaic, cfa, (BLACK,) * 4, WHITE, *colour, pair.camera, name=pair.name)
    settings = {"output_color": rawpy.ColorSpace.raw, "gamma": (1, 1), "no_auto_bright": True, "output_bps": 16}
    settings |= {"adjust_maximum_thr": 0, "user_flip": 0, "user_wb": [*gains.flatten().tolist(), gains[1].item()]}
    with TemporaryDirectory() as folder:
        path = Path(folder) / "frame.dng"
        write_dng(path, frame)
        with rawpy.imread(str(path)) as raw:
            rgb = raw.postprocess(demosaic_algorithm=rawpy.DemosaicAlgorithm[method], **settings | more)
    return (torch.from_numpy(rgb).permute(2, 0, 1).float() / 65535 * room / gains)[None, :, :height, :width]


def _repeat_cells(side: int, period: int) -> Tensor:
    """Numbers of the lines of a side, which go on with its whole cells if LibRaw would find it too small."""
    lines = torch.arange(side if period == 2 else max(side, LEAST))
    return torch.where(lines < side, lines, lines % (side // period * period))


@dataclass
class FullColourRecipe(Recipe):
    """A recipe whose validation and test frames are truths of full colour.

    Args:
        test_noise: of these frames, in place of ``noise``.
    """

    together: ClassVar[bool] = True
    test_noise: NoiseSetting = "cycleisp_sidd"

    @property
    def validation_noise(self) -> object:
        """``test_noise``."""
        return self.test_noise


class FullColourRun(TrainingRun):
    """A run that is scored on truths of full colour."""

    recipe: FullColourRecipe
    compared_in = ": linear camera RGB"

    def __init__(self, recipe: FullColourRecipe, overwrite: bool, given: Mapping[str, Sequence[Pair]]) -> None:
        self.test_noise = noise_model(recipe.test_noise)
        super().__init__(recipe, overwrite, given)

    def pattern(self, arm: str) -> CFA:
        """RGGB, whatever the ISP's is."""
        return CFA.RGGB


# -- demosaicing and denoising at once ---------------------------------------------------------------------------------


@dataclass
class JointRecipe(FullColourRecipe):
    """Networks that demosaic and denoise at once.

    Args:
        demosaicing: what each denoiser of RAW, of ``classical`` and ``untouched``, is followed by: bilinear, malvar, or
            LibRaw's VNG, PPG, AHD, DCB, DHT or AAHD.
    """

    target: ClassVar[Target] = "rgb"
    classical: list[str | dict[str, Any]] = field(default_factory=lambda: ["NonLocalMeans"])
    untouched: list[str] = field(default_factory=lambda: [DEFAULT])
    demosaicing: list[str] = field(default_factory=lambda: ["malvar", "AHD", "DCB"])

    def __post_init__(self) -> None:
        super().__post_init__()
        known = *bayer.STENCILS, *LIBRAW
        for name in self.demosaicing:
            if name not in known:
                raise ValueError(f"demosaicing {name!r} is unknown; use one of {', '.join(known)}")


@EXPERIMENTS.register("demosaic")
def run(recipe: JointRecipe, overwrite: bool = False, **given: Sequence[Pair]) -> Results:
    """Train the arms of a recipe and compare them with denoisers of RAW; arguments as of the kind ``training``."""
    return JointRun(recipe, overwrite, given).run_stages()


class MalvarInput:
    """The noisy input, demosaiced by Malvar, He and Cutler's interpolation."""

    name, takes = NOISY.name, "raw"

    def __call__(self, given: Noisy) -> Tensor:
        return bayer.demosaic(bayer.unpack(given.image, given.cfa), given.cfa, "malvar")


class JointRun(FullColourRun):
    """A run whose arms give full colour."""

    recipe: JointRecipe
    input = MalvarInput()

    def validation_trials(self, isp: DictionaryISP) -> list[Trial]:
        """The validation frames with the noise of the test; without any, as of the kind ``training``."""
        trials = [rgb_trial(pair, self.test_noise) for pair in self.frames["validation"]]
        return trials or super().validation_trials(isp)

    def test_trials(self) -> Sequence[Trial]:
        """The test frames in RGGB, with every demosaicing."""
        ways = {method: method for method in self.recipe.demosaicing}
        return make_trials(self.test, lambda pair: rgb_trial(pair, self.test_noise, ways))

    def scores_key(self, digest: str) -> str:
        """The key of the kind ``training`` together with the noise of the test."""
        return fingerprint(super().scores_key(digest), self.recipe.test_noise)


# -- mosaics of every pattern ------------------------------------------------------------------------------------------


@dataclass
class MosaicRecipe(FullColourRecipe):
    """Networks for mosaics of every pattern.

    Args:
        patterns: shares of the patterns in training, by name.
        test_patterns: those of validation and test frames.
    """

    patterns: dict[str, float] = field(default_factory=lambda: {"RGGB": 0.4, "XTRANS": 0.4, "QUAD-RGGB": 0.2})
    test_patterns: list[str] = field(default_factory=lambda: ["RGGB", "XTRANS", "QUAD-RGGB"])

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in (*self.patterns, *self.test_patterns):
            bayer.pattern(name)
        if not self.patterns or min(self.patterns.values()) < 0 or not sum(self.patterns.values()) > 0:
            raise ValueError(f"patterns: shares must be at least 0, and one above, got {self.patterns}")
        if any(arm.augmented < 1.0 or not arm.sees_clean for arm in self.arms.values()):
            raise ValueError("arms: mosaics of every pattern are made from pictures; set augmented: 1 and no estimator")


@EXPERIMENTS.register("mosaics")
def run_mosaics(recipe: MosaicRecipe, overwrite: bool = False, **given: Sequence[Pair]) -> Results:
    """Train the arms of a recipe and score them by pattern; arguments as of the kind ``training``."""
    return MosaicRun(recipe, overwrite, given).run_stages()


def mosaic_trial(pair: Pair, cfa: str, noise: NoiseModel) -> Trial:
    """A frame as a test case of a pattern, in the domain ``rgb``: packed RAW if it is Bayer's, else a mosaic."""
    method = "bilinear" if cfa.startswith("QUAD") else "AHD"
    return rgb_trial(pair, noise, {"demosaiced": method}, cfa, condition=cfa)


def planes_trial(pair: Pair, cfa: str, noise: NoiseModel) -> Trial:
    """A frame as a network of mosaics takes it, with the planes of its colours: ``(1, 4, H, W)``, domain ``raw``.

    It begins at the line from which the network is trained to meet the pattern.
    """
    trial, known = mosaic_trial(pair, cfa, noise), bayer.pattern(cfa)
    assert trial.variance is not None
    top, left = (-lines % known.period for lines in lines_before(known))
    raw, variance = (mosaic_of(x, cfa)[..., top:, left:] for x in (trial.noisy, trial.variance))
    clean = known.mosaic(trial.clean)[..., top:, left:]
    return Trial(with_planes(raw, known.shift(top, left)), clean, variance, pair.name, condition=cfa)


class MosaicRun(FullColourRun):
    """A run on patterns drawn at random."""

    recipe: MosaicRecipe

    def stream(self, arm: str, isp: DictionaryISP, seed: int) -> TrainingStream:
        """Crops of pictures as RAW of all patterns."""
        recipe, own = self.recipe, self.recipe.arms[arm]
        augment = RawAugment(isp, self.noise, draw=own.draw)
        crops = MosaicCrops(self.pictures, augment, recipe.train.crop, own.zoom, recipe.patterns)
        return TrainingStream(None, crops, recipe.train.batch, 1.0, derive_seed(seed, "stream"))

    def validation_trials(self, isp: DictionaryISP) -> list[Trial]:
        """The validation frames in every pattern."""
        frames = self.frames["validation"]
        return [planes_trial(pair, cfa, self.test_noise) for cfa in self.recipe.test_patterns for pair in frames]

    def test_trials(self) -> Sequence[Trial]:
        """The test frames in every pattern."""
        cases = [(cfa, k) for cfa in self.recipe.test_patterns for k in range(len(self.test))]
        return make_trials(cases, lambda case: mosaic_trial(self.test[case[1]], case[0], self.test_noise))

    def weights_key(self, arm: str, seed: int) -> str:
        """The key of the kind ``training`` together with the patterns."""
        return fingerprint(super().weights_key(arm, seed), self.recipe.patterns, self.recipe.test_patterns)

    def evaluate(self, arm: str, seed: int) -> dict[str, Any]:
        """The arm's summaries by pattern."""
        return self._by_pattern(self.denoiser(arm), f"evaluate {arm}")

    def _by_pattern(self, denoiser: RawDenoiser, label: str) -> dict[str, Any]:
        trials = (trial for trial in self.trials if denoiser.of_any is not None or trial.condition in CFA.__members__)
        rows, noisy = (
            group_rows(found, "condition") for found in (score([denoiser], trials, label), self.noisy_rows())
        )
        return {cfa: summary(found, noisy[cfa]) for cfa, found in rows.items()}

    def report(self) -> None:
        """Write ``results.json`` and print a table of each pattern."""
        others = {one.name: self._by_pattern(one, one.name) for one in self.others}
        tables = {}
        for cfa in self.recipe.test_patterns:
            found = {arm: [{"plain": run[cfa]} for run in runs] for arm, runs in self.results.items()}
            known = {name: summaries[cfa] for name, summaries in others.items() if cfa in summaries}
            tables[cfa] = {"results": found, "others": known}
            print_table(found, f"{self.recipe.name} tested on {self.data.test}: {cfa}, linear camera RGB", known)
        file = self.folder / "results.json"
        write_json({"recipe": asdict(self.recipe), **tables}, file)
        print(f"table: {file}")
        require_numbers([run[cfa] for runs in self.results.values() for run in runs for cfa in run])
