"""The methods of the reconstruction table, on equal terms: fitted to the same pairs, scored on the same patches.

A family is fitted once and may fill several rows: the dictionary ISP blind, with the as-shot white balance, and with 64
RAW samples. A shipped ISP, or the file of one, is not fitted.

PSNR_d is that of a denoiser trained on the RAW that a method makes of sRGB pictures, on real RAW. Pictures, network,
steps and noise are the same for every method. The dictionary ISP draws camera settings from its hull, UPI from its
published distributions; a network has one answer.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from statistics import fmean
from typing import Any, NamedTuple

import torch
from torch import Tensor

from denoisers import Denoiser
from rawaug import bayer
from rawaug.bayer import CFA
from rawaug.camera.psnr_r import block_psnr, psnr_r, windows_of, windows_psnr
from rawaug.data import open_pairs
from rawaug.data.folders import skip_broken
from rawaug.data.pairs import Pair, Sample, SomePairs
from rawaug.denoising.denoiser import RawDenoiser
from rawaug.evaluation.scores import Row, score
from rawaug.evaluation.trials import trial_of
from rawaug.files import find_weights, write_json
from rawaug.isp import staged
from rawaug.isp.config import ISPParams
from rawaug.isp.fit import FitConfig, fit_isp
from rawaug.isp.fit.descent import cycle_error
from rawaug.isp.fit.samples import block_averages, sample_pixels
from rawaug.isp.model import DictionaryISP
from rawaug.isp.stages import as_float, coordinates_or_full
from rawaug.metrics import PATCH, psnr
from rawaug.noise import NoiseModel, noise_model
from rawaug.paper.baselines import BASELINES, Training, fit_baseline
from rawaug.paper.baselines.base import BaselineISP, CropTrainedISP
from rawaug.plugin.augment import RawAugment
from rawaug.plugin.dataset import RawPairs
from rawaug.plugin.draw import Draw
from rawaug.seeding import derive_seed, keyed_generator
from rawaug.training.config import DenoiserConfig, TrainConfig
from rawaug.training.loop import train
from rawaug.training.stream import PictureCrops, Source, TrainingStream, add_noise, freeze_samples

FAMILIES = ("dictionary", "dictionary-encoders", *BASELINES)
ROWS = {"as-shot": "as-shot gains", "samples": "64 RAW samples"}
SAMPLES = 64
PIXELS = 8192
"""Number of pixels of a frame on which the forward pass is scored."""
SHORTEST_CROP = 256
Method = BaselineISP | DictionaryISP


class Fitted(NamedTuple):
    """A method after its fit, the time that it took, and the number of parameters of its reverse pass."""

    model: Method
    seconds: float
    parameters: int


def resume(path: Path, key: str, measure: Callable[[], dict[str, Any]]) -> dict[str, Any]:
    """The figures in ``path`` if an earlier run wrote them under the same key; else they are measured and written."""
    figures: dict[str, Any] = json.loads(path.read_text()) if path.is_file() else {}
    if figures.get("key") != key:
        figures = {"key": key, **measure()}
        write_json(figures, path)
    return figures


def is_method(family: str) -> bool:
    """Whether this is a family to fit, the name of a shipped ISP, or the file of one."""
    if family in FAMILIES:
        return True
    try:
        find_weights(family)
    except FileNotFoundError:
        return False
    return True


def learns_by_descent(family: str) -> bool:
    """Whether a family trains on crops: it has a budget, and needs pairs that are registered pixel by pixel."""
    return family in BASELINES and issubclass(BASELINES[family], CropTrainedISP)


def fit_family(family: str, pairs: Sequence[Pair], config: FitConfig, training: Training) -> Fitted:
    """Fit a family to pairs of one CFA.

    Args:
        family: one of :data:`FAMILIES`, or an ISP to take as it is, by a shipped one's name or a file.
        pairs: the frames to fit.
        config: of the dictionary ISP.
        training: budget and crops of the networks; its seed is used by every family.

    Raises:
        ValueError: if the ISP's CFA is not that of the frames.
    """
    start = time.perf_counter()
    if family not in FAMILIES:
        isp = DictionaryISP.from_pretrained(family)
        if isp.cfa != CFA(pairs[0].cfa):
            raise ValueError(f"{family}: makes {isp.cfa.value} RAW, but the frames are {CFA(pairs[0].cfa).value}")
        return Fitted(isp, 0.0, reverse_parameters(isp))
    model: Method
    if family.startswith("dictionary"):
        config = replace(config, seed=training.seed, encoders="on" if family == "dictionary-encoders" else "off")
        model = fit_isp(pairs, config)
    else:
        drawn: dict[str, Any] = {"seed": training.seed} if learns_by_descent(family) else {}
        model = fit_baseline(BASELINES[family](cfa=pairs[0].cfa, **drawn), pairs, training)
    return Fitted(model, time.perf_counter() - start, reverse_parameters(model))


def reverse_parameters(model: Method) -> int:
    """Number of parameters of the reverse pass."""
    named = getattr(model, "reverse_network", model).named_parameters()
    return sum(p.numel() for name, p in named if not name.startswith("forward_") and ".forward_" not in name)


def score_rows(fitted: Fitted, pair: Pair, patches: int | None) -> dict[str, Any]:
    """``rows``, the PSNR_r in dB of every row that the family fills, ``mpix_s``, the speed of its reverse pass, and
    ``forward``, as :func:`forward_psnr` measures it.

    An unregistered pair is compared as averages over blocks, and has PSNR_r alone. ``patches`` None scores all patches.
    """
    pair.require_rendered()
    model = fitted.model
    if not pair.registered:
        return {"rows": _block_rows(model, pair), "mpix_s": None, "forward": None}
    makers = {row: _maker(model, given) for row, given in settings(model, pair).items()}
    start = time.perf_counter()
    rows = {row: windows_psnr(make, pair, patches) for row, make in makers.items()}
    area = min(PATCH, pair.raw.shape[-2]) * min(PATCH, pair.raw.shape[-1])
    pixels = len(makers) * len(windows_of(pair, patches)) * area
    speed = pixels / (time.perf_counter() - start) / 1e6
    return {"rows": rows, "mpix_s": speed, "forward": forward_psnr(model, pair)}


@torch.no_grad()
def forward_psnr(model: Method, pair: Pair) -> float | None:
    """PSNR in dB of the dictionary's forward pass, pixel by pixel, under the setting that it chooses for the RAW.

    None for other methods, and where the frame does not state its colours.
    """
    if not isinstance(model, DictionaryISP) or not pair.color_known:
        return None
    part = sample_pixels([pair], PIXELS, seed=0).pixels
    error = cycle_error(model, part, model.forward(pair.raw[None]).params, {}, FitConfig())
    return float(-10.0 * error.log10())


def _maker(model: Method, given: Any) -> Callable[[Tensor, Tensor], Tensor]:
    """The function from an sRGB patch and its coordinates to a mosaic under a setting."""
    if isinstance(model, DictionaryISP):
        return lambda patch, coordinates: model.reverse(patch, given, coordinates=coordinates).raw
    return lambda patch, _: model.reverse(patch, given)


def settings(model: Method, pair: Pair) -> dict[str, Any]:
    """Make the camera setting of each row; a method that makes no use of gains has one row."""
    if isinstance(model, DictionaryISP):
        return dictionary_params(model, pair)
    as_shot = model.setting_of(pair.white_balance) if pair.balance_known else None
    return {"blind": None} | ({} if as_shot is None else {"as-shot": as_shot})


def _block_rows(model: Method, pair: Pair) -> dict[str, float]:
    if isinstance(model, DictionaryISP):
        rows = {"blind": psnr_r(model, pair)}
        return rows | ({"as-shot": psnr_r(model, pair, white_balance=True)} if pair.balance_known else {})
    blocks = block_averages(pair.srgb, pair.raw, pair.cfa)
    with torch.no_grad():
        made = model.unprocess(blocks.srgb[None])[0]
    return {"blind": block_psnr(made, blocks.raw, blocks.clipped)}


def dictionary_params(isp: DictionaryISP, pair: Pair) -> dict[str, ISPParams]:
    """The camera settings of the dictionary's rows for a frame."""
    with torch.no_grad():
        blind = isp.choose(pair.srgb[None])
        as_shot = staged.with_white_balance(isp, blind, pair.white_balance, None)
        known = {"blind": blind} | ({"as-shot": as_shot} if pair.balance_known else {})
        return known | {"samples": _from_samples(isp, pair, blind)}


