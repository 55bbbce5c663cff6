"""``rawaug export``: a denoiser as an ONNX file, an ISP as JSON, .cube and ONNX, for programs without PyTorch.

A denoiser maps ``noisy`` and, where the network reads it, its ``variance`` to ``denoised``: float32 packed RAW, any
number of pictures of any size. An ISP becomes JSON (``rawaug info --json`` and the .cube's table), a .cube (Adobe's
format, 33 nodes along each axis: sRGB to linear camera RGB, up to lens shading and mosaic), and ONNX: ``srgb (1, 3, h,
w)`` of even sides in [0, 1], ``matrix (1, 3, 3)`` from linear sRGB to camera RGB and ``gains (1, 3)`` to ``raw (1, 4,
h/2, w/2)``. An ONNX file is run by ONNX Runtime and compared with PyTorch before it is left there.
"""

from __future__ import annotations

import json
import warnings
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import torch
from torch import Tensor, nn

import denoisers
from denoisers.files import FOLDER, find_denoiser
from rawaug.bayer import pack_rgb
from rawaug.commands import YAML
from rawaug.data import demo_pairs
from rawaug.denoise.foreign import feeds, session_of
from rawaug.errors import extra
from rawaug.evaluation.trials import trial_of
from rawaug.files import find_weights, read_header, replacing
from rawaug.isp.config import ISPParams
from rawaug.isp.model import DictionaryISP
from rawaug.noise import noise_model
from rawaug.progress import progress
from rawaug.seeding import keyed_generator

OPSET = 18
"""The version of ONNX's operators that a graph is written in."""
TOLERANCE = 1e-4
"""Largest difference between ONNX Runtime and PyTorch, white at 1."""
NODES = 33
"""Of a .cube along each axis."""


def write_onnx(
    model: nn.Module, inputs: dict[str, Tensor], output: str, path: Path, stated: Mapping[str, str] | None = None
) -> Any:
    """Write ``model(*inputs)`` as ONNX of float32, with metadata; the ONNX Runtime session of it.

    Batch, height and width of four-dimensional inputs are free.
    """
    with extra("export"):
        import onnx
    free = {name: {0: "batch", 2: "h", 3: "w"} for name, value in inputs.items() if value.ndim == 4}
    with warnings.catch_warnings(), torch.no_grad():
        warnings.simplefilter("ignore")  # the exporter's own: checks of shapes are no part of the graph
        torch.onnx.export(
            model,
            tuple(inputs.values()),
            str(path),
            input_names=list(inputs),
            output_names=[output],
            dynamic_axes=free | {output: {0: "batch", 2: f"{output}_h", 3: f"{output}_w"}},
            opset_version=OPSET,
            dynamo=False,  # whose graph of a pyramid takes minutes
        )
    if stated:
        made = onnx.load(str(path))
        onnx.helper.set_model_props(made, dict(stated))
        onnx.save(made, str(path))
    return session_of(path)


def difference_from(expected: Tensor, session: Any, inputs: Mapping[str, Tensor], path: Path) -> float:
    """The largest difference between ONNX Runtime and PyTorch; ValueError if it is above :data:`TOLERANCE`."""
    (result,) = session.run(None, feeds(list(inputs), list(inputs.values())))
    difference = (torch.from_numpy(result) - expected).abs().max().item()
    if not difference <= TOLERANCE:
        raise ValueError(f"{path}: ONNX Runtime differs from PyTorch by {difference:.1e}, more than {TOLERANCE}")
    return difference


def export_isp(isp: DictionaryISP, out: str | Path, white_balance: Sequence[float] | None = None) -> list[Path]:
    """Write an ISP to ``out``, by its extension .json, .cube or .onnx; without one, a folder with all three."""
    out = Path(out)
    if out.suffix not in ("", *WRITERS):
        raise ValueError(f"{out}: an ISP is exported to {', '.join(WRITERS)}, or to a folder with all of them")
    files = [out] if out.suffix else [out / f"isp{suffix}" for suffix in WRITERS]
    for file in files:
        with replacing(file) as partial:
            WRITERS[file.suffix](isp, partial, file, white_balance)
    return files


def _write_json(isp: DictionaryISP, partial: Path, path: Path, white_balance: Sequence[float] | None) -> None:
    table = isp.reverse_table(isp.typical_setting(white_balance), NODES)
    values = [[round(value, 7) for value in row] for row in table.tolist()]
    content = isp.description(white_balance) | {"lut": {"size": NODES, "fastest": "red", "values": values}}
    partial.write_text(json.dumps(content) + "\n")


def _write_cube(isp: DictionaryISP, partial: Path, path: Path, white_balance: Sequence[float] | None) -> None:
    setting = isp.typical_setting(white_balance)
    gains = " ".join(f"{gain:.4f}" for gain in setting.gains[0].tolist())
    lines = [
        f'TITLE "rawaug {path.stem}: sRGB to linear camera RGB"',
        f"# gains R G B {gains}, included; lens shading and mosaic are not",
        f"LUT_3D_SIZE {NODES}",
        "DOMAIN_MIN 0.0 0.0 0.0",
        "DOMAIN_MAX 1.0 1.0 1.0",
        *(" ".join(f"{value:.7f}" for value in row) for row in isp.reverse_table(setting, NODES).tolist()),
    ]
    partial.write_text("\n".join(lines) + "\n")


