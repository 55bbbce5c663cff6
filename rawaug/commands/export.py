"""``rawaug export``: a denoiser as an ONNX file, an ISP as a .cube, for programs without PyTorch.

A denoiser maps ``noisy`` and, if the network reads it, its ``variance`` to ``denoised``: float32 packed RAW, for any
number of pictures of any size. ONNX Runtime runs the file, and its result is compared with PyTorch's before the file is
kept. A .cube, Adobe's format, maps sRGB to linear camera RGB, up to lens shading and mosaic.
"""

from __future__ import annotations

import json
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import torch
from torch import Tensor, nn

import denoisers
from denoisers.files import FOLDER, find_denoiser
from denoisers.onnx import feeds, open_session
from rawaug.commands import YAML
from rawaug.data import demo_pairs
from rawaug.errors import extra
from rawaug.evaluation.trials import make_trial
from rawaug.files import find_weights, read_header, replacing, require_output, write_text
from rawaug.isp.model import DictionaryISP
from rawaug.noise import noise_model
from rawaug.progress import progress

OPSET = 18
"""Graphs are written in this version of ONNX's operators."""

TOLERANCE = 1e-4
"""ONNX Runtime and PyTorch may differ by this much, with white at 1."""

NODES = 33
"""A .cube has this many nodes along each axis."""


def write_onnx(
    model: nn.Module, inputs: dict[str, Tensor], output: str, path: Path, metadata: Mapping[str, str] | None = None
) -> Any:
    """Write ``model(*inputs)`` as ONNX of float32, and open it in ONNX Runtime.

    Batch, height and width of four-dimensional inputs are free.

    Args:
        model: the network.
        inputs: examples of its inputs, by name.
        output: the name of its output.
        path: the file.
        metadata: texts to store in the file.

    Returns:
        The session of ONNX Runtime.
    """
    with extra("export"):
        import onnx

    free_axes = {output: {0: "batch", 2: f"{output}_h", 3: f"{output}_w"}}
    for name, value in inputs.items():
        if value.ndim == 4:
            free_axes[name] = {0: "batch", 2: "h", 3: "w"}
    with warnings.catch_warnings(), torch.no_grad():
        warnings.simplefilter("ignore")  # the exporter's own: checks of shapes are no part of the graph
        torch.onnx.export(
            model,
            tuple(inputs.values()),
            str(path),
            input_names=list(inputs),
            output_names=[output],
            dynamic_axes=free_axes,
            opset_version=OPSET,
            dynamo=False,  # dynamo's graph of a pyramid takes minutes
        )

    if metadata:
        graph = onnx.load(str(path))
        onnx.helper.set_model_props(graph, dict(metadata))
        onnx.save(graph, str(path))
    return open_session(path)


def difference_from(expected: Tensor, session: Any, inputs: Mapping[str, Tensor], path: Path) -> float:
    """Compute the largest difference between ONNX Runtime and PyTorch.

    Raises:
        ValueError: if it is above :data:`TOLERANCE`.
    """
    (result,) = session.run(None, feeds(list(inputs), list(inputs.values())))
    difference = (torch.from_numpy(result) - expected).abs().max().item()
    if not difference <= TOLERANCE:
        raise ValueError(f"{path}: ONNX Runtime differs from PyTorch by {difference:.1e}, more than {TOLERANCE}")
    return difference


def export_cube(isp: DictionaryISP, out: str | Path, white_balance: Sequence[float] | None = None) -> None:
    """Write the reverse pass of an ISP for one setting, :data:`NODES` nodes along each axis, as a .cube.

    Args:
        isp: the ISP.
        out: the file.
        white_balance: as-shot multipliers of the setting; by default the fit's typical ones.
    """
    path = Path(out)
    if path.suffix != ".cube":
        raise ValueError(
            f"{path}: an ISP is exported to a .cube; rawaug info WEIGHTS --json prints its atoms and curve"
        )

    setting = isp.typical_setting(white_balance)
    gains = "{:.4f} {:.4f} {:.4f}".format(*setting.gains[0].tolist())
    lines = [
        f'TITLE "rawaug {path.stem}: sRGB to linear camera RGB"',
        f"# gains R G B {gains}, included; lens shading and mosaic are not",
        f"LUT_3D_SIZE {NODES}",
        "DOMAIN_MIN 0.0 0.0 0.0",
        "DOMAIN_MAX 1.0 1.0 1.0",
    ]
    for red, green, blue in isp.reverse_table(setting, NODES).tolist():
        lines.append(f"{red:.7f} {green:.7f} {blue:.7f}")
    write_text("\n".join(lines) + "\n", path)


def run(
    weights: str,
    out: str,
    /,
    *,
    white_balance: Annotated[tuple[float, float, float] | None, YAML] = None,
    overwrite: bool = False,
) -> None:
    """Write a denoiser as ONNX, or an ISP as a .cube.

    Args:
        weights: a .safetensors file written by rawaug run or rawaug fit, or the name of a shipped denoiser or ISP.
        out: the .onnx file of a denoiser, or the .cube of an ISP.
        white_balance: as-shot multipliers R, G, B for which an ISP is exported; by default the fit's typical ones.
        overwrite: replace the output file if it exists.
    """
    require_output(out, overwrite)
    if read_header(find_weights(weights, FOLDER))["kind"] == "isp":
        export_cube(DictionaryISP.from_pretrained(weights), out, white_balance)
        print(f"{out}: {Path(out).stat().st_size / 1e6:.1f} MB")
        return
    if white_balance is not None:
        raise ValueError(f"--white-balance does not apply to {weights}, which is a denoiser; leave it out")
    print(export(weights, out))


def export(denoiser: str | Path, out: str | Path) -> str:
    """Write a denoiser as ONNX.

    Args:
        denoiser: a file of weights, or the name of a shipped denoiser.
        out: the .onnx file.

    Returns:
        One line with the size of the file and its difference from PyTorch.

    Raises:
        ValueError: if ``out`` has another ending, or ONNX Runtime differs from PyTorch by more than the tolerance.
    """
    out = Path(out)
    if out.suffix != ".onnx":
        raise ValueError(f"{out}: give a name that ends in .onnx")

    model, info = denoisers.load(find_denoiser(denoiser))
    noisy, variance = _comparison_frame()
    example = torch.rand(2, model.channels, 70, 90)
    inputs, examples = {"noisy": noisy}, {"noisy": example}
    if model.reads_variance:
        inputs["variance"] = variance
        examples["variance"] = 1e-3 * example + 1e-5

    metadata = {"stride": str(model.stride), "upscale": str(model.upscale), "info": json.dumps(info)}
    steps = progress((), label=f"export {out.name}", unit="step", total=2)
    with steps, replacing(out) as partial, torch.inference_mode():
        session = write_onnx(model, examples, "denoised", partial, metadata)
        steps.update()
        difference = difference_from(model(*inputs.values()), session, inputs, out)
        steps.update()

    megabytes = out.stat().st_size / 1e6
    size = f"{megabytes:.1f} MB, for any batch, height and width"
    return f"{out}: {size}; largest difference from PyTorch {difference:.1e}"


def _comparison_frame() -> tuple[Tensor, Tensor]:
    """Make noisy packed RAW ``(1, 4, h, w)`` of a generated scene, and its variance."""
    trial = make_trial(demo_pairs("test", count=1)[0], noise_model("cycleisp_sidd"))
    assert trial.variance is not None
    return trial.noisy, trial.variance
