"""``rawaug evaluate``: PSNR and SSIM of an ISP or a denoiser; the file says which."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal

from denoisers.files import FOLDER
from rawaug.camera.psnr_r import psnr_r
from rawaug.commands import OPTIONS, YAML
from rawaug.data import open_pairs
from rawaug.data.folders import Kept, Readable
from rawaug.data.pair_folder import PairSettings
from rawaug.data.pairs import Binned
from rawaug.data.picture_pairs import is_picture_pairs, open_picture_pairs
from rawaug.denoising.denoiser import RawDenoiser, require_classical
from rawaug.denoising.pictures import PictureDenoiser
from rawaug.evaluation.figures import panels_of
from rawaug.evaluation.page import Page, select_for_page
from rawaug.evaluation.picture_trials import PUBLISHED, REGISTERED, picture_scores, print_pictures
from rawaug.evaluation.scores import NOISY, Row, group_rows, require_numbers, score, summary
from rawaug.evaluation.tables import print_scores
from rawaug.evaluation.trials import Measured, Trial, make_trials, own_noise_note, trial_of
from rawaug.files import find_weights, read_header, require_writable, sha256, write_json
from rawaug.isp.model import DictionaryISP
from rawaug.noise import NoiseSpec, noise_model
from rawaug.progress import progress
from rawaug.registry import Spec
from rawaug.version import __version__


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
        data: folder of clean RAW files, one file, or kind:path; pairs:PATH for noisy/clean pairs; of developed
            pictures cc15:DIR, polyu:DIR, sidd-srgb:DIR or pictures:DIR.
        self_ensemble: also score the average over eight views (denoisers).
        views: also score the average over 4 views, the flips, or 8, with quarter turns.
        noise: noise added to frames without a noisy capture: a preset, a measured camera, [shot_var, read_var], or
            {name, settings}.
        seed: seed of that noise.
        bin: K bins the frames K x K by colour site first: clean references of real photographs (denoisers).
        classical: classical filters to score on the same noise: NonLocalMeans, Wavelet, TotalVariation, BM3D, WNNM,
            KSVD, GLIDE.
        device: device for a denoiser: cpu, cuda, ...
        report: write an HTML page with a denoiser's scores and crops to this file.
        json: write the result as JSON to this file.
        settings: of pairs:PATH.

    Returns:
        What ``--json`` writes.
    """
    for option, path in (("json", json), ("report", report)):
        if path is not None:
            require_writable(path, option)
    require_classical(classical or ())
    if is_picture_pairs(data):
        if noise is not None or bin != 1 or report:
            raise ValueError(f"{data}: has developed pictures; --noise, --bin and --report are for RAW")
        turns = views or (8 if self_ensemble else None)
        return _pictures(weights, device, turns, data, [str(spec) for spec in classical or ()], json, settings)
    file = find_weights(weights, FOLDER)
    kind = read_header(file)["kind"]
    if kind == "isp" and (self_ensemble or views or noise is not None or bin != 1 or classical or report):
        options = "--self-ensemble, --views, --noise, --bin, --classical and --report"
        raise ValueError(f"{weights}: is an ISP; {options} are for denoisers")
    test = None if kind == "isp" else _Test(file, noise, seed, device, classical or ())
    frames = open_pairs(data, split="test", **vars(settings or PairSettings()))
    pairs = Readable(frames if kind == "isp" else Kept(Binned(Measured(frames), bin)))
    about: dict[str, Any] = {"kind": kind, "data": data, "weights_sha256": sha256(file), "version": __version__}
    about |= {} if bin == 1 else {"bin": bin}

    def written(found: dict[str, Any]) -> dict[str, Any]:
        result = about | found | ({"broken": pairs.reasons()} if pairs.broken else {})
        print_scores(result)
        if json:
            write_json(result, json)
        return result

    if test is None:
        isp, images = DictionaryISP.from_pretrained(file), progress(pairs, label="evaluate", unit="image")
        scores = ((pair.name, _finite(pair.name, psnr_r(isp, pair))) for pair in images)
        result = written(summary(Row("ISP", name, "", "", "raw", psnr) for name, psnr in scores))
    else:
        result = written(test.result(pairs, views or (8 if self_ensemble else 1), written))
        if note := own_noise_note({"the denoiser": result, **result.get("classical", {})}):
            print(note)
        if report:
            about_page = {"weights": weights, "data": data, "noise": noise, "seed": seed}
            print(f"page: {test.page(data, result).write(Path(report), about_page)}")
    require_numbers([result, result.get("plain", {}), *result.get("classical", {}).values()])
    return result


