"""The scores of one denoiser on a test set, beside classical filters: ``rawaug evaluate`` on RAW and on pictures."""

from __future__ import annotations

import math
import sys
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import Any

from rawaug.data import open_pairs
from rawaug.data.frames import Readable
from rawaug.data.pair_folder import PairSettings
from rawaug.data.picture_pairs import open_picture_pairs
from rawaug.denoising.denoiser import RawDenoiser, denoiser_file
from rawaug.denoising.pictures import PictureDenoiser
from rawaug.evaluation.figures import make_panels
from rawaug.evaluation.page import Page, select_for_page
from rawaug.evaluation.picture_trials import PUBLISHED, REGISTERED, picture_scores, print_pictures
from rawaug.evaluation.scores import NOISY, Row, group_rows, score, summary
from rawaug.evaluation.tables import print_scores
from rawaug.evaluation.trials import Trial, make_trial, make_trials, measure_own_noise, own_noise_note
from rawaug.files import sha256, write_json
from rawaug.noise import NoiseSpec, noise_model
from rawaug.registry import Spec
from rawaug.version import __version__

PRESET = "cycleisp_sidd"
"""The noise of frames without a capture if the denoiser does not say which noise it was trained with."""


def evaluation_facts(kind: str, data: str, file: Path | None = None, bin: int = 1) -> dict[str, Any]:
    """State the facts of a result besides scores: the kind of weights, denoiser or isp, their file's hash, ..."""
    facts: dict[str, Any] = {"kind": kind, "data": data}
    if file is not None:
        facts["weights_sha256"] = sha256(file)
    facts["version"] = __version__
    if bin != 1:
        facts["bin"] = bin

    return facts


def evaluate_raw(
    weights: str,
    data: str,
    *,
    views: int = 1,
    noise: NoiseSpec | None = None,
    seed: int = 0,
    bin: int = 1,
    classical: Sequence[Spec] = (),
    device: str = "cpu",
    json: str | None = None,
    report: str | None = None,
    settings: PairSettings | None = None,
) -> dict[str, Any]:
    """Score a denoiser of RAW, print its tables and write its files; return the result, as in the JSON.

    The plain scores are printed and written first, then those of the self-ensemble and of filters, which take longer.

    Args:
        weights: a name or a file, see :meth:`rawaug.RawDenoiser.of`.
        data: the test set, by a path or ``kind:path``.
        views: 1, or 4 or 8 to score the self-ensemble, too.
        noise: noise to add to frames without a capture; None for that of the denoiser's training.
        seed: seed of that noise.
        bin: the factor by which the frames are binned.
        classical: filters to score on the same noise.
        device: device on which a network runs.
        json: file to write the result to; None for none.
        report: page to write scores and crops to; None for none.
        settings: settings of ``pairs:PATH``.
    """
    denoiser = replace(named_denoiser(weights, device), checked=False).require_mosaic()
    filters = [RawDenoiser.of(spec) for spec in classical]
    test_noise = noise or denoiser.info.get("noise", PRESET)
    model = noise_model(test_noise, info=denoiser.info)

    pairs = open_pairs(data, split="test", **vars(settings or PairSettings()))
    frames = Readable(measure_own_noise(pairs).binned(bin).kept())
    for _ in frames:
        pass  # finds the pairs that cannot be read
    trials = make_trials(frames.readable(), lambda pair: make_trial(pair, model, denoiser.cfa, seed))

    facts = evaluation_facts("denoiser", data, denoiser_file(weights), bin)
    unreadable = {}
    if frames.broken:
        unreadable["broken"] = frames.reasons()

    noisy, plain = group_rows(_finite_rows([NOISY, denoiser], trials, "evaluate")).values()
    plain_scores = summary(plain, noisy)
    result = {**facts, "self_ensemble": False, "seed": seed, **plain_scores, **unreadable}
    print_scores(result)
    if json is not None:
        write_json(result, json)

    compared = list(filters)
    if views > 1:
        compared.insert(0, replace(denoiser, name="views", views=views))

    if compared:
        rows = group_rows(_finite_rows(compared, trials, "evaluate, the rest"))

        if views > 1:
            about = {"self_ensemble": True, "seed": seed, "views": views, "plain": plain_scores}
            result = {**facts, **about, **summary(rows.pop("views"), noisy), **unreadable}
        for name, of_filter in rows.items():
            result.setdefault("classical", {})[name] = summary(of_filter, noisy)
        print_scores(result)
        if json is not None:
            write_json(result, json)

    note = own_noise_note({"the denoiser": result, **result.get("classical", {})})
    if note:
        print(note)
    if report:
        runs = {"plain": result.get("plain", result)}
        if "plain" in result:
            runs["self_ensemble"] = result
        about = {"Noise": test_noise, "Seed": str(seed)}
        title = f"{denoiser.name} on {data}"
        page = Page.of_scores(title, {denoiser.name: [runs]}, result.get("classical", {}), about)
        for trial in select_for_page(trials):
            page.add_frame(make_panels([*filters, denoiser], trial))
        command = {"weights": weights, "data": data, "noise": noise, "seed": seed}
        print(f"page: {page.write(Path(report), command)}")

    return result


def evaluate_pictures(
    weights: str,
    data: str,
    *,
    views: int = 1,
    classical: Sequence[Spec] = (),
    device: str = "cpu",
    json: str | None = None,
    settings: PairSettings | None = None,
) -> dict[str, Any]:
    """Score a denoiser of pictures, beside classical filters; return the result, as in the JSON.

    ``plain`` holds the result with the default number of views, if more are requested. The arguments are those of
    :func:`evaluate_raw`.
    """
    settings = settings or PairSettings()
    if settings != PairSettings(noisy=settings.noisy, clean=settings.clean):
        raise ValueError(f"{data}: has developed pictures; a CFA and levels are for RAW")

    plain = PictureDenoiser.of(weights, device)
    filters = [PictureDenoiser.of(spec) for spec in classical]
    denoisers = [plain, *filters]
    main = plain
    if views > 1:
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
    if views > 1:
        result |= {"self_ensemble": True, "views": views, "plain": rows[plain.name][PUBLISHED]}
    for denoiser in filters:
        result.setdefault("classical", {})[denoiser.name] = rows[denoiser.name]

    if json is not None:
        write_json(result, json)
    return result


def named_denoiser(spec: str, device: str = "cpu") -> RawDenoiser:
    """Open the denoiser that the command line names; only here is ``package.module:function`` imported."""
    module, colon, function = spec.partition(":")
    if not colon or Path(spec).suffix in (".onnx", ".safetensors"):
        return RawDenoiser.of(spec, device)

    sys.path.insert(0, str(Path.cwd()))  # as python -m does
    try:
        denoiser = getattr(import_module(module), function)
    except (ImportError, AttributeError, ValueError) as error:
        raise ValueError(f"{spec}: cannot be imported: {error}") from None
    finally:
        sys.path.pop(0)

    return RawDenoiser.of(denoiser, device, name=spec)


def _finite_rows(denoisers: Sequence[Any], trials: Iterable[Trial], label: str) -> Iterator[Row]:
    """Yield the scores; ValueError at the first NaN, which damaged weights give at their first frame."""
    for row in score(denoisers, trials, label):
        require_finite(row.frame, row.psnr)
        yield row


def require_finite(frame: str, value: float) -> float:
    """Return the score of a frame; ValueError if it is NaN, which means that the weights are damaged."""
    if math.isnan(value):
        raise ValueError(f"{frame}: the result is not finite; the weights are damaged")

    return value
