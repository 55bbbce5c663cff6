r"""Joint demosaicing and denoising beside one after the other, on a truth that no demosaicing has made.

.. math:: x = (R, (G_r + G_b) / 2, B), \qquad y \sim N(M x, \mathrm{shot\_var}\, M x + \mathrm{read\_var})

The full-colour truth x takes each pixel from one 2 x 2 cell of a finer frame, whose four sites are means around the
cell's centre (:func:`rawaug.bayer.bin_mosaic`, ``together``), so that it has real optics, colours in register and
little noise of its own; M keeps one colour a site. A denoiser of RAW is followed by each demosaicing: those of
:func:`rawaug.bayer.demosaic`, and LibRaw's, which works on white-balanced RAW, as in its own pictures. PSNR and SSIM
are those of linear camera RGB, and of one fixed development of it.
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
from denoisers.network import PACKED, Denoiser
from rawaug import bayer
from rawaug.bayer import CFA
from rawaug.data.development import exposure_of, rendered
from rawaug.data.pairs import Pair
from rawaug.denoise.denoiser import Noisy, RawDenoiser
from rawaug.errors import extra
from rawaug.evaluation.scores import NOISY, require_numbers, summary
from rawaug.evaluation.tables import print_table
from rawaug.evaluation.trials import Trial
from rawaug.experiment.denoising import Results, TrainingRun
from rawaug.experiment.recipe import Recipe
from rawaug.files import fingerprint, write_json
from rawaug.io import RawFrame, write_dng
from rawaug.isp.model import DictionaryISP
from rawaug.noise import NoiseModel, noise_model
from rawaug.plugin.targets import Target
from rawaug.registry import EXPERIMENTS
from rawaug.seeding import keyed_generator

LIBRAW = ("VNG", "PPG", "AHD", "DCB", "DHT", "AAHD")
"""LibRaw's demosaicings by its names."""
LEAST = 512
"""Sides that LibRaw's interpolation of X-Trans needs."""
BLACK, WHITE = 1024, 65535
"""Of the DNGs that LibRaw demosaics."""


@dataclass
class JointRecipe(Recipe):
    """Networks that demosaic and denoise at once.

    Args:
        test_noise: of validation and test frames, in place of ``noise``.
        rivals: denoisers of RAW to compare with, by name or file, in place of ``classical`` and
            ``untouched``.
        demosaicing: what each of them is followed by: bilinear, malvar, or LibRaw's VNG, PPG, AHD, DCB, DHT or AAHD.
    """

    target: ClassVar[Target] = "rgb"
    together: ClassVar[bool] = True
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

    @property
    def validated_with(self) -> object:
        return self.test_noise


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


def rgb_trial(pair: Pair, noise: NoiseModel, ways: Sequence[str] = (), seed: int = 0) -> Trial:
    """A frame as a test case in the domain ``rgb``: noisy packed RGGB RAW against its truth of full colour.

    Args:
        noise: drawn on the mosaic of the truth, keyed by (seed, name).
        ways: the demosaicings by which a denoiser of RAW is followed.
    """
    rgb = full_colour(pair)
    clean = bayer.pack_rgb(rgb, CFA.RGGB)
    params = noise.sample(1, keyed_generator(seed, "test noise", pair.name))
    noisy = noise.apply(clean, params)
    levels = (params["shot_var"].item(), params["read_var"].item()) if "shot_var" in params else None
    return Trial(
        noisy,
        rgb,
        noise.variance(noisy, params),
        pair.name,
        "rgb",
        levels=levels,
        develop=partial(developed, pair=pair, exposure=exposure_of(clean, pair)),
        ways={method: partial(demosaiced, pair=pair, method=method) for method in ways},
    )


