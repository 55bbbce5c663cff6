"""``rawaug export``: a denoiser as an ONNX file, an ISP as a .cube, for programs without PyTorch.

A denoiser maps ``noisy`` and, if the network reads it, its ``variance`` to ``denoised``: float32 packed RAW, for any
number of pictures of any size, or for tiles of one shape, which CoreML and WebGPU want. ONNX Runtime runs the file, and
its result is compared with PyTorch's before the file is kept. A .cube, Adobe's format, maps sRGB to linear camera RGB,
up to lens shading and mosaic.
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
from rawaug.isp.description import reverse_table
from rawaug.isp.model import DictionaryISP
from rawaug.noise import noise_model
from rawaug.progress import progress

OPSET = 18
"""Version of ONNX's operators in which graphs are written."""

TOLERANCE = 1e-4
"""Largest difference of ONNX Runtime and PyTorch, with white at 1."""

HALF_TOLERANCE = 5e-3
"""The same in float16, which has 11 bits."""

DOMAIN = (
    "packed RAW, planes R, Gr, Gb, B of half the sides, linear, black 0, white 1, not clipped at black; "
    "variance = shot_var * max(noisy, 0) + read_var"
)
"""What the numbers of a file mean, as its metadata say."""

NODES = 33
"""Number of nodes of a .cube along each axis."""


def write_onnx(
    model: nn.Module,
    inputs: dict[str, Tensor],
    output: str,
    path: Path,
    metadata: Mapping[str, str] | None = None,
    fixed: bool = False,
    half: bool = False,
) -> Any:
    """Write ``model(*inputs)`` as ONNX, and open it in ONNX Runtime.

    Args:
        model: the network.
        inputs: examples of its inputs, by name.
        output: the name of its output.
        path: the file.
        metadata: texts to store in the file.
        fixed: whether inputs have the shapes of the examples; by default the batch, height and width of
            four-dimensional ones are free.
        half: whether the network computes in float16; inputs and output stay float32.

    Returns:
        The session of ONNX Runtime.
    """
    with extra("export"):
        import onnx

    free_axes = {}
    if not fixed:
        free_axes[output] = {0: "batch", 2: f"{output}_h", 3: f"{output}_w"}
    for name, value in inputs.items():
        if value.ndim == 4 and not fixed:
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

    graph = onnx.load(str(path))
    if half:
        from onnxruntime.transformers.float16 import convert_float_to_float16

        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # numbers below the smallest of float16
            graph = convert_float_to_float16(graph, keep_io_types=True)
        _drop_repeated_casts(graph.graph)
    if metadata:
        onnx.helper.set_model_props(graph, dict(metadata))
    onnx.save(graph, str(path))
    return open_session(path)


def _drop_repeated_casts(graph: Any) -> None:
    """Keep one of equal casts, which the conversion adds once for every node that reads a value."""
    defined: set[str] = set()
    nodes = []
    for node in graph.node:
        if not defined.issuperset(node.output):
            nodes.append(node)
            defined.update(node.output)

    del graph.node[:]
    graph.node.extend(nodes)


def difference_from(
    expected: Tensor, session: Any, inputs: Mapping[str, Tensor], path: Path, tolerance: float = TOLERANCE
) -> float:
    """Compute the largest difference between ONNX Runtime and PyTorch.

    Raises:
        ValueError: if it is above the tolerance.
    """
    (result,) = session.run(None, feeds(list(inputs), list(inputs.values())))
    difference = (torch.from_numpy(result) - expected).abs().max().item()
    if not difference <= tolerance:
        raise ValueError(f"{path}: ONNX Runtime differs from PyTorch by {difference:.1e}, more than {tolerance}")
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
    for red, green, blue in reverse_table(isp, setting, NODES).tolist():
        lines.append(f"{red:.7f} {green:.7f} {blue:.7f}")
    write_text("\n".join(lines) + "\n", path)