def _from_samples(isp: DictionaryISP, pair: Pair, blind: ISPParams) -> ISPParams:
    generator = keyed_generator("raw samples", pair.name)
    rows, columns = (torch.randint(side, (SAMPLES,), generator=generator) for side in pair.raw.shape[-2:])
    readings = torch.stack([rows.float(), columns.float(), pair.raw[0, rows, columns]], dim=1)[None]
    x = as_float(pair.srgb[None])
    return staged.with_raw_samples(isp, x, blind, readings, coordinates_or_full(x, None))


@torch.no_grad()
def cycle_psnr(fitted: Fitted, pictures: Sequence[Tensor]) -> dict[str, float]:
    """Mean PSNR in dB of the dictionary ISP from sRGB to RAW and back, over uint8 pictures ``(3, H, W)``.

    It has two keys, ``cycle`` and ``cycle_without_mosaic``; other methods have none.
    """
    model, shown = fitted.model, [as_float(picture[None]) for picture in pictures]
    if not isinstance(model, DictionaryISP):
        return {}
    made = (model.reverse(x) for x in shown)
    cycled = [model.forward(result.raw.clamp(0.0, 1.0), result.params).srgb for result in made]
    ways = {"cycle": cycled, "cycle_without_mosaic": [cycle_without_mosaic(model, x) for x in shown]}
    return {way: fmean(psnr(a, b).item() for a, b in zip(found, shown, strict=True)) for way, found in ways.items()}


