"""``rawaug submit``: the noisy blocks of SIDD's benchmark, denoised and written as its server takes them.

Noise levels are those that the dataset publishes for a frame, else estimated from all of its noisy blocks together.
Results are cut to [0, 1].
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated

import torch
from torch import Tensor

from denoisers.files import DEFAULT
from rawaug.commands import YAML
from rawaug.commands.denoise import choose_denoiser
from rawaug.data.sidd import BLOCKS, SiddBenchmark, write_submission
from rawaug.denoising.denoiser import RawDenoiser
from rawaug.files import require_writable
from rawaug.io import RawFrame
from rawaug.noise import estimate_noise
from rawaug.progress import progress
from rawaug.registry import Spec

_UNUSED = (0.0, 0.0)
"""The levels for a denoiser that reads none."""


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
    """Denoise the noisy blocks of SIDD's benchmark, in the form that its server takes.

    Args:
        benchmark: sidd:PATH with BenchmarkNoisyBlocksRaw.mat.
        out: the file to submit, SubmitRaw.csv.
        denoiser: .safetensors file written by rawaug run, or the name of a shipped denoiser; by default rawaug-small.
        classical: a filter in place of a network: NonLocalMeans, Wavelet, TotalVariation, BM3D, WNNM, KSVD, GLIDE,
            or {name, settings}.
        self_ensemble: average eight views of a network, at eight times the cost.
        device: where a network runs: auto, cpu, cuda, cuda:1, mps.
    """
    kind, _, path = benchmark.partition(":")
    if kind != "sidd" or not path:
        raise ValueError(f"{benchmark}: not a benchmark; use sidd:PATH")
    require_writable(out)

    spec = DEFAULT if denoiser is None and classical is None else denoiser
    model = choose_denoiser(spec, classical, self_ensemble, device)
    assert model is not None
    submit(path, out, model.require_mosaic())
    print(f"The submission is in {out}.")


def submit(path: str, out: str, denoiser: RawDenoiser) -> None:
    """Denoise the blocks below the folder ``path``, and write the submission ``out``."""
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
