"""``rawaug evaluate``: PSNR and SSIM of an ISP or a denoiser; the file says which."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal

from denoisers.files import FOLDER
from rawaug.commands import OPTIONS, YAML, require_results
from rawaug.data import open_pairs
from rawaug.data.frames import Readable
from rawaug.data.pair_folder import PairSettings
from rawaug.data.picture_pairs import is_picture_pairs, open_picture_pairs
from rawaug.denoising.denoiser import RawDenoiser, denoiser_file, require_classical
from rawaug.denoising.pictures import PictureDenoiser
from rawaug.evaluation.evaluate import evaluate_raw, evaluation_facts, named_denoiser, require_finite
from rawaug.evaluation.figures import make_panels
from rawaug.evaluation.page import Page, select_for_page
from rawaug.evaluation.picture_trials import PUBLISHED, REGISTERED, picture_scores, print_pictures
from rawaug.evaluation.psnr_r import psnr_r
from rawaug.evaluation.scores import Row, require_numbers, summary
from rawaug.evaluation.tables import first_runs, print_scores
from rawaug.evaluation.trials import make_trial, make_trials, measure_own_noise, own_noise_note
from rawaug.evaluation.verdict import verdict
from rawaug.files import find_weights, read_metadata, write_json
from rawaug.isp.model import DictionaryISP
from rawaug.noise import NoiseSpec, noise_model
from rawaug.progress import progress
from rawaug.registry import Spec

PRESET = "cycleisp_sidd"
"""The noise of frames without a capture if the denoiser does not say which noise it was trained with."""


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
    as_shot: bool = False,
    tone: str | None = None,
    device: str = "cpu",
    report: str | None = None,
    json: str | None = None,
    overwrite: bool = False,
    settings: Annotated[PairSettings, OPTIONS] | None = None,
) -> dict[str, Any]:
    """Measure PSNR and SSIM of a denoiser or an ISP.

    Args:
        weights: a shipped name, a .safetensors file of rawaug fit or rawaug run, or any denoiser that rawaug benchmark
            takes: published weights of PMRID, PBRID, BF-DnCNN or FFDNet, an .onnx file, or a filter.
        data: folder of clean RAW files, one file, or kind:path; pairs:PATH for noisy/clean pairs; of developed
            pictures cc15:DIR, polyu:DIR, sidd-srgb:DIR or pictures:DIR.
        self_ensemble: also score the average over eight views (denoisers).
        views: also score the average over 4 views, the flips, or 8, with quarter turns.
        noise: noise to add to frames without a noisy capture: a preset, a measured camera, [shot_var, read_var], camera
            (the law that the denoiser was trained for), an ISP's file, a camera's .yaml sheet, or a model as
            {name, key: value}; by default that of the denoiser's training.
        seed: seed of that noise.
        bin: K bins the frames K x K by colour site first, for clean references of real photographs (denoisers).
        classical: classical filters to score on the same noise: NonLocalMeans, Wavelet, TotalVariation, BM3D.
        as_shot: give an ISP the as-shot gains of each frame.
        tone: tone curve of the pictures, for an ISP that has several, such as linear for LibRaw's rendering.
        device: device for a denoiser: cpu, cuda, ...
        report: write an HTML page with a denoiser's scores and crops to this file.
        json: write the result as JSON to this file.
        overwrite: replace these two files if they exist.
        settings: settings of pairs:PATH.

    Returns:
        What ``--json`` writes.
    """
    require_results(json, report, overwrite, [weights, data])
    require_classical(classical or ())

    if views is None and self_ensemble:
        views = 8
    settings = settings or PairSettings()
    for_raw = noise is not None or bin != 1 or bool(seed) or report is not None
    if is_isp(weights):
        if for_raw or views or classical:
            options = "--self-ensemble, --views, --noise, --seed, --bin, --classical and --report"
            raise ValueError(f"{weights}: is an ISP; {options} are for denoisers")
        return evaluate_isp(weights, data, as_shot, tone, json, settings)

    if as_shot or tone is not None:
        raise ValueError(f"{weights}: is a denoiser; --as-shot and --tone are for ISPs")
    if is_picture_pairs(data):
        if for_raw:
            raise ValueError(f"{data}: has developed pictures; --noise, --bin, --seed and --report are for RAW")
        return evaluate_pictures(weights, data, views, classical or (), device, json, settings)

    denoiser = replace(named_denoiser(weights, device), checked=False).require_mosaic()
    filters = [RawDenoiser.of(spec) for spec in classical or ()]
    test_noise = noise or denoiser.info.get("noise", PRESET)
    model = noise_model(test_noise, info=denoiser.info)

    pairs = open_pairs(data, split="test", **vars(settings))
    frames = Readable(measure_own_noise(pairs).binned(bin).kept())
    for _ in frames:
        pass  # finds the pairs that cannot be read
    trials = make_trials(frames.readable(), lambda pair: make_trial(pair, model, denoiser.cfa, seed))

    facts = {**evaluation_facts("denoiser", data, denoiser_file(weights), bin), "seed": seed}
    if frames.broken:
        facts["broken"] = frames.reasons()
    for scores in evaluate_raw(denoiser, filters, trials, views or 1):
        result = {**facts, **scores}
        print_scores(result)
        if json is not None:
            write_json(result, json)

    note = own_noise_note({"the denoiser": result, **result.get("classical", {})})
    if note:
        print(note)
    if report:
        kinds = {"plain": result.get("plain", result)}
        if "plain" in result:
            kinds["self_ensemble"] = result
        scores_by_arm, others = {denoiser.name: [kinds]}, result.get("classical", {})
        page = Page(f"{denoiser.name} on {data}", verdict(scores_by_arm, others).sentence)
        own_noise = own_noise_note(first_runs(scores_by_arm, others))
        page.add_facts({"Noise": test_noise, "Seed": str(seed), "Own noise": own_noise}, scores_by_arm)
        page.add_scores(scores_by_arm, others)
        for trial in select_for_page(trials):
            page.add_frame(make_panels([*filters, denoiser], trial))
        command = {"weights": weights, "data": data, "noise": noise, "seed": seed}
        print(f"page: {page.write(Path(report), command)}")

    require_numbers([result, result.get("plain", {}), *result.get("classical", {}).values()])
    return result


def is_isp(weights: str) -> bool:
    """Tell whether a name or a file stands for an ISP rather than for a denoiser."""
    if Path(weights).suffix not in ("", ".safetensors"):
        return False

    try:
        file = find_weights(weights, FOLDER)
    except FileNotFoundError:
        return False  # the resolver of denoisers says what there is

    return read_metadata(file).get("kind") == "isp"


def evaluate_isp(
    weights: str, data: str, as_shot: bool, tone: str | None, json: str | None, settings: PairSettings
) -> dict[str, Any]:
    """Print and write the PSNR_r of an ISP on the frames of a test set; return the result, as in the JSON.

    ``as_shot`` gives the ISP the gains of each frame; ``tone`` gives it the tone curve of all.
    """
    file = find_weights(weights)
    isp = DictionaryISP.from_pretrained(file)
    pairs = Readable(open_pairs(data, split="test", **vars(settings)))

    rows = []
    for pair in progress(pairs, label="evaluate", unit="image"):
        psnr = require_finite(pair.name, psnr_r(isp, pair, as_shot, tone=tone))
        rows.append(Row("ISP", pair.name, "", "", "raw", psnr))

    result = {**evaluation_facts("isp", data, file), **summary(rows)}
    if as_shot or tone is not None:
        result |= {"as_shot": as_shot, "tone": tone}
    if pairs.broken:
        result["broken"] = pairs.reasons()
    print_scores(result)
    if json is not None:
        write_json(result, json)

    require_numbers([result])
    return result


def evaluate_pictures(
    weights: str,
    data: str,
    views: int | None,
    classical: Sequence[Spec],
    device: str,
    json: str | None,
    settings: PairSettings,
) -> dict[str, Any]:
    """Print and write the scores of a denoiser of pictures, beside filters; return the result, as in the JSON.

    ``plain`` holds the scores with the default number of views, if more are requested.
    """
    if settings != PairSettings(noisy=settings.noisy, clean=settings.clean):
        raise ValueError(f"{data}: has developed pictures; a CFA and levels are for RAW")

    plain = PictureDenoiser.of(weights, device)
    filters = [PictureDenoiser.of(spec) for spec in classical]
    denoisers = [plain, *filters]
    main = plain
    if views:
        main = replace(plain, name=f"{plain.name}, {views} views", views=views)
        denoisers.insert(1, main)

    pairs = open_picture_pairs(data, settings.noisy, settings.clean)
    scores = picture_scores(denoisers, pairs)
    print_pictures(data, scores)

    rows = scores["rows"]
    result = {
        **evaluation_facts("denoiser", data),
        **rows[main.name][PUBLISHED],
        "registered": rows[main.name][REGISTERED],
    }
    if views:
        result |= {"self_ensemble": True, "views": views, "plain": rows[plain.name][PUBLISHED]}
    for denoiser in filters:
        result.setdefault("classical", {})[denoiser.name] = rows[denoiser.name]
    if json is not None:
        write_json(result, json)

    require_numbers([result, result.get("plain", {}), *result.get("classical", {}).values()])
    return result
