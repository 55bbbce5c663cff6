"""``rawaug benchmark``: denoisers on frozen noise over clean references; see :mod:`rawaug.evaluation.benchmark`."""

from __future__ import annotations

from typing import Annotated, Any

from rawaug.commands import YAML, require_results
from rawaug.data.picture_pairs import is_picture_pairs
from rawaug.evaluation.comparison import compare_pictures, compare_raw
from rawaug.files import require_output
from rawaug.registry import require_between


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

    if not is_picture_pairs(data):
        compare_raw(
            denoisers,
            data,
            bin=bin,
            count=count,
            crop=crop,
            noise=noise,
            iso=iso,
            seed=seed,
            device=device,
            json=json,
            report=report,
            table=table,
            figure=figure,
            harm=harm,
        )
        return

    for_raw: dict[str, Any] = {"bin": bin != 1, "noise": noise, "iso": iso, "seed": seed, "harm": harm}
    for_raw |= {"report": report, "table": table, "figure": figure}
    for key, value in for_raw.items():
        if value:
            raise ValueError(f"{data}: has developed pictures; --{key} is for RAW")
    compare_pictures(denoisers, data, count=count, crop=crop, device=device, json=json)
