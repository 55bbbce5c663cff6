r"""Networks that also demosaic, and networks for mosaics of every pattern, against a truth of full colour.

.. math:: x = (R, (G_r + G_b) / 2, B), \qquad y \sim N(M x, \mathrm{shot\_var}\, M x + \mathrm{read\_var})

The truth x takes each pixel from one 2 x 2 cell of a finer frame, whose four sites are means around the cell's centre
(:func:`rawaug.bayer.bin_mosaic`, ``together``). It therefore has real optics, colours in register and little noise of
its own. M keeps one colour for each site, in any pattern. PSNR and SSIM are those of linear camera RGB, and of one
fixed development of it.

The task ``rgb`` has networks that turn packed noisy RAW into full colour; they are compared with RAW denoisers and a
demosaicing of :func:`rawaug.bayer.demosaic` or LibRaw. The task ``mosaic`` has one network that takes a mosaic of any
pattern and the planes of its colours, and returns the mosaic; the truth is mosaicked anew in each pattern. Results are
demosaiced by LibRaw, with Markesteijn's interpolation for X-Trans, and Quad-Bayer, which LibRaw does not know, by
:meth:`rawaug.bayer.Pattern.demosaic`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import product
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
from rawaug.data.development import exposure_gain, render_rgb
from rawaug.data.pairs import Pair
from rawaug.denoising.denoiser import Noisy
from rawaug.errors import extra
from rawaug.evaluation.scores import NOISY
from rawaug.evaluation.trials import TEST_NOISE, Trial, freeze_noise, make_trials
from rawaug.experiment.raw import RawTask
from rawaug.experiment.settings import NoiseSetting, Recipe
from rawaug.experiment.task import TASKS, change_cfa
from rawaug.io import RawFrame, write_dng
from rawaug.noise import NoiseModel, noise_model
from rawaug.plugin.augment import RawAugment
from rawaug.plugin.targets import Target
from rawaug.seeding import derive_seed
from rawaug.training.sources import MosaicCrops
from rawaug.training.stream import TrainingStream

LIBRAW = ("VNG", "PPG", "AHD", "DCB", "DHT", "AAHD")
"""LibRaw's demosaicings, by its names."""

_LEAST = 512
"""LibRaw's interpolation of X-Trans needs a frame of at least this side."""

_BLACK, _WHITE = 1024, 65535
"""The DNGs that LibRaw demosaics have these black and white levels."""


