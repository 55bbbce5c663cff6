"""``rawaug judge``: the PSNR of denoisers on RAW files that have no clean version; in Python :func:`rawaug.judge`."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

from rawaug.commands import YAML, require_results
from rawaug.evaluation.judge import judge, plot_judgement, print_judgement
from rawaug.files import require_output, write_json


def run(
    files: list[str],
    /,
    *,
    denoisers: Annotated[list[str] | None, YAML] = None,
    noise: Annotated[tuple[float, float] | str, YAML] = "auto",
    crop: int | None = None,
    probes: int = 1,
    seed: int = 0,
    device: str = "auto",
    picture: str | None = None,
    json: str | None = None,
    overwrite: bool = False,
) -> None:
    """Estimate the PSNR of denoisers on your own RAW files, without clean ones.

    Args:
        files: RAW files of Bayer sensors, as shot.
        denoisers: names, .safetensors or .onnx files as a list, [rawaug-small, NonLocalMeans]; by default NonLocalMeans
            and the shipped networks.
        noise: where the levels of the noise come from, as for rawaug denoise: auto, profile, estimate, a camera, or
            [shot_var, read_var].
        crop: judge only the middle of this side in pixels, which is faster; by default the whole frame.
        probes: how many small changes each denoiser is run with once more; several take longer and scatter less.
        seed: seed of the small changes, and of the noise that is drawn on the best result.
        device: where networks run: auto, cpu, cuda, cuda:1, mps.
        picture: write where each denoiser gains and where it harms to this .png; for a single file.
        json: write the figures to this file.
        overwrite: replace existing files of --picture and --json.
    """
    require_results(json, None, overwrite, files)
    if picture is not None:
        require_output(picture, overwrite, (".png",), files)
    if picture and len(files) > 1:
        raise ValueError(f"--picture {picture}: shows one file, but {len(files)} are given")

    judgements = []
    for file in files:
        judgement = judge(file, denoisers, noise, crop=crop, probes=probes, seed=seed, device=device)
        print_judgement(judgement)
        judgements.append(judgement)

    if json:
        content = [asdict(judgement) for judgement in judgements]
        for result in content:
            for scores in result["denoisers"].values():
                del scores["gain"]  # a map of blocks
        write_json({"files": content}, json)
    if picture and judgements[0].denoisers:
        plot_judgement(judgements[0], Path(picture))
        print(f"picture: {picture}")
    refused = [judgement.name for judgement in judgements if judgement.refusals]
    if refused:
        raise ValueError(f"{', '.join(refused)}: not judged, for the reasons above")
