"""``rawaug benchmark``: denoisers on frozen noise over clean references; see :mod:`rawaug.evaluation.benchmark`."""

from __future__ import annotations

import sys
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import Annotated

from rawaug.commands import YAML
from rawaug.data import open_pairs
from rawaug.data.pairs import Binned, SomePairs
from rawaug.data.picture_pairs import is_picture_pairs, open_picture_pairs
from rawaug.denoising.denoiser import RawDenoiser, shipped_of_mosaics
from rawaug.denoising.pictures import PictureDenoiser
from rawaug.evaluation.benchmark import (
    TOLD,
    benchmark,
    costs_of,
    crops,
    display_strength,
    noise_note,
    strengths_of,
    tables,
    trials,
)
from rawaug.evaluation.figures import plot_costs
from rawaug.evaluation.page import Figure, Page
from rawaug.evaluation.picture_trials import picture_scores, print_pictures
from rawaug.evaluation.tables import print_rows
from rawaug.evaluation.trials import Measured, own_noise_note
from rawaug.files import require_writable, write_json

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
        denoisers: names of shipped denoisers or filters, .safetensors files (also the published weights of PMRID,
            BF-DnCNN and PBRID), .onnx files, or package.module:function, called with noisy packed RAW and its variance.
        data: clean RAW frames: a folder, a file, or kind:path; of developed pictures cc15:DIR, polyu:DIR, sidd-srgb:DIR
            or pictures:DIR, for which the denoisers are rawaug-srgb, a .safetensors of pictures (FFDNet's weights too)
            or a filter, with @15 behind it if told a level of 15/255.
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
    for option, path in (("json", json), ("report", report)):
        if path is not None:
            require_writable(path, option)
    if is_picture_pairs(data):
        found_on = picture_scores([PictureDenoiser.of(spec, device) for spec in denoisers], open_picture_pairs(data))
        print_pictures(data, found_on)
        if json:
            write_json({"data": data, **found_on}, json)
        return
    strengths = strengths_of(noise, iso)
    known: dict[str, RawDenoiser] = {}
    for spec in dict.fromkeys(("NonLocalMeans", *shipped_of_mosaics(), *denoisers)):
        one = named(spec, device).require_mosaic()
        name = one.name if one.name not in known else spec
        known[name] = replace(one, name=name)
    pairs = open_pairs(data, split="test")
    frames = Binned(Measured(SomePairs(pairs, range(len(pairs))[:count]), count), bin)
    everyone, found = list(known.values()), trials(frames, crop, seed, strengths)
    noise_said = noise_note(found, strengths, seed)
    result = {"data": data, "bin": bin, "crop": crop, "seed": seed, "noise": noise_said, **benchmark(everyone, found)}
    for title, head, cells in tables(result):
        print_rows(title, ["denoiser", *head], [[name, *row] for name, row in cells.items()])
    told = {name: row["scores"][TOLD] for name, row in result["rows"].items()}
    shares = {f"{name} ({at})": scores[at] for name, scores in told.items() for at in scores if name != "noisy input"}
    notes = ["GMAC and s: a megapixel of the mosaic. sRGB: after one fixed development."]
    notes += filter(None, [own_noise_note(shares)])
    notes.append(f"noisy input: {result['hash']} (equal hashes, comparable figures)")
    print("\n".join([*notes, noise_said]))
    if json:
        write_json(result, json)
    if report:
        page = Page(f"Denoisers on {data}")
        page.lead = noise_said
        page.add(texts=notes)
        for title, head, cells in tables(result):
            page.add(title, head=["", *head], rows=cells)
        chart = Figure(
            plot_costs(costs_of(result)), "PSNR over GMAC", "curve", f"{display_strength(strengths)}, levels told"
        )
        page.add("Quality and cost", figures=[chart])
        page.add("Pictures", texts=[f"Noise: {display_strength(strengths)}, levels told; PSNR of RAW."])
        for panels in crops(everyone, found, ON_PAGE):
            page.add_frame(panels, crop)
        settings = {"denoisers": denoisers, "data": data, "bin": bin, "count": count, "crop": crop, "seed": seed}
        settings |= {"noise": noise, "iso": iso}
        print(f"page: {page.write(Path(report), settings)}")


def named(spec: str, device: str = "cpu") -> RawDenoiser:
    """What a word of this command line names, the only place from which ``package.module:function`` is imported."""
    module, colon, function = spec.partition(":")
    if not colon or Path(spec).suffix in (".onnx", ".safetensors"):
        return RawDenoiser.of(spec, device)
    sys.path.insert(0, str(Path.cwd()))  # as python -m does
    try:
        found = getattr(import_module(module), function)
    except (ImportError, AttributeError, ValueError) as error:
        raise ValueError(f"{spec}: cannot be imported: {error}") from None
    finally:
        sys.path.pop(0)
    return RawDenoiser.of(found, device, name=spec)
