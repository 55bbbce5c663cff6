r"""Denoisers over noise: every method on the same frames under the noise of one camera, ISO by ISO.

The frames are clean RAW; noise of variance ``shot_var y + read_var`` is frozen by (seed, frame, ISO). PSNR and SSIM are
taken on the mosaic and once more after one fixed development to sRGB. Time is that of denoising alone.
"""

from __future__ import annotations

import io
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

import denoisers
from denoisers.files import DEFAULT, find
from rawaug.bayer import CFA
from rawaug.data import open_pairs
from rawaug.data.folders import skip_broken
from rawaug.data.pairs import Pair, Sample
from rawaug.evaluation.contestants import published_pmrid
from rawaug.evaluation.own_noise import OwnNoise, own_noise_note, own_variances, with_own_noise
from rawaug.evaluation.page import Page, Part
from rawaug.evaluation.scores import (
    Method,
    Score,
    classical_method,
    denoise,
    installed_classical,
    label_of,
    score_method,
    summary,
)
from rawaug.evaluation.tables import METRICS, print_rows
from rawaug.experiment.plan import some
from rawaug.experiment.recipe import SHORT_CROP
from rawaug.experiment.run_folder import claim, require_free, run_folder
from rawaug.files import replacing, write_json
from rawaug.kernels.runtime import find_device
from rawaug.noise import NoiseModel, noise_model
from rawaug.registry import EXPERIMENTS

TITLES = {"psnr": "PSNR, RAW (dB)", "ssim": "SSIM, RAW", "psnr_srgb": "PSNR, sRGB (dB)", "ssim_srgb": "SSIM, sRGB"}


@dataclass
class DenoiserSweep:
    """A comparison of denoisers that trains nothing.

    Args:
        experiment: "denoisers".
        name: of the folder in ``out`` that it writes.
        data: frames of clean RAW: folders, files, or ``kind:path``.
        count: how many frames of each are used; all if null.
        crop: side of the middle of each frame that is scored; null for the whole frame.
        bin: K bins frames K x K by colour site first: clean references of real photographs.
        camera: whose noise is added, see :mod:`rawaug.noise.cameras`.
        isos: the ISOs, each within what was measured for that camera.
        denoisers: names of shipped ones, or files of ``rawaug run``.
        classical: classical denoisers; BM3D is left out, with a line that says so, where its wheel is not installed.
        pmrid: file of PMRID's published weights; null leaves them out.
        seed: of the noise.
        device: where networks run: cpu, cuda, ...
        out: folder of all runs.
    """

    experiment: str = "denoisers"
    name: str = "denoisers"
    data: list[str] = field(default_factory=lambda: ["demo:test"])
    count: int | None = None
    crop: int | None = None
    bin: int = 1
    camera: str = "Sony ILCE-7M3"
    isos: list[int] = field(default_factory=lambda: [100, 400, 1600, 6400, 25600])
    denoisers: list[str] = field(default_factory=lambda: [DEFAULT])
    classical: list[str | dict[str, Any]] = field(default_factory=lambda: ["NonLocalMeans"])
    pmrid: str | None = None
    seed: int = 0
    device: str = "cpu"
    out: str = "runs"

    def __post_init__(self) -> None:
        if not self.isos or not self.data or not (self.denoisers or self.classical or self.pmrid):
            raise ValueError("isos, data and denoisers: give at least one each")
        if self.crop is not None and (self.crop < 32 or self.crop % 2):
            raise ValueError(f"crop is even and at least 32, or null for whole frames, got {self.crop}")

    def shortest(self) -> DenoiserSweep:
        """Every method once, on a small piece of one frame."""
        return replace(self, count=1, crop=min(self.crop or SHORT_CROP, SHORT_CROP), isos=self.isos[:1])


@EXPERIMENTS.register("denoisers")
def sweep(settings: DenoiserSweep, overwrite: bool = False) -> dict[str, Any]:
    """Run a sweep; what stands in ``table.json``: by method its scores by ISO and its seconds a mosaic megapixel.

    Args:
        settings: of the sweep.
        overwrite: replace another of its name.
    """
    require_free(settings, overwrite)
    noises = {iso: noise_model(settings.camera, iso=iso) for iso in settings.isos}
    makers, frames, own = _makers(settings), list[Pair](), dict[str, OwnNoise]()
    opened = {spec: open_pairs(spec, split="test") for spec in settings.data}
    for spec, pairs in opened.items():
        chosen = some(pairs, settings.count, settings.crop, settings.bin)
        clean = [replace(p, noisy=None, shot_var=None, read_var=None) for p in skip_broken(chosen, spec)]
        own |= own_variances(pairs, clean, noises[settings.isos[0]], settings.seed, settings.bin)
        frames += clean
    claim(settings, overwrite)
    megapixels = sum(pair.raw.numel() / 1e6 for pair in frames)
    rows: dict[str, Any] = {}
    for name, make in makers.items():
        took, rows[name] = 0.0, {"iso": {}}
        for iso, noise in noises.items():
            found = [scored(make(noise), pair, noise, settings.seed, f"{name}, ISO {iso}") for pair in frames]
            scores = with_own_noise(summary([score for score, _ in found]), own)
            rows[name]["iso"][str(iso)] = {key: scores[key] for key in (*METRICS, "own_noise") if key in scores}
            took += sum(seconds for _, seconds in found)
        rows[name]["seconds_per_megapixel"] = took / len(noises) / megapixels
    result = {"settings": asdict(settings), "threads": torch.get_num_threads(), "frames": len(frames), "rows": rows}
    _report(result, settings)
    return result