def run(
    weights: str,
    out: str,
    /,
    *,
    white_balance: Annotated[tuple[float, float, float] | None, YAML] = None,
    shape: str | None = None,
    half: bool = False,
    overwrite: bool = False,
) -> None:
    """Write a denoiser as ONNX, or an ISP as a .cube.

    Args:
        weights: a .safetensors file written by rawaug run or rawaug fit, or the name of a shipped denoiser or ISP.
        out: the .onnx file of a denoiser, or the .cube of an ISP.
        white_balance: as-shot multipliers R, G, B for which an ISP is exported; by default the fit's typical ones.
        shape: fixed shape of the tiles of a denoiser, as 1,4,512,512: batch, planes, height and width; any by default.
        half: let a denoiser compute in float16; its inputs and its output stay float32.
        overwrite: replace the output file if it exists.
    """
    require_output(out, overwrite)
    if read_header(find_weights(weights, FOLDER))["kind"] == "isp":
        if shape is not None or half:
            raise ValueError(f"--shape and --half do not apply to {weights}, which is an ISP; leave them out")
        export_cube(DictionaryISP.from_pretrained(weights), out, white_balance)
        print(f"{out}: {Path(out).stat().st_size / 1e6:.1f} MB")
        return
    if white_balance is not None:
        raise ValueError(f"--white-balance does not apply to {weights}, which is a denoiser; leave it out")
    print(export(weights, out, shape, half))


def export(denoiser: str | Path, out: str | Path, shape: str | None = None, half: bool = False) -> str:
    """Write a denoiser as ONNX.

    The metadata of the file hold its ``stride`` and ``upscale``, the ``shape`` of its tiles if that is fixed, and the
    ``domain``, which says what its numbers mean.

    Args:
        denoiser: a file of weights, or the name of a shipped denoiser.
        out: the .onnx file.
        shape: fixed shape of the tiles, as ``"1,4,512,512"``; any batch, height and width by default.
        half: whether the network computes in float16; inputs and output stay float32.

    Returns:
        One line with the size of the file and its difference from PyTorch.

    Raises:
        ValueError: if ``out`` has another ending, the network does not take the shape, or ONNX Runtime differs from
            PyTorch by more than the tolerance.
    """
    out = Path(out)
    if out.suffix != ".onnx":
        raise ValueError(f"{out}: give a name that ends in .onnx")

    model, info = denoisers.load(find_denoiser(denoiser))
    noisy, variance = _comparison_frame()
    example = torch.rand(2, model.channels, 70, 90)
    tile = None
    if shape is not None:
        tile = _require_shape(shape, model.channels)
        example = torch.rand(tile)
        noisy, variance = _fill(noisy, tile), _fill(variance, tile)
    inputs, examples = {"noisy": noisy}, {"noisy": example}
    if model.reads_variance:
        inputs["variance"] = variance
        examples["variance"] = 1e-3 * example + 1e-5

    metadata = {"stride": str(model.stride), "upscale": str(model.upscale), "info": json.dumps(info)}
    metadata["domain"] = DOMAIN
    if tile is not None:
        metadata["shape"] = ",".join(map(str, tile))
    steps = progress((), label=f"export {out.name}", unit="step", total=2)
    with steps, replacing(out) as partial, torch.inference_mode():
        session = write_onnx(model, examples, "denoised", partial, metadata, tile is not None, half)
        steps.update()
        tolerance = HALF_TOLERANCE if half else TOLERANCE
        difference = difference_from(model(*inputs.values()), session, inputs, out, tolerance)
        steps.update()

    megabytes = out.stat().st_size / 1e6
    size = f"{megabytes:.1f} MB, for any batch, height and width"
    if tile is not None:
        size = f"{megabytes:.1f} MB, for tiles of {' x '.join(map(str, tile))}"
    if half:
        size += ", computed in float16"
    return f"{out}: {size}; largest difference from PyTorch {difference:.1e}"


def _require_shape(shape: str, channels: int) -> tuple[int, ...]:
    """Read the shape of tiles; ValueError if a network of these channels does not take it."""
    try:
        sides = tuple(int(side) for side in shape.split(","))
    except ValueError:
        sides = ()
    if len(sides) != 4 or min(sides) < 1:
        raise ValueError(f"--shape is batch, planes, height and width, as 1,{channels},512,512; got {shape!r:.40}")
    if sides[1] != channels:
        raise ValueError(f"--shape {shape}: the network takes {channels} planes, as 1,{channels},512,512")
    return sides


def _fill(frame: Tensor, shape: tuple[int, ...]) -> Tensor:
    """Repeat a frame ``(1, 4, h, w)`` until it fills a shape."""
    height, width = frame.shape[-2:]
    repeated = frame.repeat(shape[0], 1, -(-shape[2] // height), -(-shape[3] // width))
    return repeated[..., : shape[2], : shape[3]].contiguous()


def _comparison_frame() -> tuple[Tensor, Tensor]:
    """Make noisy packed RAW ``(1, 4, h, w)`` of a generated scene, and its variance."""
    trial = make_trial(demo_pairs("test", count=1)[0], noise_model("cycleisp_sidd"))
    assert trial.variance is not None
    return trial.noisy, trial.variance
