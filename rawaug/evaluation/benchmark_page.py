"""What ``rawaug benchmark`` says of its result: tables, notes below them, and the page, with where denoisers harm."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from rawaug.denoising.denoiser import RawDenoiser
from rawaug.errors import count_of
from rawaug.evaluation.benchmark import TOLD, benchmark_tables, collect_costs, display_strength, make_crops
from rawaug.evaluation.figures import plot_costs
from rawaug.evaluation.harm import harm_tables
from rawaug.evaluation.page import Figure, Page
from rawaug.evaluation.trials import Trial, own_noise_note


def all_tables(result: Mapping[str, Any]) -> Iterator[tuple[str, list[str], dict[str, list[str]]]]:
    """Yield the tables of the strengths, and those of where denoisers harm if that was measured."""
    yield from benchmark_tables(result)
    if "harm" in result:
        yield from harm_tables(result["harm"])


def benchmark_notes(result: Mapping[str, Any]) -> list[str]:
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


def benchmark_page(result: Mapping[str, Any], denoisers: Sequence[RawDenoiser], trials: Sequence[Trial]) -> Page:
    """Make the page: tables, quality over cost, and crops of some frames by every denoiser."""
    page = Page(f"Denoisers on {result['data']}", result["noise"])
    page.add(texts=benchmark_notes(result))
    for title, head, cells in all_tables(result):
        page.add(title, head=["", *head], rows=cells)

    strength = display_strength(result["rows"]["noisy input"]["scores"][TOLD])
    chart = Figure(plot_costs(collect_costs(result)), "PSNR over GMAC", "curve", f"{strength}, levels told")
    page.add("Quality and cost", figures=[chart])

    page.add("Pictures", texts=[f"Noise: {strength}, levels told; PSNR of RAW."])
    for panels in make_crops(denoisers, trials):
        page.add_frame(panels, result["crop"])

    return page
