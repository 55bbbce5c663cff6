"""``rawaug submit``: the noisy blocks of a benchmark whose clean ones are kept, denoised and written as it takes them.

Noise levels are those that the dataset publishes for a frame, else estimated from all of its noisy blocks together.
Results are cut to [0, 1], and the written file is read back and checked.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Annotated

import torch
from torch import Tensor

from rawaug.commands import YAML
from rawaug.commands.denoise import chosen
from rawaug.data import submissions
from rawaug.data.sidd import BLOCKS
from rawaug.denoise.denoiser import RawDenoiser
from rawaug.files import require_writable
from rawaug.io import RawFrame
from rawaug.noise import estimate_noise
from rawaug.progress import progress
from rawaug.registry import Spec

_UNUSED = (0.0, 0.0)


def run(
    benchmark: str,
    out: str,
    /,
    *,
    denoiser: str | None = None,
    classical: Annotated[Spec | None, YAML] = None,
    self_ensemble: bool = False,
    device: str = "auto",
) -> None:
    """Denoise the noisy blocks of a benchmark, in the form that its server takes.

    Args:
        benchmark: sidd:PATH with BenchmarkNoisyBlocksRaw.mat, or dnd:PATH with info.mat.
        out: SubmitRaw.csv for SIDD, a folder for DND.
        denoiser: .safetensors file written by rawaug run, or the name of a shipped denoiser; by default rawaug-small.
        classical: a filter in place of a network: NonLocalMeans, Wavelet, TotalVariation, BM3D, or {name, settings}.
        self_ensemble: average eight views of a network, at eight times the cost.
        device: where a network runs: auto, cpu, cuda, cuda:1, mps.
    """
    kind, _, path = benchmark.partition(":")
    if kind not in SUBMISSIONS or not path:
        raise ValueError(f"{benchmark}: no benchmark; use sidd:PATH or dnd:PATH")
    require_writable(Path(out), folder=kind == "dnd")
    count = SUBMISSIONS[kind](path, out, chosen(denoiser, classical, self_ensemble, device).require_mosaic())
    print(f"{count} blocks, checked: {out}")


def submit_sidd(path: str, out: str, denoiser: RawDenoiser) -> int:
    """Write and check SIDD's submission; the number of blocks."""
    blocks = submissions.SiddBenchmark(path)
    side = blocks[0].mosaic.shape[-1]
    submissions.write_submission(out, _sidd_denoised(blocks, denoiser), side)
    return len(submissions.check_submission(out, side))


def _sidd_denoised(benchmark: submissions.SiddBenchmark, denoiser: RawDenoiser) -> Iterator[Tensor]:
    for first in progress(range(0, len(benchmark), BLOCKS), label="benchmark", unit="frame"):
        blocks = benchmark[first : first + BLOCKS]
        levels = blocks[0].noise_profile or (_estimated(blocks) if denoiser.reads_levels else _UNUSED)
        for block in blocks:
            yield denoiser.frame(block, levels).clamp(0.0, 1.0)


def _estimated(blocks: list[RawFrame]) -> tuple[float, float]:
    try:
        estimate = estimate_noise(torch.cat([block.mosaic for block in blocks], dim=-1), blocks[0].cfa)
    except ValueError as error:
        scene = blocks[0].name.rpartition("_")[0]
        raise ValueError(
            f"{scene}: its noise cannot be estimated ({error}); put noise_level_functions.csv beside the blocks"
        ) from error
    return estimate.shot_var, estimate.read_var


def submit_dnd(path: str, out: str, denoiser: RawDenoiser) -> int:
    """Write and check DND's submission; the number of boxes."""
    boxes = submissions.Dnd(path)
    denoised = (
        denoiser.frame(box, box.noise_profile or _UNUSED).clamp(0.0, 1.0)
        for box in progress(boxes, label="benchmark", unit="box")
    )
    submissions.write_dnd_submission(out, denoised)
    submissions.check_dnd_submission(out, boxes)
    return len(boxes)


SUBMISSIONS: dict[str, Callable[[str, str, RawDenoiser], int]] = {"sidd": submit_sidd, "dnd": submit_dnd}