def _write_onnx(isp: DictionaryISP, partial: Path, path: Path, white_balance: Sequence[float] | None) -> None:
    setting = isp.typical_setting(white_balance)
    srgb = torch.rand(1, 3, 70, 90, generator=keyed_generator(0, "export"))
    inputs = {"srgb": srgb, "matrix": setting.matrix.detach(), "gains": setting.gains.detach()}
    session = write_onnx(ReversePass(isp).eval(), inputs, "raw", partial)
    with torch.no_grad():
        expected = pack_rgb(isp.reverse_pixels(srgb, setting), isp.cfa)
    difference_from(expected, session, inputs, path)


WRITERS: dict[str, Callable[[DictionaryISP, Path, Path, Sequence[float] | None], None]] = {
    ".json": _write_json,
    ".cube": _write_cube,
    ".onnx": _write_onnx,
}
"""By extension: an ISP to a file that gets another name."""


class ReversePass(nn.Module):
    """The reverse pass of an ISP as a function of tensors alone; its tone curves are mixed as is typical."""

    def __init__(self, isp: DictionaryISP) -> None:
        super().__init__()
        self.isp = isp

    def forward(self, srgb: Tensor, matrix: Tensor, gains: Tensor) -> Tensor:
        """``(1, 3, h, w)``, ``(1, 3, 3)`` and ``(1, 3)`` to ``(1, 4, h/2, w/2)``."""
        none, tones = matrix.new_zeros(len(matrix), 0), self.isp.typical_tones().expand(len(matrix), -1)
        params = ISPParams(none, none, matrix, gains, tones)
        return pack_rgb(self.isp.reverse_pixels(srgb, params, _places(srgb)), self.isp.cfa)


def _places(image: Tensor) -> Tensor:
    """Coordinates of :func:`rawaug.isp.stages.frame_coordinates`, from a tensor, so that any size is traced."""
    ones = torch.ones_like(image[:, :1])
    rows, columns = ones.cumsum(2), ones.cumsum(3)
    height, width = rows[..., -1:, -1:], columns[..., -1:, -1:]
    half_diagonal = 0.5 * (height.square() + width.square()).sqrt()
    return torch.cat([rows - 0.5 - height / 2, columns - 0.5 - width / 2], dim=1) / half_diagonal


def run(
    weights: str,
    out: str,
    /,
    *,
    white_balance: Annotated[tuple[float, float, float] | None, YAML] = None,
) -> None:
    """Write a denoiser as ONNX, or an ISP as JSON, .cube and ONNX.

    Args:
        weights: a .safetensors file written by rawaug run or rawaug fit, or the name of a shipped denoiser or ISP.
        out: the .onnx file of a denoiser; of an ISP .json, .cube, .onnx, or a folder for all three.
        white_balance: as-shot multipliers R, G, B for which an ISP is exported; by default those typical of the fit.
    """
    if read_header(find_weights(weights, FOLDER))["kind"] == "isp":
        for path in export_isp(DictionaryISP.from_pretrained(weights), out, white_balance):
            print(f"{path}: {path.stat().st_size / 1e6:.1f} MB")
        return
    if white_balance is not None:
        raise ValueError(f"--white-balance: is for ISPs, and {weights} is a denoiser")
    print(export(weights, out))


def export(denoiser: str | Path, out: str | Path) -> str:
    """Write a denoiser as ONNX; the text tells the size of its file and its difference from PyTorch."""
    out = Path(out)
    if out.suffix != ".onnx":
        raise ValueError(f"{out}: give a name that ends in .onnx")
    model, info = denoisers.load(find_denoiser(denoiser))
    names = ["noisy", "variance"][: 1 + model.reads_variance]
    inputs = dict(zip(names, _comparison_frame(), strict=False))
    example = torch.rand(2, model.channels, 70, 90)
    examples = dict(zip(names, (example, 1e-3 * example + 1e-5), strict=False))
    stated = {"stride": str(model.stride), "upscale": str(model.upscale), "info": json.dumps(info)}
    steps = progress((), label=f"export {out.name}", unit="step", total=2)
    with steps, replacing(out) as partial, torch.inference_mode():
        session = write_onnx(model, examples, "denoised", partial, stated)
        steps.update()
        difference = difference_from(model(*inputs.values()), session, inputs, out)
        steps.update()
    size = f"{out.stat().st_size / 1e6:.1f} MB, of any batch, height and width"
    return f"{out}: {size}; largest difference from PyTorch {difference:.1e}"


def _comparison_frame() -> tuple[Tensor, Tensor]:
    """Noisy packed RAW ``(1, 4, h, w)`` of a generated scene, and its variance."""
    trial = trial_of(demo_pairs("test", count=1)[0], noise_model("cycleisp_sidd"))
    assert trial.variance is not None
    return trial.noisy, trial.variance
