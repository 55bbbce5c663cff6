"""``rawaug submit``: the noisy blocks of a benchmark whose clean ones are kept, denoised and written as it takes them.

Noise levels are those that the dataset publishes for a frame; otherwise they are estimated from all of its noisy blocks
together. Results are cut to [0, 1].
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

import torch
from torch import Tensor

from rawaug.commands import YAML, network_or_filter
from rawaug.data.dnd import Dnd, write_dnd_submission
from rawaug.data.sidd_benchmark import SiddBenchmark, write_submission
from rawaug.data.sidd_blocks import BLOCKS
from rawaug.denoising.denoiser import RawDenoiser
from rawaug.files import require_output
from rawaug.io import RawFrame
from rawaug.noise import estimate_noise
from rawaug.progress import progress
from rawaug.registry import Spec

_UNUSED = (0.0, 0.0)
"""The levels of a denoiser that reads none."""


def run(
    benchmark: str,
    out: str,
    /,
    *,
    denoiser: str | None = None,
    classical: Annotated[Spec | None, YAML] = None,
    self_ensemble: bool = False,
    device: str = "auto",
    overwrite: bool = False,
) -> None:
    """Denoise the noisy blocks of a benchmark, in the form that its server takes.

    Args:
        benchmark: sidd:PATH with BenchmarkNoisyBlocksRaw.mat, or dnd:PATH with info.mat.
        out: what to submit: SubmitRaw.csv for SIDD, a folder for DND.
        denoiser: .safetensors file written by rawaug run, or the name of a shipped denoiser; by default rawaug-small.
        classical: a filter in place of a network: NonLocalMeans, Wavelet, TotalVariation, BM3D, WNNM, KSVD, GLIDE,
            or {name, settings}.
        self_ensemble: average eight views of a network, at eight times the cost.
        device: where a network runs: auto, cpu, cuda, cuda:1, mps.
        overwrite: replace an existing submission.
    """
    kind, _, path = benchmark.partition(":")
    if kind not in ("sidd", "dnd") or not path:
        raise ValueError(f"{benchmark}: not a benchmark; use sidd:PATH or dnd:PATH")
    if kind == "dnd":
        require_output(Path(out) / "0001.mat", overwrite)
    else:
        require_output(out, overwrite, (".csv",))

    spec = network_or_filter(denoiser, classical, self_ensemble) or RawDenoiser.default
    views = 8 if self_ensemble else 1
    method = RawDenoiser.of(spec, device, "auto", views=views).require_mosaic()
    if kind == "dnd":
        submit_dnd(path, out, method)
    else:
        submit(path, out, method)
    print(f"The submission is in {out}.")


def submit(path: str, out: str, denoiser: RawDenoiser) -> None:
    """Denoise SIDD's blocks below the folder ``path``, and write the submission ``out``."""
    blocks = SiddBenchmark(path)
    write_submission(out, _denoise(blocks, denoiser), blocks[0].mosaic.shape[-1])


def _denoise(benchmark: SiddBenchmark, denoiser: RawDenoiser) -> Iterator[Tensor]:
    for first in progress(range(0, len(benchmark), BLOCKS), label="benchmark", unit="frame"):
        blocks = benchmark[first : first + BLOCKS]
        levels = blocks[0].noise_profile or _UNUSED
        if levels is _UNUSED and denoiser.reads_levels:
            levels = _estimate_levels(blocks)
        for block in blocks:
            yield denoiser.frame(block, levels).clamp(0.0, 1.0)


def _estimate_levels(blocks: list[RawFrame]) -> tuple[float, float]:
    mosaics = torch.cat([block.mosaic for block in blocks], dim=-1)
    try:
        estimate = estimate_noise(mosaics, blocks[0].cfa)
    except ValueError as error:
        scene = blocks[0].name.rpartition("_")[0]
        raise ValueError(
            f"{scene}: its noise cannot be estimated ({error}); put noise_level_functions.csv beside the blocks"
        ) from error
    return estimate.shot_var, estimate.read_var


def submit_dnd(path: str, out: str, denoiser: RawDenoiser) -> None:
    """Denoise DND's boxes below the folder ``path``, and write the 50 files of the submission into ``out``."""
    boxes = progress(Dnd(path), label="benchmark", unit="box")
    write_dnd_submission(out, (denoiser.frame(box, box.noise_profile or _UNUSED).clamp(0.0, 1.0) for box in boxes))