Maker = Callable[[NoiseModel], Method]
"""Of the noise of the frames: what denoises them."""


def _makers(settings: DenoiserSweep) -> dict[str, Maker]:
    """Every method by name, the noisy input first."""
    device = find_device(settings.device)
    makers: dict[str, Maker] = {"noisy input": lambda noise: lambda _, sample: sample.noisy}
    for spec in installed_classical(settings.classical):
        makers[label_of(spec)] = partial(classical_method, spec, seed=settings.seed)
    for name in settings.denoisers:
        model, info = denoisers.load(find(name))
        makers[Path(name).stem] = _network(model.to(device), CFA(info.get("cfa", "RGGB")), clip=False)
    if settings.pmrid is not None:
        makers["PMRID as published"] = _network(published_pmrid(settings.pmrid).to(device), CFA.RGGB, clip=True)
    return makers


def _network(model: denoisers.Denoiser, own: CFA, clip: bool) -> Maker:
    def method(pair: Pair, sample: Sample) -> Tensor:
        denoised = denoise(model, sample, pair.cfa, own=own)
        return denoised.clamp(0.0, 1.0) if clip else denoised

    return lambda noise: method


def scored(method: Method, pair: Pair, noise: NoiseModel, seed: int, label: str) -> tuple[Score, float]:
    """The scores of a frame, and the seconds that denoising it took."""
    seconds = 0.0

    def timed(pair: Pair, sample: Sample) -> Tensor:
        nonlocal seconds
        start = time.perf_counter()
        denoised = method(pair, sample)
        seconds = time.perf_counter() - start
        return denoised

    return next(score_method(timed, [pair], noise, pair.cfa, seed, label))[0], seconds


def _report(result: dict[str, Any], settings: DenoiserSweep) -> None:
    """``table.json``, the figure, the page and the printed table."""
    folder, rows = run_folder(settings), result["rows"]
    write_json(result, folder / "table.json")
    with replacing(folder / "figure.png") as partial:
        partial.write_bytes(_figure(rows, settings, TITLES))
    curves = {label: _figure(rows, settings, {key: label}) for key, label in TITLES.items()}
    title = f"{settings.name}: noise of {settings.camera}, frames: {result['frames']}"
    head = ["PSNR / PSNR sRGB (dB)", *(f"ISO {iso}" for iso in settings.isos), "s per megapixel"]
    cells = {
        name: [
            *(f"{at['psnr']:.2f} / {at['psnr_srgb']:.2f}" for at in row["iso"].values()),
            f"{row['seconds_per_megapixel']:.2f}" if name != "noisy input" else "",
        ]
        for name, row in rows.items()
    }
    page = Page(title)
    page.add_curves(curves, heading="")
    page.parts.append(Part(head=head, rows=cells))
    written = page.write(folder / "report.html", asdict(settings))
    print_rows(f"{title}; threads: {result['threads']}", head, [[name, *row] for name, row in cells.items()])
    by_iso = {f"{name} at ISO {iso}": at for name, row in rows.items() for iso, at in row["iso"].items()}
    if note := own_noise_note(by_iso):
        print(note)
    print(f"table: {folder / 'table.json'}\nfigure: {folder / 'figure.png'}\npage: {written}")


def _figure(rows: dict[str, Any], settings: DenoiserSweep, titles: Mapping[str, str]) -> bytes:
    """Scores over the ISO: one plot, or four as two by two."""
    from matplotlib.figure import Figure

    side = 2 if len(titles) > 1 else 1
    figure = Figure(figsize=(5.6 * side, 3.8 * side), layout="constrained")
    for axis, (key, label) in zip(figure.subplots(side, side, squeeze=False).flat, titles.items(), strict=True):
        for name, row in rows.items():
            style = {"color": "grey", "linestyle": ":"} if name == "noisy input" else {"marker": "o"}
            axis.plot(settings.isos, [at[key] for at in row["iso"].values()], label=name, **style)
        axis.set(xscale="log", xlabel=f"ISO of {settings.camera}", ylabel=label)
        axis.minorticks_off()
        axis.set_xticks(settings.isos, [str(iso) for iso in settings.isos])
    axis.legend(fontsize=8)
    file = io.BytesIO()
    figure.savefig(file, dpi=130)
    return file.getvalue()
