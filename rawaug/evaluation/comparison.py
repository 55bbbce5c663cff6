"""``rawaug benchmark`` from start to end: denoisers by name, tables, JSON and, for RAW, the page."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from rawaug.data import open_pairs
from rawaug.data.frames import as_frames
from rawaug.data.picture_pairs import open_picture_pairs
from rawaug.denoising.denoiser import RawDenoiser, shipped_of_mosaics
from rawaug.denoising.guard import Guarded
from rawaug.denoising.pictures import PictureDenoiser
from rawaug.errors import count_of
from rawaug.evaluation.benchmark import (
    TOLD,
    benchmark,
    choose_strengths,
    collect_costs,
    crops,
    display_strength,
    noise_note,
    ranking,
    tables,
    trials,
)
from rawaug.evaluation.evaluate import named_denoiser
from rawaug.evaluation.figures import plot_costs, save_picture
from rawaug.evaluation.harm import harm_tables, measure_harm
from rawaug.evaluation.page import Figure, Page, command_line
from rawaug.evaluation.picture_trials import picture_scores, print_pictures
from rawaug.evaluation.table_files import benchmark_table
from rawaug.evaluation.tables import print_cells
from rawaug.evaluation.trials import Trial, measure_own_noise, own_noise_note
from rawaug.files import write_json, write_text

_ALWAYS = "NonLocalMeans"
"""The filter that is in every table, as are the shipped denoisers of mosaics."""

_FRAMES, _CROP = 6, 384
"""Of RAW this many frames are used, and middles of this side in pixels of the mosaic."""

_ON_PAGE = 4
"""Largest number of frames on the page."""


def compare_raw(
    denoisers: Sequence[str],
    data: str,
    *,
    bin: int = 1,
    count: int | None = None,
    crop: int | None = None,
    noise: Any = None,
    iso: list[float] | None = None,
    seed: int = 0,
    device: str = "cpu",
    json: str | None = None,
    report: str | None = None,
    table: str | None = None,
    figure: str | None = None,
    harm: bool = False,
) -> None:
    """Compare denoisers of RAW on the same frozen noise; print the tables, and write them as JSON and as a page.

    Args:
        denoisers: names or files.
        data: clean frames, by a path or ``kind:path``.
        bin: the factor by which the frames are binned.
        count: number of frames; None for 6.
        crop: side of the middles that are used, in pixels; None for 384.
        noise: noise instead of the four strengths; None for these.
        iso: ISO values of the camera that ``noise`` names.
        seed: seed of the noise.
        device: device on which networks run.
        json: file to write the result to; None for none.
        report: page to write tables and crops to; None for none.
        table: LaTeX file to write the table of known levels to; None for none.
        figure: file to draw crops of some frames into, .pdf or .png; None for none.
        harm: whether the conditions of :mod:`rawaug.evaluation.harm` are measured, too.
    """
    count, crop = count or _FRAMES, crop or _CROP
    settings = {"denoisers": list(denoisers), "data": data, "bin": bin, "count": count, "crop": crop, "noise": noise}
    settings |= {"iso": iso, "seed": seed, "table": table, "figure": figure, "harm": harm}
    strengths = choose_strengths(noise, iso)

    # The denoisers of the table; one whose name is taken goes by its spec.
    by_name: dict[str, RawDenoiser] = {}
    for spec in dict.fromkeys((_ALWAYS, *shipped_of_mosaics(), *denoisers)):
        denoiser = named_denoiser(spec, device).require_mosaic()
        if denoiser.name in by_name:
            denoiser = replace(denoiser, name=spec)
        by_name[denoiser.name] = denoiser
    opened = list(by_name.values())

    pairs = open_pairs(data, split="test")
    pairs = as_frames(pairs).some(range(len(pairs))[:count])
    frames = measure_own_noise(pairs, count).binned(bin)
    cases = trials(frames, crop, seed, strengths)

    note = noise_note(cases, strengths, seed)
    facts = {
        "data": data,
        "bin": bin,
        "crop": crop,
        "seed": seed,
        "noise": note,
        "command": command_line(),
        "weights_sha256": _hash_weights(opened),
    }
    result = {**facts, **benchmark(opened, cases)}
    if harm:
        guarded = [Guarded(denoiser) for denoiser in opened if denoiser.name in shipped_of_mosaics()]
        result["harm"] = measure_harm([*opened, *guarded], frames, crop, seed)

    for title, head, cells in _all_tables(result):
        print_cells(title, ["denoiser", *head], cells)

    for line in ranking(result):
        print(line)
    notes = _make_notes(result)
    print("\n".join([*notes, note]))

    if json:
        write_json(result, json)
    if table:
        write_text(benchmark_table(result, command_line()), table)
        print(f"table: {table}")
    if figure:
        print(f"figure: {save_picture(list(crops(opened, cases, _ON_PAGE)), Path(figure))}")
    if report:
        page = _make_page(data, crop, display_strength(strengths), result, opened, cases, notes)
        print(f"page: {page.write(Path(report), settings)}")


def compare_pictures(
    denoisers: Sequence[str],
    data: str,
    *,
    count: int | None = None,
    crop: int | None = None,
    device: str = "cpu",
    json: str | None = None,
) -> None:
    """Compare denoisers of pictures; print the table, and write it as JSON.

    Args:
        denoisers: names or files.
        data: real pairs of pictures, by a path or ``kind:path``.
        count: number of pairs; None for all.
        crop: side of the middles that are used, in pixels; None for the whole.
        device: device on which networks run.
        json: file to write the result to; None for none.
    """
    opened = [PictureDenoiser.of(spec, device) for spec in denoisers]
    pairs: Sequence[Any] = open_picture_pairs(data)
    facts: dict[str, Any] = {"data": data}
    if count is not None:
        pairs = as_frames(pairs).some(range(len(pairs))[:count])
    if crop is not None:
        pairs = as_frames(pairs).middles(crop)
        facts["crop"] = crop

    result = picture_scores(opened, pairs)
    print_pictures(data, result)
    if json:
        write_json({**facts, **result}, json)


def _hash_weights(denoisers: Sequence[RawDenoiser]) -> dict[str, str]:
    """Get the SHA-256 of the file of each network."""
    hashes = {}
    for denoiser in denoisers:
        if "denoiser_sha256" in denoiser.settings:
            hashes[denoiser.name] = denoiser.settings["denoiser_sha256"]
    return hashes


def _all_tables(result: dict[str, Any]) -> Iterator[tuple[str, list[str], dict[str, list[str]]]]:
    """Yield the tables of the strengths, and those of where denoisers harm if that was measured."""
    yield from tables(result)
    if "harm" in result:
        yield from harm_tables(result["harm"])


def _make_notes(result: dict[str, Any]) -> list[str]:
    """Make the lines below the tables."""
    summaries = {}
    for name, row in result["rows"].items():
        if name == "noisy input":
            continue
        for strength, scores in row["scores"][TOLD].items():
            summaries[f"{name} ({strength})"] = scores

    for name, row in result.get("harm", {}).items():
        if name != "noisy input":
            for column, scores in row["frames"].items():
                summaries[f"{name} ({column})"] = scores

    frames = count_of(len(result["frames"]), "frame")
    notes = [f"{frames}; GMAC and seconds are per megapixel of the mosaic; sRGB scores follow one fixed development."]
    note = own_noise_note(summaries)
    if note:
        notes.append(note)
    notes.append(f"Hash of the noisy input: {result['hash']}. Figures with equal hashes can be compared.")
    return notes


def _make_page(
    data: str,
    crop: int,
    strength: str,
    result: dict[str, Any],
    denoisers: Sequence[RawDenoiser],
    cases: Sequence[Trial],
    notes: Sequence[str],
) -> Page:
    """Make the page: tables, quality over cost, and crops of some frames by every denoiser."""
    page = Page(f"Denoisers on {data}", result["noise"])
    page.add(texts=notes)
    for title, head, cells in _all_tables(result):
        page.add(title, head=["", *head], rows=cells)

    costs = plot_costs(collect_costs(result))
    chart = Figure(costs, "PSNR over GMAC", "curve", f"{strength}, levels told")
    page.add("Quality and cost", figures=[chart])

    page.add("Pictures", texts=[f"Noise: {strength}, levels told; PSNR of RAW."])
    for panels in crops(denoisers, cases, _ON_PAGE):
        page.add_frame(panels, crop)

    return page