def cycle_without_mosaic(isp: DictionaryISP, srgb: Tensor) -> Tensor:
    """sRGB ``(B, 3, H, W)`` to x5 and back to the same shape: what the stages alone lose."""
    params = isp.choose(srgb)
    return isp.forward_pixels(isp.reverse_pixels(srgb, params), params).clamp(0.0, 1.0)


def mosaic_only_psnr(pictures: Sequence[Tensor], cfa: CFA | str = "RGGB") -> float:
    """Mean PSNR in dB of pictures ``(3, H, W)`` after a mosaic and bilinear interpolation: the ceiling of a cycle."""
    values = [as_float(p[None]) for p in pictures]
    return fmean(psnr(bayer.demosaic(bayer.mosaic(x, cfa), cfa).clamp(0.0, 1.0), x).item() for x in values)


# -- PSNR_d -----------------------------------------------------------------------------------------------------------


@dataclass
class DownstreamConfig:
    """How PSNR_d is measured.

    Args:
        methods: the families of which it is measured.
        test: RAW frames of unseen cameras; folders, or ``kind:path``.
        test_crop: side of the central crop scored of each test frame; null for the whole frame.
        test_count: number of frames of each of ``test``; null for all.
        bin: K bins these frames K x K by colour site: clean references of real photographs.
        exposure: lowest and highest exposure in stops at which the RAW of a fitted ISP is drawn, for the test cameras'
            headroom is not known; ISPs of published cameras and UPI's published distributions have their own.
        noise: preset, in training and on the test frames.
        denoiser: the network.
        train: the loop.
    """

    methods: list[str] = field(default_factory=lambda: ["dictionary", "upi"])
    test: list[str] = field(default_factory=lambda: ["demo:test"])
    test_crop: int | None = 1024
    test_count: int | None = None
    bin: int = 1
    exposure: tuple[float, float] | None = (-1.5, 0.0)
    noise: str = "cycleisp_sidd"
    denoiser: DenoiserConfig = field(default_factory=DenoiserConfig)
    train: TrainConfig = field(default_factory=TrainConfig)

    def shortest(self) -> DownstreamConfig:
        """One step, one small test frame."""
        one = replace(self.train, steps=1, batch=2, warmup=1, validate_every=1, checkpoint_every=1)
        return replace(self, test_crop=SHORTEST_CROP, test_count=1, train=one)


