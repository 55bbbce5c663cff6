"""``rawaug benchmark``: denoisers on frozen noise over clean references; see :mod:`rawaug.evaluation.benchmark`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

from rawaug.commands import YAML, require_results
from rawaug.data import open_pairs
from rawaug.data.frames import as_frames
from rawaug.data.picture_pairs import is_picture_pairs, open_picture_pairs
from rawaug.denoising.denoiser import RawDenoiser, shipped_of_mosaics
from rawaug.denoising.guard import Guarded
from rawaug.denoising.pictures import PictureDenoiser
from rawaug.evaluation.benchmark import (
    benchmark,
    benchmark_trials,
    choose_strengths,
    make_crops,
    noise_note,
    ranking,
)
from rawaug.evaluation.benchmark_page import all_tables, benchmark_notes, benchmark_page
from rawaug.evaluation.evaluate import named_denoiser
from rawaug.evaluation.figures import save_picture
from rawaug.evaluation.harm import measure_harm
from rawaug.evaluation.page import command_line
from rawaug.evaluation.picture_trials import picture_scores, print_pictures
from rawaug.evaluation.table_files import latex_benchmark
from rawaug.evaluation.tables import print_cells
from rawaug.evaluation.trials import measure_own_noise
from rawaug.files import require_output, write_json, write_text
from rawaug.registry import require_between

_ALWAYS = "NonLocalMeans"
"""The filter that is in every table, as are the shipped denoisers of mosaics."""

_COUNT, _CROP = 6, 384
"""Number of frames of RAW, and the side of their middles in pixels of the mosaic."""


def run(
    *denoisers: str,
    data: str = "real:test",
    bin: int = 1,
    count: int | None = None,
    crop: int | None = None,
    noise: Annotated[str | list[str] | tuple[float, float] | dict[str, Any] | None, YAML] = None,
    iso: list[float] | None = None,
    seed: int = 0,
    harm: bool = False,
    device: str = "cpu",
    json: str | None = None,
    report: str | None = None,
    table: str | None = None,
    figure: str | None = None,
    overwrite: bool = False,
) -> None:
    """Compare denoisers on the same frozen noise over clean references.

    The noisy input, NonLocalMeans and the shipped denoisers of mosaics are always in the table.

    Args:
        denoisers: names of shipped denoisers or filters, .safetensors files (also the published weights of PMRID,
            BF-DnCNN and PBRID), .onnx files, or package.module:function, called with noisy packed RAW and its variance.
        data: clean RAW frames: a folder, a file, or kind:path; of developed pictures cc15:DIR, polyu:DIR, sidd-srgb:DIR
            or pictures:DIR, for which the denoisers are rawaug-srgb, a .safetensors of pictures (FFDNet's weights too)
            or a filter, with @15 behind it if told a level of 15/255.
        bin: average this many sites of a colour in both directions, to reduce the frames' own noise.
        count: number of frames, 6 by default; of pictures, all.
        crop: side of the middle of each frame that is used, in pixels of the mosaic, 384 by default; of pictures, the
            whole.
        noise: noise in place of the four strengths: a preset, a measured camera, [shot_var, read_var], an ISP's file, a
            camera's .yaml sheet, or a law of your own as {name: MeasuredNoise, levels: ...}.
        iso: ISO values of that camera or law, one column for each.
        seed: seed of the noise.
        harm: also measure where denoisers harm: at the base ISO of a full-frame camera, at small lights, by width and
            place, and beside hot pixels.
        device: device for networks: cpu, cuda, ...
        json: write the result as JSON to this file.
        report: write an HTML page with tables and crops to this file.
        table: write the table of known levels for a paper to this file, as LaTeX with booktabs: means over frames with
            their standard errors, bold where paired differences leave no doubt.
        figure: draw crops of some frames at 100 % into this file, .pdf or .png.
        overwrite: replace these files if they exist.
    """
    inputs = [*denoisers, data]
    require_results(json, report, overwrite, inputs)
    for path, extensions in ((table, (".tex",)), (figure, (".pdf", ".png"))):
        if path is not None:
            require_output(path, overwrite, extensions, inputs)

    for option, value in (("count", count), ("crop", crop)):
        if value is not None:
            require_between(f"--{option}", value, 1, 2**20)

    if is_picture_pairs(data):
        for_raw: dict[str, Any] = {"bin": bin != 1, "noise": noise, "iso": iso, "seed": seed, "harm": harm}
        for_raw |= {"report": report, "table": table, "figure": figure}
        for key, value in for_raw.items():
            if value:
                raise ValueError(f"{data}: has developed pictures; --{key} is for RAW")
        compare_pictures(denoisers, data, count, crop, device, json)
        return

    count, crop = count or _COUNT, crop or _CROP
    strengths = choose_strengths(noise, iso)

    # The denoisers of the table; one whose name is taken goes by its spec.
    by_name: dict[str, RawDenoiser] = {}
    for spec in dict.fromkeys((_ALWAYS, *shipped_of_mosaics(), *denoisers)):
        denoiser = named_denoiser(spec, device).require_mosaic()
        if denoiser.name in by_name:
            denoiser = replace(denoiser, name=spec)
        by_name[denoiser.name] = denoiser
    compared = list(by_name.values())

    pairs = open_pairs(data, split="test")
    pairs = as_frames(pairs).some(range(len(pairs))[:count])
    frames = measure_own_noise(pairs, count).binned(bin)
    trials = benchmark_trials(frames, crop, seed, strengths)

    # Score them.
    weights = {}
    for denoiser in compared:
        if "denoiser_sha256" in denoiser.settings:
            weights[denoiser.name] = denoiser.settings["denoiser_sha256"]

    facts = {"data": data, "bin": bin, "crop": crop, "seed": seed, "command": command_line()}
    facts |= {"noise": noise_note(trials, strengths, seed), "weights_sha256": weights}
    result = {**facts, **benchmark(compared, trials)}
    if harm:
        guarded = [Guarded(denoiser) for denoiser in compared if denoiser.name in shipped_of_mosaics()]
        result["harm"] = measure_harm([*compared, *guarded], frames, crop, seed)

    # Say what came out.
    for title, head, cells in all_tables(result):
        print_cells(title, ["denoiser", *head], cells)
    print(*ranking(result), *benchmark_notes(result), result["noise"], sep="\n")

    if json:
        write_json(result, json)
    if table:
        write_text(latex_benchmark(result, command_line()), table)
        print(f"table: {table}")
    if figure:
        print(f"figure: {save_picture(list(make_crops(compared, trials)), Path(figure))}")
    if report:
        settings = {"denoisers": list(denoisers), "data": data, "bin": bin, "count": count, "crop": crop}
        settings |= {"noise": noise, "iso": iso, "seed": seed, "table": table, "figure": figure, "harm": harm}
        print(f"page: {benchmark_page(result, compared, trials).write(Path(report), settings)}")


def compare_pictures(
    denoisers: Sequence[str], data: str, count: int | None, crop: int | None, device: str, json: str | None
) -> None:
    """Compare denoisers on real pairs of pictures; print the table, and write it as JSON."""
    compared = [PictureDenoiser.of(spec, device) for spec in denoisers]
    pairs: Sequence[Any] = open_picture_pairs(data)
    facts: dict[str, Any] = {"data": data}
    if count is not None:
        pairs = as_frames(pairs).some(range(len(pairs))[:count])
    if crop is not None:
        pairs = as_frames(pairs).middles(crop)
        facts["crop"] = crop

    result = picture_scores(compared, pairs)
    print_pictures(data, result)
    if json:
        write_json({**facts, **result}, json)
