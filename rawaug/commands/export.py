"""``rawaug export``: a denoiser as an ONNX file, for programs that have no PyTorch; an ISP by :mod:`.export_isp`.

Inputs ``noisy`` and, where the network reads it, ``variance``; output ``denoised``: float32 packed RAW (R, Gr, Gb, B)
``(1, 4, h, w)`` of any h, w >= 2, that is any even mosaic. Variance is ``shot_var max(noisy, 0) + read_var``, of each
value. The file is run by ONNX Runtime on a frame with noise and compared with PyTorch before it is left there.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

import denoisers
from denoisers.pretrained import FOLDER, find
from rawaug import bayer
from rawaug.bayer import CFA
from rawaug.commands.export_isp import export_isp
from rawaug.commands.onnx_files import feeds, require_equal, require_onnx, session_of, to_onnx
from rawaug.data import demo_pairs
from rawaug.evaluation.scores import frozen_sample
from rawaug.files import find_weights, read_header, replacing
from rawaug.io import read_raw
from rawaug.isp.model import DictionaryISP
from rawaug.noise import noise_model
from rawaug.registry import COMMANDS

SIDE = 512
"""Mosaic pixels on the longer side of what both are run on and timed on."""


class Exported(NamedTuple):
    """What was written.

    Args:
        out: the file.
        difference: largest between ONNX Runtime and PyTorch on the frame, white at 1.
        seconds_onnx, seconds_torch: a mosaic megapixel, on as many threads as PyTorch has.
    """

    out: Path
    difference: float
    seconds_onnx: float
    seconds_torch: float


@COMMANDS.register("export")
def run(
    weights: str, out: str, *, frame: str | None = None, white_balance: tuple[float, float, float] | None = None
) -> None:
    """Write a denoiser as ONNX, or an ISP as JSON, .cube and ONNX; ONNX is compared with PyTorch.

    Args:
        weights: a .safetensors file written by rawaug run or rawaug fit, or the name of a shipped denoiser or ISP.
        out: the .onnx file of a denoiser; of an ISP .json, .cube, .onnx, or a folder for all three.
        frame: RAW file whose middle is used to compare a denoiser with its ONNX; by default a generated frame.
        white_balance: as-shot multipliers R, G, B for which an ISP is exported; by default those typical of the fit.

    Raises:
        ValueError: if an option is given that is of the other kind.
    """
    if read_header(find_weights(weights, FOLDER))["kind"] == "isp":
        if frame is not None:
            raise ValueError(f"--frame: is for denoisers, and {weights} is an ISP")
        for path in export_isp(DictionaryISP.from_pretrained(weights), out, white_balance):
            print(f"{path}: {path.stat().st_size / 1e6:.1f} MB")
        return
    if white_balance is not None:
        raise ValueError(f"--white-balance: is for ISPs, and {weights} is a denoiser")
    done = export(weights, out, frame)
    print(f"{done.out}: {done.out.stat().st_size / 1e6:.1f} MB, largest difference from PyTorch {done.difference:.1e}")
    seconds = f"ONNX Runtime {done.seconds_onnx:.2f} s a megapixel, PyTorch {done.seconds_torch:.2f} s"
    print(f"{seconds} ({torch.get_num_threads()} threads)")


def export(denoiser: str | Path, out: str | Path, frame: str | Path | None = None) -> Exported:
    """Write ``denoiser`` to the ONNX file ``out``, whole or not at all.

    Raises:
        FileNotFoundError, ValueError: if the denoiser or the frame cannot be read, a package is missing, ``out`` is not
            named .onnx, or ONNX Runtime and PyTorch differ by more than :data:`rawaug.commands.onnx_files.TOLERANCE`.
    """
    out = Path(out)
    if out.suffix != ".onnx":
        raise ValueError(f"{out}: give a name that ends in .onnx")
    require_onnx()
    model, _ = denoisers.load(find(denoiser))
    names = ["noisy", "variance"][: 1 + model.reads_variance]
    images = comparison_frame(frame)[: len(names)]
    example = torch.rand(1, model.channels, 70, 90)
    examples = dict(zip(names, (example, 1e-3 * example + 1e-5), strict=False))
    with replacing(out) as partial:
        to_onnx(model, examples, "denoised", partial)
        session, values = session_of(partial), feeds(names, images)
        with torch.inference_mode():
            expected = model(*images)
            seconds_torch = _fastest(lambda: model(*images))
        (result,) = session.run(None, values)
        difference = require_equal(result, expected, out)
        seconds_onnx = _fastest(lambda: session.run(None, values))
    megapixels = images[0].numel() / 1e6
    return Exported(out, difference, seconds_onnx / megapixels, seconds_torch / megapixels)


def comparison_frame(frame: str | Path | None) -> tuple[Tensor, Tensor]:
    """Noisy packed RAW ``(1, 4, h, w)`` and its variance: of the middle of a RAW file, or of a generated one."""
    if frame is None:
        pair = demo_pairs("test", count=1)[0]
        sample = frozen_sample(pair, noise_model("cycleisp_sidd"), CFA(pair.cfa), seed=0)
        return sample.noisy, sample.variance
    raw = read_raw(frame)
    height, width = raw.mosaic.shape[-2:]
    top, left = (max(0, side - SIDE) // 4 * 2 for side in (height, width))
    packed = bayer.pack(raw.mosaic[None, :, top : top + SIDE, left : left + SIDE], raw.cfa).contiguous()
    shot_var, read_var = raw.noise_profile or (1e-3, 1e-5)
    return packed, shot_var * packed.clamp_min(0.0) + read_var


def _fastest(call: Callable[[], Any], repeats: int = 3) -> float:
    seconds = []
    for _ in range(repeats):
        start = time.perf_counter()
        call()
        seconds.append(time.perf_counter() - start)
    return min(seconds)