def full_colour(pair: Pair) -> Tensor:
    """Make the truth of a frame: linear camera RGB ``(1, 3, H/2, W/2)`` with even sides, each pixel from one cell."""
    red, green, other_green, blue = bayer.pack(pair.clean.mosaic[None], pair.cfa).unbind(1)
    rgb = torch.stack([red, (green + other_green) / 2, blue], dim=1)
    height, width = rgb.shape[-2:]
    return rgb[..., : height // 2 * 2, : width // 2 * 2].contiguous()


def rgb_trial(
    pair: Pair, noise: NoiseModel, ways: Mapping[str, str] | None = None, cfa: str = CFA.RGGB, **about: Any
) -> Trial:
    """Make a frame a test case in the domain ``rgb``: noisy RAW of a pattern against its truth of full colour.

    Args:
        pair: the frame, of which each cell becomes a pixel.
        noise: the noise drawn on the mosaic of the truth; every 2 x 2 square has the same noise in all patterns.
        ways: the demosaicings, by the names of rows, that follow a denoiser of RAW.
        cfa: the pattern.
        about: other attributes of the trial, such as ``condition``.
    """
    rgb = full_colour(pair)
    squares = bayer.pack(bayer.pattern(cfa).mosaic(rgb), CFA.RGGB)
    noisy, variance, levels = freeze_noise(squares, noise, 0, TEST_NOISE, pair.name)
    noisy, variance = _in_pattern(noisy, cfa), _in_pattern(variance, cfa)

    follow = {}
    for name, method in (ways or {}).items():
        follow[name] = partial(demosaic_mosaic, pair=pair, method=method, cfa=cfa)

    return Trial(
        noisy,
        rgb,
        variance,
        pair.name,
        "rgb",
        levels=levels,
        cfa=bayer.canonical_cfa(cfa),
        develop=partial(develop_rgb, pair=pair, exposure=exposure_gain(bayer.pack_rgb(rgb, CFA.RGGB), pair)),
        ways=follow,
        **about,
    )


def _in_pattern(squares: Tensor, cfa: str) -> Tensor:
    """Arrange squares of 2 x 2 as a denoiser takes their pattern: packed RAW if it is Bayer's, else the mosaic."""
    if cfa == CFA.RGGB:
        return squares

    return bayer.pack_if_bayer(bayer.unpack(squares, CFA.RGGB), cfa)


def develop_rgb(image: Tensor, pair: Pair, exposure: float) -> Tensor:
    """Develop linear RGB ``(1, 3, H, W)``, or packed RAW at its size, to sRGB ``(3, H, W)`` in the frame's colours."""
    rgb = image[0]
    if image.shape[1] == PACKED:
        rgb = image[0, [0, 1, 3]]

    return render_rgb(rgb, pair.clean.white_balance, pair.clean.color_matrix, exposure, least=None)


def demosaic_mosaic(image: Tensor, pair: Pair, method: str, cfa: str = CFA.RGGB) -> Tensor:
    """Demosaic RAW, as a denoiser gives it, to linear camera RGB ``(1, 3, H, W)``.

    Args:
        image: packed RAW ``(1, 4, H/2, W/2)``, or a mosaic ``(1, 1, H, W)``.
        pair: the frame that it is of.
        method: one of :data:`LIBRAW`, or of :func:`rawaug.bayer.demosaic` for Bayer's patterns; others have their own.
        cfa: the pattern.
    """
    mosaic = bayer.unpack_if_packed(image, cfa)
    if method in LIBRAW:
        return libraw_demosaic(mosaic, pair, method, cfa)
    if cfa in CFA.__members__:
        return bayer.demosaic(mosaic, cfa, method)

    return bayer.pattern(cfa).demosaic(mosaic)


def libraw_demosaic(mosaic: Tensor, pair: Pair, method: str, cfa: str = CFA.RGGB, **more: Any) -> Tensor:
    """Demosaic a mosaic ``(1, 1, H, W)`` to linear camera RGB ``(1, 3, H, W)`` by LibRaw.

    LibRaw works on white-balanced RAW, as in its own pictures, and clips at white what the gains lift beyond it. The
    mosaic is therefore scaled down before, and the result is scaled up again.

    Args:
        mosaic: the mosaic; a small one is extended by its whole cells.
        pair: the frame that it is of, whose colours LibRaw is given.
        method: one of :data:`LIBRAW`; X-Trans has Markesteijn's interpolation, whatever is given.
        cfa: the pattern of the mosaic.
        more: further arguments of rawpy's ``postprocess``.
    """
    with extra("raw"):
        import rawpy

    gains = torch.tensor(pair.clean.white_balance).reshape(3, 1, 1) / min(pair.clean.white_balance)
    headroom = gains.max()

    height, width = mosaic.shape[-2:]
    period = bayer.pattern(cfa).period
    rows, columns = _repeat_cells(height, period), _repeat_cells(width, period)
    mosaic = (mosaic[0][:, rows][..., columns] / headroom).clamp(-_BLACK / (_WHITE - _BLACK), 1.0)

    colour = pair.clean.white_balance, pair.clean.white_balance, pair.clean.color_matrix
    frame = RawFrame(mosaic, cfa, (_BLACK,) * 4, _WHITE, *colour, pair.clean.camera, name=pair.name)
    settings = {
        "demosaic_algorithm": rawpy.DemosaicAlgorithm[method],
        "output_color": rawpy.ColorSpace.raw,
        "gamma": (1, 1),
        "no_auto_bright": True,
        "output_bps": 16,
        "adjust_maximum_thr": 0,
        "user_flip": 0,
        "user_wb": [*gains.flatten().tolist(), gains[1].item()],
    }

    with TemporaryDirectory() as folder:
        path = Path(folder) / "frame.dng"
        write_dng(path, frame)
        with rawpy.imread(str(path)) as raw:
            values = raw.postprocess(**settings | more)

    rgb = torch.from_numpy(values).permute(2, 0, 1).float() / 65535 * headroom / gains
    return rgb[None, :, :height, :width]


def _repeat_cells(side: int, period: int) -> Tensor:
    """Number the lines of a side, which go on with its whole cells if LibRaw would find it too small."""
    count = side
    if period != 2:
        count = max(side, _LEAST)

    lines = torch.arange(count)
    return torch.where(lines < side, lines, lines % (side // period * period))


# -- the tasks ---------------------------------------------------------------------------------------------------------


@dataclass
class FullColourRecipe(Recipe):
    """A recipe whose validation and test frames are truths of full colour.

    Args:
        test_noise: noise of these frames, in place of ``noise``.
    """

    from_pictures: ClassVar[bool] = True
    full_colour: ClassVar[bool] = True
    test_noise: NoiseSetting = "cycleisp_sidd"

    def __post_init__(self) -> None:
        super().__post_init__()
        noise_model(self.test_noise)  # an unknown name is refused

    @property
    def noise_in_test(self) -> Any:
        """The noise of test frames."""
        return self.test_noise


class FullColourTask(RawTask):
    """Denoisers that are compared in full colour; their truth is a frame whose cells become pixels."""

    @property
    def test_noise(self) -> NoiseModel:
        """The noise of validation and test frames."""
        return noise_model(self.recipe.test_noise)


@dataclass
class RgbRecipe(FullColourRecipe):
    """Networks that demosaic and denoise at once.

    Args:
        demosaicing: the demosaicings that follow each denoiser of RAW in ``classical`` and ``baselines``: bilinear,
            malvar, or LibRaw's VNG, PPG, AHD, DCB, DHT or AAHD.
    """

    kind: ClassVar[str] = "rgb"
    target: ClassVar[Target] = "rgb"
    scoring: ClassVar[tuple[str, ...]] = ("demosaicing",)
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
    input = _MalvarInput()

    def validation(self, cfa: CFA) -> Sequence[Trial]:
        """Take the frames with the noise of the test; without any frames, take pictures as RAW."""
        if not self.watched:
            return super().validation(cfa)

        noise = self.test_noise
        return [rgb_trial(pair, noise) for pair in self.watched]

    def test(self) -> Sequence[Trial]:
        """Take the frames in RGGB, with every demosaicing."""
        noise, ways = self.test_noise, {method: method for method in self.recipe.demosaicing}
        return make_trials(self.frames["test"], lambda pair: rgb_trial(pair, noise, ways))


@dataclass
class MosaicRecipe(FullColourRecipe):
    """Networks for mosaics of every pattern.

    Args:
        patterns: shares of the patterns in training, by name.
        test_patterns: patterns of validation and test frames.
    """

    kind: ClassVar[str] = "mosaic"
    patterns: dict[str, float] = field(default_factory=lambda: {"RGGB": 0.4, "XTRANS": 0.4, "QUAD-RGGB": 0.2})
    self_ensemble: bool = False
    test_patterns: list[str] = field(default_factory=lambda: ["RGGB", "XTRANS", "QUAD-RGGB"])

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in (*self.patterns, *self.test_patterns):
            bayer.pattern(name)

        if self.self_ensemble and not set(self.test_patterns) <= set(CFA.__members__):
            raise ValueError("self_ensemble: is for Bayer mosaics, not for all test_patterns; leave it out")

        shares = self.patterns.values()
        if not shares or min(shares) < 0 or not sum(shares) > 0:
            raise ValueError(f"patterns: shares must be at least 0, and one above, got {self.patterns}")


def mosaic_trial(pair: Pair, cfa: str, noise: NoiseModel) -> Trial:
    """Make a frame a test case of a pattern, in the domain ``rgb``: packed RAW if it is Bayer's, else a mosaic."""
    method = "AHD"
    if cfa.startswith("QUAD"):
        method = "bilinear"

    return rgb_trial(pair, noise, {"": method}, cfa, condition=cfa)


def planes_trial(pair: Pair, cfa: str, noise: NoiseModel) -> Trial:
    """Make a frame what a network of mosaics takes, with its colours' planes: ``(1, 4, H, W)``, domain ``raw``.

    The frame begins at the line from which the network is trained to meet the pattern.
    """
    trial = mosaic_trial(pair, cfa, noise)
    assert trial.variance is not None

    pattern = bayer.pattern(cfa)
    rows_before, columns_before = lines_before(pattern)
    y = -rows_before % pattern.period
    x = -columns_before % pattern.period

    raw = bayer.unpack_if_packed(trial.noisy, cfa)[..., y:, x:]
    variance = bayer.unpack_if_packed(trial.variance, cfa)[..., y:, x:]
    clean = pattern.mosaic(trial.clean)[..., y:, x:]
    noisy = with_planes(raw, pattern.shift(y, x))
    return Trial(noisy, clean, variance, pair.name, condition=cfa)


@TASKS.register("mosaic")
class MosaicTask(FullColourTask):
    """One network on patterns drawn at random, scored in each."""

    settings = MosaicRecipe

    def stream(self, arm: str, cfa: CFA, seed: int) -> TrainingStream:
        """Make crops of pictures as RAW of all patterns."""
        settings, train = self.recipe.arms[arm], self.recipe.loop(arm)
        augment = RawAugment(change_cfa(self.isp, cfa), self.noise, draw=settings.draw or self.recipe.draw)
        crops = MosaicCrops(self.frames["pictures"], augment, train.crop, settings.zoom, self.recipe.patterns)
        return TrainingStream(None, crops, train.batch, 1.0, derive_seed(seed, "stream"))

    def validation(self, cfa: CFA) -> Sequence[Trial]:
        """Take the frames in every pattern."""
        noise = self.test_noise
        trials = []
        for pattern in self.recipe.test_patterns:
            for pair in self.watched:
                trials.append(planes_trial(pair, pattern, noise))

        return trials

    def test(self) -> Sequence[Trial]:
        """Take the frames in every pattern."""
        frames, noise = self.frames["test"], self.test_noise

        def make(case: tuple[str, int]) -> Trial:
            pattern, index = case
            return mosaic_trial(frames[index], pattern, noise)

        cases = list(product(self.recipe.test_patterns, range(len(frames))))
        return make_trials(cases, make)
