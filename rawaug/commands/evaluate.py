"""``rawaug evaluate``: PSNR and SSIM of an ISP or a denoiser; the file says which."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

import torch

import denoisers
from denoisers.files import FOLDER
from rawaug import __version__
from rawaug.bayer import CFA
from rawaug.commands import OPTIONS, YAML
from rawaug.data import open_pairs
from rawaug.data.folders import Readable
from rawaug.data.pair_folder import PairSettings
from rawaug.data.pairs import Binned, Pair
from rawaug.evaluation.contestants import require_mosaic
from rawaug.evaluation.own_noise import own_noise_note, own_variances, with_own_noise
from rawaug.evaluation.page import Page, shown_on_page
from rawaug.evaluation.psnr_r import psnr_r
from rawaug.evaluation.scores import (
    Method,
    Score,
    classical_method,
    label_of,
    network_method,
    require_classical,
    require_numbers,
    row_of,
    score_method,
    summary,
)
from rawaug.evaluation.tables import print_scores
from rawaug.files import find_weights, read_header, require_writable, sha256, write_json
from rawaug.isp.model import DictionaryISP
from rawaug.kernels.runtime import find_device
from rawaug.noise import NoiseSpec, noise_model
from rawaug.progress import progress
from rawaug.registry import ESTIMATORS, Spec


def run(
    weights: str,
    /,
    *,
    data: str,
    self_ensemble: bool = False,
    views: Literal[4, 8] | None = None,
    noise: Annotated[NoiseSpec | None, YAML] = None,
    seed: int = 0,
    bin: int = 1,
    classical: Annotated[list[Spec] | None, YAML] = None,
    device: str = "cpu",
    report: str | None = None,
    json: str | None = None,
    settings: Annotated[PairSettings, OPTIONS] | None = None,
) -> dict[str, Any]:
    """Measure PSNR and SSIM of a denoiser or an ISP.

    Args:
        weights: a .safetensors file of rawaug fit or rawaug run, or a shipped name.
        data: folder of clean RAW files, one file, or kind:path; pairs:PATH for noisy/clean pairs.
        self_ensemble: also score the average over eight views (denoisers).
        views: also score the average over 4 views, the flips, or 8, with quarter turns.
        noise: noise added to frames without a noisy capture: a preset, a measured camera, [shot_var, read_var], or
            {name, settings}.
        seed: seed of that noise.
        bin: K bins the frames K x K by colour site first: clean references of real photographs (denoisers).
        classical: classical filters to score on the same noise: NonLocalMeans, Wavelet, TotalVariation, BM3D.
        device: device for a denoiser: cpu, cuda, ...
        report: write an HTML page with a denoiser's scores and crops to this file.
        json: write the result as JSON to this file.
        settings: of pairs:PATH.

    Returns:
        What ``--json`` writes.
    """
    for path in filter(None, (json, report)):
        require_writable(path)
    require_classical(classical or ())
    where, file = find_device(device), find_weights(weights, FOLDER)
    kind = read_header(file)["kind"]
    if kind == "isp" and (self_ensemble or views or noise is not None or bin != 1 or classical or report):
        options = "--self-ensemble, --views, --noise, --bin, --classical and --report"
        raise ValueError(f"{weights}: is an ISP; {options} are for denoisers")
    frames = open_pairs(data, split="test", **vars(settings or PairSettings()))
    pairs = Readable(frames if bin == 1 else Binned(frames, bin))
    about: dict[str, Any] = {"kind": kind, "data": data, "weights_sha256": sha256(file), "version": __version__}
    about |= {} if bin == 1 else {"bin": bin}

    def written(found: dict[str, Any]) -> dict[str, Any]:
        result = about | found | ({"broken": pairs.reasons()} if pairs.broken else {})
        print_scores(result)
        if json:
            write_json(result, json)
        return result

    if kind == "isp":
        isp, images = DictionaryISP.from_pretrained(file), progress(pairs, label="evaluate", unit="image")
        result = written(summary(_finite(Score(pair.name, psnr_r(isp, pair))) for pair in images))
    else:
        test = _Test(file, pairs, noise, seed, where, classical or ())
        result = written(test.result(frames, bin, views or (8 if self_ensemble else 1), written))
        if note := own_noise_note({"the denoiser": result, **result.get("classical", {})}):
            print(note)
        if report:
            about_page = {"weights": weights, "data": data, "noise": noise, "seed": seed}
            print(f"page: {test.page(data, result).write(Path(report), about_page)}")
    require_numbers([result, result.get("plain", {}), *result.get("classical", {}).values()])
    return result


class _Test:
    """A denoiser on frames, beside classical filters."""

    def __init__(
        self,
        weights: Path,
        pairs: Readable,
        noise: NoiseSpec | None,
        seed: int,
        device: torch.device,
        classical: Sequence[Spec],
    ) -> None:
        model, info = denoisers.load(weights)
        require_mosaic(weights, model)
        self.name, self.pairs, self.seed = weights.stem, pairs, seed
        self.noise = noise or info.get("noise", "cycleisp_sidd")
        self.levels, self.cfa = noise_model(self.noise), CFA(info.get("cfa", "RGGB"))
        at_test = ESTIMATORS.make(info.get("estimator", "supervised")).at_test
        self.network = partial(network_method, model.to(device), self.cfa, at_test=at_test)
        self.filters = {label_of(spec): classical_method(spec, self.levels, seed) for spec in classical}

    def result(
        self, frames: Sequence[Pair], factor: int, views: int, first: Callable[[dict[str, Any]], Any]
    ) -> dict[str, Any]:
        """The scores; of several views, with those of a single one as ``plain``."""
        found = self.scores(self.network(), "evaluate")
        own = own_variances(frames, self.pairs.kept(), self.levels, self.seed, factor)
        plain = with_own_noise(found, own)
        result = {"self_ensemble": False, "seed": self.seed, **plain}
        if views > 1 or self.filters:
            first(result)
        if views > 1:
            found = with_own_noise(self.scores(self.network(views=views), f"evaluate, {views} views"), own)
            result = {"self_ensemble": True, "seed": self.seed, "views": views, "plain": plain, **found}
        filters = {name: with_own_noise(self.scores(method, name), own) for name, method in self.filters.items()}
        return result | ({"classical": filters} if filters else {})

    def scores(self, method: Method, label: str) -> dict[str, Any]:
        scored = score_method(method, self.pairs, self.levels, self.cfa, self.seed, label)
        return summary(map(_finite, scored))

    def page(self, data: str, result: Mapping[str, Any]) -> Page:
        """The scores, and some frames noisy, denoised by each filter and by the denoiser, and clean."""
        runs = {"plain": result.get("plain", result)} | ({"self_ensemble": result} if "plain" in result else {})
        facts = {"Noise": self.noise, "Seed": str(self.seed)}
        page = Page.of_scores(f"{self.name} on {data}", {self.name: [runs]}, result.get("classical", {}), facts)
        methods = {**self.filters, self.name: self.network()}
        for pair in shown_on_page(self.pairs.kept()):
            page.add_frame(row_of(methods, pair, self.levels, self.cfa, self.seed), self.cfa)
        return page


def _finite(score: Score) -> Score:
    """The score, unless what was compared is not finite: weights of which the first frame shows that are of no use."""
    if math.isnan(score.psnr):
        raise ValueError(f"{score.name}: the result is not finite; the weights are damaged")
    return score
