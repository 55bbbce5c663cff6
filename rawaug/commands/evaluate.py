"""``rawaug evaluate``: PSNR and SSIM of an ISP or a denoiser; the file says which."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from tqdm.auto import tqdm

import denoisers
from denoisers.network import Denoiser
from denoisers.pretrained import FOLDER
from rawaug._version import __version__
from rawaug.bayer import CFA
from rawaug.data import open_pairs
from rawaug.data.pair import Pair
from rawaug.evaluation.page import Page, shown_on_page
from rawaug.evaluation.psnr_r import psnr_r
from rawaug.evaluation.scores import (
    Score,
    classical_method,
    installed_classical,
    network_method,
    row_of,
    score_classical,
    score_denoiser,
    summary,
)
from rawaug.evaluation.tables import print_scores
from rawaug.files import find_weights, read_header, sha256, write_json
from rawaug.isp.model import DictionaryISP
from rawaug.noise import NoiseModel, noise_model


def add_arguments(parser: Any) -> None:
    """The command's arguments."""
    parser.add_argument("weights", type=str, help="a .safetensors file of rawaug fit or rawaug run, or a shipped name")
    parser.add_argument("--data", type=str, required=True, help="folder of RAW files, one file, or kind:path")
    parser.add_argument(
        "--self-ensemble", action="store_true", help="also score the average over eight views (denoisers)"
    )
    noise_help = "noise added to frames without a noisy capture: a preset, a measured camera, or [shot_var, read_var]"
    parser.add_argument("--noise", type=tuple[float, float] | str | None, default=None, help=noise_help)
    parser.add_argument("--seed", type=int, default=0, help="of that noise")
    classical = "classical filters to score on the same noise: NonLocalMeans, Wavelet, TotalVariation, BM3D"
    parser.add_argument("--classical", type=list[str], default=[], help=classical)
    parser.add_argument("--device", type=str, default="cpu", help="device for a denoiser: cpu, cuda, ...")
    page_help = "write an HTML page with a denoiser's scores and crops to this file"
    parser.add_argument("--report", type=str | None, default=None, help=page_help)
    parser.add_argument("--json", type=str | None, default=None, help="write the result as JSON to this file")


def run(arguments: Any) -> None:
    """Print the scores and write the requested files."""
    settings = vars(arguments)
    json_path = settings.pop("json")
    result = evaluate(**settings)
    print_scores(result)
    if json_path:
        write_json(result, json_path)
    if arguments.report:
        print(f"page: {arguments.report}")


def evaluate(
    weights: str | Path,
    data: str,
    self_ensemble: bool = False,
    noise: str | Sequence[float] | None = None,
    seed: int = 0,
    classical: Sequence[str] = (),
    device: str = "cpu",
    report: str | Path | None = None,
) -> dict[str, Any]:
    """Evaluate a file of weights; the result is the JSON object that ``rawaug evaluate --json`` writes.

    Args:
        weights: an ISP's or a denoiser's; the file says which.
        data: a folder of RAW files, or ``kind:path``.
        self_ensemble: average a denoiser over eight views; the scores without it are under ``plain``.
        noise: name or (shot_var, read_var) for frames without a noisy capture; by default what the denoiser was trained
            with.
        seed: of that noise.
        classical: classical denoisers to score beside it on the same noise, see :data:`CLASSICAL`.
        device: where the denoiser runs.
        report: HTML file to write: scores and pictures of a denoiser.

    Raises:
        FileNotFoundError, ValueError: if a file is missing or not rawaug's, a name is unknown, or what is asked for
            is for denoisers and the file is an ISP's.
    """
    classical = installed_classical(classical)
    weights = find_weights(weights, FOLDER)
    kind = read_header(weights)["kind"]
    pairs = open_pairs(data, split="test")
    if kind == "isp":
        if self_ensemble or noise is not None or classical or report is not None:
            raise ValueError(
                f"{weights}: is an ISP; --self-ensemble, --noise, --classical and --report apply to denoisers only"
            )
        isp, bar = DictionaryISP.from_pretrained(weights), tqdm(pairs, desc="evaluate", unit="image", leave=False)
        result = summary([Score(pair.name, psnr_r(isp, pair)) for pair in bar])
    else:
        model, info = denoisers.load(weights)
        levels, cfa = noise_model(noise or info.get("noise", "cycleisp_sidd")), CFA(info.get("cfa", "RGGB"))
        model = model.to(device)
        result = _denoiser_result(model, pairs, levels, cfa, seed, self_ensemble, classical)
        if report is not None:
            runs = {"plain": result.get("plain", result), **({"self_ensemble": result} if self_ensemble else {})}
            page = Page(f"{weights.name} on {data}", {"denoised": [runs]}, result.get("classical", {}))
            methods = {name: classical_method(name, levels, seed) for name in classical}
            methods["denoised"] = network_method(model, cfa)
            for pair in shown_on_page(pairs):
                page.add_frame(row_of(methods, pair, levels, cfa, seed), cfa)
            page.write(Path(report), {"weights": str(weights), "data": data, "noise": noise, "seed": seed})
    return {"kind": kind, "data": data, **result, "weights_sha256": sha256(weights), "version": __version__}


def _denoiser_result(
    model: Denoiser,
    pairs: Sequence[Pair],
    noise: NoiseModel,
    cfa: CFA,
    seed: int,
    self_ensemble: bool,
    classical: Sequence[str],
) -> dict[str, Any]:
    """The summary of a denoiser; with self-ensemble, the one without under ``plain``."""
    result: dict[str, Any] = {"self_ensemble": self_ensemble, "seed": seed}
    plain = summary([score for score, *_ in score_denoiser(model, pairs, noise, cfa, seed, False, "evaluate")])
    if self_ensemble:
        scored = score_denoiser(model, pairs, noise, cfa, seed, True, "evaluate, self-ensemble")
        result |= {"plain": plain, **summary([score for score, *_ in scored])}
    else:
        result |= plain
    if classical:
        result["classical"] = score_classical(classical, pairs, noise, cfa, seed)
    return result
