"""``rawaug evaluate``: PSNR and SSIM of an ISP or a denoiser; the file says which."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
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
    score_classical,
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
) -> None:
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

    Raises:
        FileNotFoundError, ValueError: if a file is missing or not rawaug's, a name is unknown, what is asked for
            is for denoisers and the file is an ISP's, no frame can be read, or a result is not finite.
    """

    def written(result: dict[str, Any]) -> None:
        print_scores(result)
        if json:
            write_json(result, json)

    if json:
        require_writable(json)
    more = {"first": written, "bin": bin, **vars(settings or PairSettings())}
    result = evaluate(weights, data, self_ensemble, noise, seed, classical or (), device, report, views, **more)
    written(result)
    if note := own_noise_note({"the denoiser": result, **result.get("classical", {})}):
        print(note)
    if report:
        print(f"page: {report}")
    require_numbers([result, result.get("plain", {}), *result.get("classical", {}).values()])


def evaluate(
    weights: str | Path,
    data: str | Sequence[Pair],
    self_ensemble: bool = False,
    noise: NoiseSpec | None = None,
    seed: int = 0,
    classical: Sequence[Spec] = (),
    device: str = "cpu",
    report: str | Path | None = None,
    views: Literal[4, 8] | None = None,
    first: Callable[[dict[str, Any]], None] | None = None,
    bin: int = 1,
    **settings: Any,
) -> dict[str, Any]:
    """The JSON object that ``rawaug evaluate --json`` writes; arguments as in :func:`run`.

    Args:
        data: as in the command, or pairs.
        first: called with the result without self-ensemble and classical denoisers where these are still to come.
        bin: of the frames, by colour site, see :func:`rawaug.data.open_pairs`; for denoisers.
        settings: of ``pairs:PATH``, see :class:`rawaug.data.PairFolder`.
    """
    require_classical(classical)
    where = find_device(device)
    if report is not None:
        require_writable(report)
    weights = find_weights(weights, FOLDER)
    kind = read_header(weights)["kind"]
    frames = open_pairs(data, split="test", **settings)
    pairs = Readable(frames if bin == 1 else Binned(frames, bin))
    data = data if isinstance(data, str) else f"{len(pairs)} pairs"
    about = {"kind": kind, "data": data}, {"weights_sha256": sha256(weights), "version": __version__}
    if kind == "isp":
        if self_ensemble or views or noise is not None or classical or report is not None or bin != 1:
            options = "--self-ensemble, --views, --noise, --bin, --classical and --report"
            raise ValueError(f"{weights}: is an ISP; {options} are for denoisers")
        isp = DictionaryISP.from_pretrained(weights)
        frames = progress(pairs, label="evaluate", unit="image")
        result = summary([_finite(Score(pair.name, psnr_r(isp, pair))) for pair in frames])
    else:
        scoring = _Scoring(weights, pairs, noise, seed, where)
        result = scoring.plain() | ({} if bin == 1 else {"bin": bin})
        own = own_variances(frames, pairs.kept(), scoring.levels, seed, bin)
        result = with_own_noise(result, own)
        ensemble = views or (8 if self_ensemble else 1)
        if first is not None and (ensemble > 1 or classical):
            first({**about[0], **result, **about[1]})
        if ensemble > 1:
            result = with_own_noise(scoring.with_views(ensemble, result), own)
        if classical:
            found = score_classical(classical, pairs, scoring.levels, scoring.cfa, seed)
            result["classical"] = {name: with_own_noise(scores, own) for name, scores in found.items()}
        if report is not None:
            runs = {"plain": result.get("plain", result), **({"self_ensemble": result} if ensemble > 1 else {})}
            facts = {"Noise": scoring.named, "Seed": str(seed)}
            results = {weights.stem: [runs]}
            page = Page.of_scores(f"{weights.stem} on {data}", results, result.get("classical", {}), facts)
            scoring.add_frames(page, classical)
            page.write(Path(report), {"weights": str(weights), "data": data, "noise": noise, "seed": seed})
    if pairs.broken:
        result["broken"] = pairs.reasons()
    return {**about[0], **result, **about[1]}


class _Scoring:
    """A denoiser on the frames, as it is tested."""

    def __init__(
        self, weights: Path, pairs: Readable, noise: NoiseSpec | None, seed: int, device: torch.device
    ) -> None:
        model, info = denoisers.load(weights)
        if model.upscale > 1:
            raise ValueError(f"{weights}: demosaics, too; rawaug run demosaic --denoiser.start {weights} scores it")
        self.name = weights.stem
        self.model, self.pairs, self.seed = model.to(device), pairs, seed
        self.named = noise or info.get("noise", "cycleisp_sidd")
        self.levels = noise_model(self.named)
        self.cfa = CFA(info.get("cfa", "RGGB"))
        self.at_test = ESTIMATORS.make(info.get("estimator", "supervised")).at_test

    def plain(self) -> dict[str, Any]:
        """The summary without self-ensemble."""
        return {"self_ensemble": False, "seed": self.seed, **self._summary(1, "evaluate")}

    def with_views(self, views: int, plain: dict[str, Any]) -> dict[str, Any]:
        """The summary of the average over ``views``; the one without is under ``plain``."""
        several = {"self_ensemble": True, "seed": self.seed, "views": views}
        without = {key: value for key, value in plain.items() if key not in several}
        return {**several, "plain": without, **self._summary(views, f"evaluate, {views} views")}

    def method(self, views: int = 1) -> Method:
        """The denoiser, as what scores and pictures call."""
        return network_method(self.model, self.cfa, views=views, at_test=self.at_test)

    def add_frames(self, page: Page, classical: Sequence[Spec]) -> None:
        """Pictures of some frames: noisy, denoised by each filter and by the denoiser, clean."""
        methods = {label_of(spec): classical_method(spec, self.levels, self.seed) for spec in classical}
        methods[self.name] = self.method()
        for pair in shown_on_page(self.pairs.kept()):
            page.add_frame(row_of(methods, pair, self.levels, self.cfa, self.seed), self.cfa)

    def _summary(self, views: int, label: str) -> dict[str, Any]:
        scored = score_method(self.method(views), self.pairs, self.levels, self.cfa, self.seed, label)
        return summary([_finite(score) for score, *_ in scored])


def _finite(score: Score) -> Score:
    """The score, unless what was compared is not finite: weights of which the first frame shows that are of no use."""
    if math.isnan(score.psnr):
        raise ValueError(f"{score.name}: the result is not finite; the weights are damaged")
    return score
