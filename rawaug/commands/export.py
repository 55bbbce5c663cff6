"""``rawaug export``: a denoiser as an ONNX file, an ISP as JSON, .cube and ONNX, for programs without PyTorch.

A denoiser's inputs are ``noisy`` and, where the network reads it, ``variance`` = shot_var max(noisy, 0) + read_var, its
output ``denoised``: float32 packed RAW (R, Gr, Gb, B) ``(1, 4, h, w)`` of any h, w >= 2. An ISP becomes

- JSON: what ``rawaug info --json`` prints, and ``lut``, the table of the .cube.
- .cube (Adobe's format, 33 nodes along each axis): sRGB to linear camera RGB, up to lens shading and mosaic.
- ONNX: ``srgb (1, 3, h, w)`` of even sides in [0, 1], ``matrix (1, 3, 3)`` from linear sRGB to camera RGB and
  ``gains (1, 3)`` to ``raw (1, 4, h/2, w/2)``, packed R, Gr, Gb, B; the JSON has a typical matrix and gains.

An ONNX file is run by ONNX Runtime and compared with PyTorch before it is left there.
"""

from __future__ import annotations

import json
import logging
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import torch
from torch import Tensor, nn

import denoisers
from denoisers.files import FOLDER, find
from rawaug import bayer
from rawaug.bayer import CFA, pack_rgb
from rawaug.commands import YAML
from rawaug.data import demo_pairs
from rawaug.evaluation.contestants import feeds, session_of
from rawaug.evaluation.scores import frozen_sample
from rawaug.files import find_weights, read_header, replacing
from rawaug.io import read_raw
from rawaug.isp.config import ISPParams
from rawaug.isp.model import DictionaryISP
from rawaug.noise import noise_model
from rawaug.seeding import keyed_generator

TOLERANCE = 1e-4
"""Largest difference between ONNX Runtime and PyTorch, white at 1."""
NEEDED = ("onnx", "onnxscript", "onnxruntime")
NODES = 33
"""Of a .cube along each axis."""
SIDE = 512
"""Mosaic pixels on the longer side of the frame on which both are run and timed."""


def require_onnx(way_out: str = "") -> None:
    """Raise ValueError if a package that writes or runs ONNX is missing; ``way_out`` ends the message."""
    missing = [name for name in NEEDED if find_spec(name) is None]
    if missing:
        raise ValueError(f"export to ONNX needs {', '.join(missing)}: pip install 'rawaug[export]'{way_out}")


def to_onnx(
    model: nn.Module, inputs: dict[str, Tensor], output: str, path: Path, stated: Mapping[str, str] | None = None
) -> None:
    """One ONNX file of float32 of ``model(*inputs)``; height and width of four-dimensional inputs are free.

    ``stated`` are its metadata.
    """
    free = {2: torch.export.Dim.DYNAMIC, 3: torch.export.Dim.DYNAMIC}
    with warnings.catch_warnings(), errors_only("torch.onnx"):  # not the exporter's own, as of torchvision's absence
        warnings.simplefilter("ignore")
        shapes = tuple(free if value.ndim == 4 else None for value in inputs.values())
        program = torch.export.export(model, tuple(inputs.values()), dynamic_shapes=shapes)
        onnx = torch.onnx.export(program, input_names=list(inputs), output_names=[output], dynamo=True, verbose=False)
        assert onnx is not None
        onnx.model.metadata_props.update(stated or {})
        onnx.save(str(path), external_data=False)


@contextmanager
def errors_only(name: str) -> Iterator[None]:
    """A logger and those below it say nothing less than an error."""
    logger = logging.getLogger(name)
    before = logger.level
    logger.setLevel(logging.ERROR)
    try:
        yield
    finally:
        logger.setLevel(before)


def require_equal(result: Any, expected: Tensor, path: Path) -> float:
    """The largest difference between ONNX Runtime's result and PyTorch's, unless it is above :data:`TOLERANCE`."""
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
    if any(file.suffix == ".onnx" for file in files):
        require_onnx("; .json and .cube files can be written without, one by one")
    for file in files:
        WRITERS[file.suffix](isp, file, white_balance)
    return files