def developed(image: Tensor, pair: Pair, exposure: float) -> Tensor:
    """Linear RGB ``(1, 3, H, W)``, or packed RAW at its own size, as sRGB ``(3, H, W)`` in the frame's colours."""
    rgb = image[0, [0, 1, 3]] if image.shape[1] == PACKED else image[0]
    return rendered(rgb, pair.white_balance, pair.color_matrix, exposure, least=None)


def demosaiced(packed: Tensor, pair: Pair, method: str) -> Tensor:
    """Packed RGGB RAW ``(1, 4, h, w)`` of a frame as linear camera RGB ``(1, 3, 2h, 2w)``."""
    mosaic = bayer.unpack(packed, CFA.RGGB)
    return by_libraw(mosaic, pair, method) if method in LIBRAW else bayer.demosaic(mosaic, CFA.RGGB, method)


def by_libraw(mosaic: Tensor, pair: Pair, method: str, cfa: str = CFA.RGGB, **more: Any) -> Tensor:
    """A mosaic ``(1, 1, H, W)`` as LibRaw demosaics it, as linear camera RGB ``(1, 3, H, W)``.

    X-Trans has Markesteijn's interpolation, whatever ``method`` is; a small mosaic is continued by its whole cells.
    ``more`` goes to rawpy's ``postprocess``.
    """
    with extra("raw"):
        import rawpy

    gains = torch.tensor(pair.white_balance).reshape(3, 1, 1) / min(pair.white_balance)
    room = gains.max()  # LibRaw clips at white what the gains lift beyond it
    height, width = mosaic.shape[-2:]
    rows, columns = (_repeated(side, bayer.pattern(cfa).period) for side in (height, width))
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


def _repeated(side: int, period: int) -> Tensor:
    """Lines of a side; where LibRaw would find it too small, its whole cells again."""
    lines = torch.arange(side if period == 2 else max(side, LEAST))
    return torch.where(lines < side, lines, lines % (side // period * period))


class Demosaiced:
    """The noisy input, demosaiced by Malvar, He and Cutler's interpolation."""

    name, takes = NOISY.name, "raw"

    def __call__(self, given: Noisy) -> Tensor:
        return bayer.demosaic(bayer.unpack(given.image, given.cfa), given.cfa, "malvar")


class JointRun(TrainingRun):
    """A run whose arms give full colour."""

    recipe: JointRecipe
    input = Demosaiced()

    def __init__(self, recipe: JointRecipe, overwrite: bool, given: Mapping[str, Sequence[Pair]]) -> None:
        self.test_noise = noise_model(recipe.test_noise)
        self.rivals = [RawDenoiser.of(name, recipe.device).require_mosaic() for name in recipe.rivals]
        super().__init__(recipe, overwrite, given)

    def pattern(self, arm: str, isp: DictionaryISP) -> CFA:
        return CFA.RGGB

    def watched(self, isp: DictionaryISP, noise: NoiseModel) -> list[Trial]:
        found = [rgb_trial(pair, self.test_noise) for pair in self.frames["validation"]]
        return found or super().watched(isp, noise)

    def trial(self, pair: Pair, noise: NoiseModel, isp: DictionaryISP) -> Trial:
        return rgb_trial(pair, self.test_noise, self.recipe.demosaicing)

    def scores_key(self, digest: str) -> str:
        return fingerprint(super().scores_key(digest), self.recipe.test_noise)

    def reported(self, results: Results, models: dict[str, Denoiser], noise: NoiseModel, isp: DictionaryISP) -> None:
        found, noisy = self.compared(self.rivals, noise, isp), self.noisy_rows(noise, isp)
        others = {name: summary(rows, noisy) for name, rows in found.items()}
        file = self.folder / "results.json"
        write_json({"recipe": asdict(self.recipe), "results": results, "rivals": others}, file)
        title = f"{self.recipe.name} tested on {self.data.test}: linear camera RGB"
        print_table(results, title, others)
        print(f"table: {file}")
        require_numbers([*(run[kind] for runs in results.values() for run in runs for kind in run), *others.values()])