def _pictures(
    weights: str,
    device: str,
    views: int | None,
    data: str,
    classical: Sequence[str],
    json: str | None,
    settings: PairSettings | None,
) -> dict[str, Any]:
    """The result of a denoiser of pictures, beside classical filters, as published and registered.

    That of more views than usual has the usual result under ``plain``.
    """
    given = settings or PairSettings()
    plain = PictureDenoiser.of(weights, device)
    ensemble = [replace(plain, name=f"{plain.name}, {views} views", views=views)] if views else []
    filters = [PictureDenoiser.of(spec) for spec in classical]
    tested = [plain, *ensemble, *filters]
    result = picture_scores(tested, open_picture_pairs(data, given.noisy, given.clean))
    print_pictures(data, result)
    rows = result["rows"]
    own = rows[tested[len(ensemble)].name]
    found = {"kind": "denoiser", "data": data, "version": __version__, **own[PUBLISHED], "registered": own[REGISTERED]}
    if ensemble:
        found |= {"self_ensemble": True, "views": views, "plain": rows[plain.name][PUBLISHED]}
    found |= {"classical": {one.name: rows[one.name] for one in filters}} if classical else {}
    if json:
        write_json(found, json)
    return found


class _Test:
    """A denoiser on frames, beside classical filters."""

    def __init__(self, weights: Path, noise: NoiseSpec | None, seed: int, device: str, filters: Sequence[Spec]) -> None:
        self.denoiser = RawDenoiser.of(weights, device, checked=False).require_mosaic()
        self.seed, self.noise = seed, noise or self.denoiser.info.get("noise", "cycleisp_sidd")
        self.filters = [RawDenoiser.of(spec) for spec in filters]
        self.trials: Sequence[Trial] = []

    def result(self, pairs: Readable, views: int, first: Callable[[dict[str, Any]], Any]) -> dict[str, Any]:
        """The scores; of several views, with those of a single one as ``plain``."""
        levels, cfa = noise_model(self.noise), self.denoiser.cfa
        deque(pairs, maxlen=0)  # finds those that cannot be read
        self.trials = make_trials(pairs.kept(), lambda pair: trial_of(pair, levels, cfa, self.seed))
        noisy, plain = group_rows(self.scored([NOISY, self.denoiser], "evaluate")).values()
        result = {"self_ensemble": False, "seed": self.seed, **summary(plain, noisy)}
        if views > 1 or self.filters:
            first(result)
        ensemble = [replace(self.denoiser, name="views", views=views)] if views > 1 else []
        others = group_rows(self.scored([*ensemble, *self.filters], "evaluate, the rest"))
        if views > 1:
            found = {"self_ensemble": True, "seed": self.seed, "views": views, "plain": summary(plain, noisy)}
            result = found | summary(others.pop("views"), noisy)
        filters = {name: summary(rows, noisy) for name, rows in others.items()}
        return result | ({"classical": filters} if filters else {})

    def scored(self, denoisers: Sequence[Any], label: str) -> Iterator[Row]:
        for row in score(denoisers, self.trials, label) if denoisers else ():
            _finite(row.frame, row.psnr)
            yield row

    def page(self, data: str, result: Mapping[str, Any]) -> Page:
        """The scores, and some frames noisy, denoised by each filter and by the denoiser, and clean."""
        runs = {"plain": result.get("plain", result)} | ({"self_ensemble": result} if "plain" in result else {})
        facts, name = {"Noise": self.noise, "Seed": str(self.seed)}, self.denoiser.name
        page = Page.of_scores(f"{name} on {data}", {name: [runs]}, result.get("classical", {}), facts)
        for trial in select_for_page(self.trials):
            page.add_frame(panels_of([*self.filters, self.denoiser], trial))
        return page


def _finite(frame: str, value: float) -> float:
    """The score, unless it is NaN, which damaged weights are at their first frame: no other needs to be tried."""
    if math.isnan(value):
        raise ValueError(f"{frame}: the result is not finite; the weights are damaged")
    return value
