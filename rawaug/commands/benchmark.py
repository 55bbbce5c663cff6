"""``rawaug benchmark``: denoisers on frozen noise over clean references; see :mod:`rawaug.evaluation.benchmark`."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated

from rawaug.commands import YAML
from rawaug.data import open_pairs
from rawaug.evaluation.benchmark import TOLD, benchmark, costs_of, crops, shown_of, strengths_of, tables
from rawaug.evaluation.contestants import Contestant, contestant, shipped_of_mosaics
from rawaug.evaluation.own_noise import own_noise_note
from rawaug.evaluation.page import Figure, Page, Part, draw_costs
from rawaug.evaluation.tables import print_rows
from rawaug.files import require_writable, write_json
from rawaug.kernels.runtime import find_device
from rawaug.noise import own_noise

ON_PAGE = 4


def run(
    *denoisers: str,
    data: str = "real:test",
    bin: int = 1,
    count: int = 6,
    crop: int = 384,
    noise: Annotated[str | list[str] | tuple[float, float] | None, YAML] = None,
    iso: list[float] | None = None,
    seed: int = 0,
    device: str = "cpu",
    json: str | None = None,
    report: str | None = None,
) -> None:
    """Compare denoisers on the same frozen noise over clean references.

    The noisy input, NonLocalMeans and the shipped denoisers of mosaics are always in the table.

    Args:
        denoisers: names of shipped denoisers or filters, .safetensors files (also the published weights of PMRID and
            BF-DnCNN), .onnx files, or package.module:function, called with noisy packed RAW and its variance.
        data: clean RAW frames: a folder, a file, or kind:path.
        bin: average this many sites of a colour in both directions, to leave less of the frames' own noise.
        count: number of frames.
        crop: side of the middle of each frame that is used, in pixels of the mosaic.
        noise: noise in place of the four strengths: a preset, a measured camera, or [shot_var, read_var].
        iso: ISO values of that camera, a column each.
        seed: seed of the noise.
        device: device for networks: cpu, cuda, ...
        json: write the result as JSON to this file.
        report: write an HTML page with tables and crops to this file.
    """
    for path in filter(None, (json, report)):
        require_writable(path)
    where, strengths = find_device(device), strengths_of(noise, iso)
    contestants: dict[str, Contestant] = {}
    for spec in dict.fromkeys(("NonLocalMeans", *shipped_of_mosaics(), *denoisers)):
        one = contestant(spec, where)
        name = one.name if one.name not in contestants else spec
        contestants[name] = one._replace(name=name)
    pairs = open_pairs(data, split="test", bin=bin)
    frames = [replace(pairs[k], own_noise=own_noise(pairs, k)) for k in range(min(count, len(pairs)))]
    everyone = list(contestants.values())
    result = {"data": data, "bin": bin, "crop": crop, **benchmark(everyone, frames, crop, seed, strengths)}
    for title, head, cells in tables(result):
        print_rows(title, ["denoiser", *head], [[name, *row] for name, row in cells.items()])
    told = {name: row["scores"][TOLD] for name, row in result["rows"].items()}
    shares = {f"{name} ({at})": scores[at] for name, scores in told.items() for at in scores if name != "noisy input"}
    notes = ["GMAC and s: a megapixel of the mosaic. sRGB: after one fixed development."]
    notes += filter(None, [own_noise_note(shares)])
    notes.append(f"noisy input: {result['hash']} (equal hashes, comparable figures)")
    print("\n".join(notes))
    if json:
        write_json(result, json)
    if report:
        page = Page(f"Denoisers on {data}", [Part(texts=notes)])
        page.parts += [Part(title, head=["", *head], rows=cells) for title, head, cells in tables(result)]
        chart = Figure(draw_costs(costs_of(result)), "PSNR over GMAC", "curve", f"{shown_of(strengths)}, levels told")
        page.parts.append(Part("Quality and cost", figures=[chart]))
        page.parts.append(Part("Pictures", texts=[f"Noise: {shown_of(strengths)}, levels told; PSNR of RAW."]))
        for row, cfa in crops(everyone, frames[:ON_PAGE], crop, seed, strengths):
            page.add_frame(row, cfa)
        settings = {"denoisers": denoisers, "data": data, "bin": bin, "count": count, "crop": crop, "seed": seed}
        settings |= {"noise": noise, "iso": iso}
        print(f"page: {page.write(Path(report), settings)}")