def psnr_d(model: Method, pictures: Sequence[Tensor], config: DownstreamConfig, folder: Path, seed: int) -> float:
    """Mean PSNR in dB, on the test frames, of a denoiser that is trained on a method's RAW.

    Args:
        model: makes the RAW.
        pictures: uint8 sRGB ``(3, H, W)``.
        config: network, loop, noise and test frames.
        folder: of the training's files, one folder a seed in it, from which a stopped training goes on.
        seed: of the training.
    """
    net = train_on(_crops(model, pictures, noise_model(config.noise), config), config, folder, seed)
    return fmean(row.psnr for row in score_on(net, config, CFA(model.cfa)))


def train_on(crops: Source, config: DownstreamConfig, folder: Path, seed: int) -> Denoiser:
    """A denoiser trained on ``crops``; ``config``, ``folder`` and ``seed`` as in :func:`psnr_d`."""
    stream = TrainingStream(None, crops, config.train.batch, 1.0, derive_seed(seed, "downstream"))
    samples, label = freeze_samples(crops, "watched"), f"{folder.name} {seed}"
    return train(stream, samples, config.denoiser, config.train, folder / f"seed{seed}", seed, label=label)


def score_on(net: Denoiser, config: DownstreamConfig, cfa: CFA) -> list[Row]:
    """The scores of a network on the test frames, whose noise is frozen with seed 0; ``cfa`` is the network's."""
    opened = ((open_pairs(spec, split="test", bin=config.bin), spec) for spec in config.test)
    chosen = ((SomePairs(found, range(len(found))[: config.test_count]), spec) for found, spec in opened)
    pairs = (pair for frames, spec in chosen for pair in skip_broken(frames, spec))
    noise, denoiser = noise_model(config.noise), RawDenoiser.of(net, cfa=cfa)
    frames = [pair.middle(config.test_crop) if config.test_crop else pair for pair in pairs]
    return list(score([denoiser], (trial_of(pair, noise, cfa) for pair in frames), "PSNR_d"))


def _crops(model: Method, pictures: Sequence[Tensor], noise: NoiseModel, config: DownstreamConfig) -> Source:
    if not isinstance(model, DictionaryISP):
        return MadeCrops(pictures, model.draw, model.cfa, noise, config.train.crop)
    # The plugin keeps each crop's place in its frame.
    draw = Draw(exposure=None if model.config.cameras else config.exposure)
    return PictureCrops(RawPairs(pictures, RawAugment(model, noise, draw=draw), config.train.crop))


class MadeCrops:
    """Crops of pictures, turned at random, made RAW by any function.

    Args:
        pictures: uint8 sRGB ``(3, H, W)``.
        make: maps float sRGB ``(1, 3, h, w)`` and a generator to a mosaic ``(1, 1, h, w)``.
        cfa: the pattern of these mosaics.
        noise: drawn for each crop.
        crop: side of the crops in pixels.
    """

    def __init__(
        self,
        pictures: Sequence[Tensor],
        make: Callable[[Tensor, torch.Generator], Tensor],
        cfa: CFA,
        noise: NoiseModel,
        crop: int,
    ) -> None:
        self.pictures, self.make, self.cfa, self.noise = pictures, make, cfa, noise
        self.crop = bayer.RandomCrop(crop)

    @torch.no_grad()
    def draw(self, generator: torch.Generator) -> Sample:
        """A sample of packed RAW ``(4, crop / 2, crop / 2)``."""
        picture = self.pictures[int(torch.randint(len(self.pictures), (), generator=generator))]
        patch = bayer.RandomTurn(self.cfa, keep_cfa=False)(self.crop(picture, generator), generator)
        clean = bayer.pack(self.make(as_float(patch[None]), generator).clamp(0.0, 1.0), self.cfa)
        return add_noise(clean, self.noise, generator)
