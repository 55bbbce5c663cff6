"""``rawaug export``: a denoiser as an ONNX file, for programs that have no PyTorch.

Inputs ``noisy`` and, where the network reads it, ``variance``; output ``denoised``: float32 packed RAW (R, Gr, Gb, B)
``(1, 4, h, w)`` of any h, w >= 2, that is any even mosaic. Variance is ``shot_var max(noisy, 0) + read_var``, of each
value. The file is run by ONNX Runtime on a frame with noise and compared with PyTorch before it is left there.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

import denoisers
from denoisers.network import Denoiser
from denoisers.pretrained import find
from rawaug import bayer
from rawaug.bayer import CFA
from rawaug.data import demo_pairs
from rawaug.evaluation.scores import frozen_sample
from rawaug.files import replacing
from rawaug.io import read_raw
from rawaug.noise import noise_model
from rawaug.registry import COMMANDS

TOLERANCE = 1e-4
"""Largest difference between ONNX Runtime and PyTorch, white at 1."""

NEEDED = ("onnx", "onnxscript", "onnxruntime")
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
def run(denoiser: str, out: str, *, frame: str | None = None) -> None:
    """Write a denoiser as an ONNX file, compared with PyTorch.

    Args:
        denoiser: a .safetensors file written by rawaug run, or the name of a shipped denoiser.
        out: the .onnx file to write.
        frame: RAW file on whose middle both are compared; by default a generated frame.
    """
    done = export(denoiser, out, frame)
    print(f"{done.out}: {done.out.stat().st_size / 1e6:.1f} MB, largest difference from PyTorch {done.difference:.1e}")
    seconds = f"ONNX Runtime {done.seconds_onnx:.2f} s a megapixel, PyTorch {done.seconds_torch:.2f} s"
    print(f"{seconds} ({torch.get_num_threads()} threads)")


def export(denoiser: str | Path, out: str | Path, frame: str | Path | None = None) -> Exported:
    """Write ``denoiser`` to the ONNX file ``out``, whole or not at all.

    Raises:
        FileNotFoundError, ValueError: if the denoiser or the frame cannot be read, a package is missing, ``out`` is not
            named .onnx, or ONNX Runtime and PyTorch differ by more than :data:`TOLERANCE`.
    """
    missing = [name for name in NEEDED if find_spec(name) is None]
    if missing:
        raise ValueError(f"export needs {', '.join(missing)}: pip install 'rawaug[export]'")
    out = Path(out)
    if out.suffix != ".onnx":
        raise ValueError(f"{out}: give a name that ends in .onnx")
    model, _ = denoisers.load(find(denoiser))
    images = comparison_frame(frame)[: 1 + model.reads_variance]
    with replacing(out) as partial:
        to_onnx(model, partial)
        session = session_of(partial)
        feeds = dict(zip(("noisy", "variance"), (image.numpy() for image in images), strict=False))
        with torch.inference_mode():
            expected = model(*images)
            seconds_torch = _fastest(lambda: model(*images))
        (result,) = session.run(None, feeds)
        difference = (torch.from_numpy(result) - expected).abs().max().item()
        if not difference <= TOLERANCE:
            raise ValueError(f"{out}: ONNX Runtime differs from PyTorch by {difference:.1e}, more than {TOLERANCE}")
        seconds_onnx = _fastest(lambda: session.run(None, feeds))
    megapixels = images[0].numel() / 1e6
    return Exported(out, difference, seconds_onnx / megapixels, seconds_torch / megapixels)


def to_onnx(model: Denoiser, path: Path) -> None:
    """One ONNX file, whose height and width are free."""
    example = torch.rand(1, model.channels, 70, 90)
    inputs = (example, 1e-3 * example + 1e-5)[: 1 + model.reads_variance]
    names = ["noisy", "variance"][: len(inputs)]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the exporter's own
        program = torch.export.export(
            model,
            inputs,
            dynamic_shapes=tuple({2: torch.export.Dim.DYNAMIC, 3: torch.export.Dim.DYNAMIC} for _ in inputs),
        )
        onnx = torch.onnx.export(program, input_names=names, output_names=["denoised"], dynamo=True, verbose=False)
        assert onnx is not None
        onnx.save(str(path), external_data=False)


def session_of(path: Path) -> Any:
    """ONNX Runtime on the CPU, on as many threads as PyTorch has."""
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = torch.get_num_threads()
    return onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])


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