def _write_json(isp: DictionaryISP, path: Path, white_balance: Sequence[float] | None) -> None:
    table = isp.reverse_table(isp.typical_setting(white_balance), NODES)
    values = [[round(value, 7) for value in row] for row in table.tolist()]
    content = isp.description(white_balance) | {"lut": {"size": NODES, "fastest": "red", "values": values}}
    with replacing(path) as partial:
        partial.write_text(json.dumps(content) + "\n")


def _write_cube(isp: DictionaryISP, path: Path, white_balance: Sequence[float] | None) -> None:
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
    with replacing(path) as partial:
        partial.write_text("\n".join(lines) + "\n")


def _write_onnx(isp: DictionaryISP, path: Path, white_balance: Sequence[float] | None) -> None:
    setting = isp.typical_setting(white_balance)
    srgb = torch.rand(1, 3, 70, 90, generator=keyed_generator(0, "export"))
    inputs = {"srgb": srgb, "matrix": setting.matrix.detach(), "gains": setting.gains.detach()}
    with replacing(path) as partial:
        to_onnx(ReversePass(isp).eval(), inputs, "raw", partial)
        (result,) = session_of(partial).run(None, feeds(list(inputs), list(inputs.values())))
        with torch.no_grad():
            expected = pack_rgb(isp.reverse_pixels(srgb, setting), isp.cfa)
        require_equal(result, expected, path)


WRITERS: dict[str, Callable[[DictionaryISP, Path, Sequence[float] | None], None]] = {
    ".json": _write_json,
    ".cube": _write_cube,
    ".onnx": _write_onnx,
}
"""By extension."""


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
    """Coordinates of :func:`rawaug.isp.stages.place_in_frame`, computed from a tensor, so that any size is traced."""
    ones = torch.ones_like(image[:, :1])
    rows, columns = ones.cumsum(2), ones.cumsum(3)
    height, width = rows[..., -1:, -1:], columns[..., -1:, -1:]
    half_diagonal = 0.5 * (height.square() + width.square()).sqrt()
    return torch.cat([rows - 0.5 - height / 2, columns - 0.5 - width / 2], dim=1) / half_diagonal


class Exported(NamedTuple):
    """What was written, the largest difference from PyTorch with white at 1, and seconds a mosaic megapixel."""

    out: Path
    difference: float
    seconds_onnx: float
    seconds_torch: float


def run(
    weights: str,
    out: str,
    /,
    *,
    frame: str | None = None,
    white_balance: Annotated[tuple[float, float, float] | None, YAML] = None,
) -> None:
    """Write a denoiser as ONNX, or an ISP as JSON, .cube and ONNX.

    Args:
        weights: a .safetensors file written by rawaug run or rawaug fit, or the name of a shipped denoiser or ISP.
        out: the .onnx file of a denoiser; of an ISP .json, .cube, .onnx, or a folder for all three.
        frame: RAW file whose middle is used to compare a denoiser with its ONNX; by default a generated frame.
        white_balance: as-shot multipliers R, G, B for which an ISP is exported; by default those typical of the fit.

    Raises:
        FileNotFoundError, ValueError: if the weights or the frame cannot be read, ``out`` has another extension, an
            option is of the other kind, a package is missing, or ONNX Runtime and PyTorch differ.
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
    """Write ``denoiser`` to the ONNX file ``out``, whole or not at all; see :func:`run`."""
    out = Path(out)
    if out.suffix != ".onnx":
        raise ValueError(f"{out}: give a name that ends in .onnx")
    require_onnx()
    model, info = denoisers.load(find(denoiser))
    names = ["noisy", "variance"][: 1 + model.reads_variance]
    images = comparison_frame(frame)[: len(names)]
    example = torch.rand(1, model.channels, 70, 90)
    examples = dict(zip(names, (example, 1e-3 * example + 1e-5), strict=False))
    stated = {"stride": str(model.stride), "upscale": str(model.upscale), "info": json.dumps(info)}
    with replacing(out) as partial:
        to_onnx(model, examples, "denoised", partial, stated)
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
    return packed, bayer.noise_variance(packed, shot_var, read_var)


def _fastest(call: Callable[[], Any], repeats: int = 3) -> float:
    seconds = []
    for _ in range(repeats):
        start = time.perf_counter()
        call()
        seconds.append(time.perf_counter() - start)
    return min(seconds)
