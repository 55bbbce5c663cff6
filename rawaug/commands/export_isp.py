"""An ISP for programs without PyTorch: its numbers as JSON, a .cube, and its reverse pass as ONNX.

- JSON: what ``rawaug info --json`` prints, and ``lut``, the table of the .cube.
- .cube (Adobe's format, 33 nodes along each axis): sRGB to linear camera RGB, up to lens shading and mosaic.
- ONNX: ``srgb (1, 3, h, w)`` of even sides in [0, 1], ``matrix (1, 3, 3)`` from linear sRGB to camera RGB and
  ``gains (1, 3)`` to ``raw (1, 4, h/2, w/2)``, packed R, Gr, Gb, B; the JSON has a typical matrix and gains. ONNX
  Runtime and PyTorch are compared before the file is left there.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path

import torch
from torch import Tensor, nn

from rawaug.bayer import pack_rgb
from rawaug.commands.onnx_files import feeds, require_equal, require_onnx, session_of, to_onnx
from rawaug.files import replacing
from rawaug.isp.description import description, reverse_table, typical_setting
from rawaug.isp.model import DictionaryISP
from rawaug.isp.setting import ISPParams
from rawaug.seeding import keyed_generator

NODES = 33
"""Of the table along each axis."""


def export_isp(isp: DictionaryISP, out: str | Path, white_balance: Sequence[float] | None = None) -> list[Path]:
    """Write an ISP to ``out``, by its extension .json, .cube or .onnx; without one, a folder with all three.

    Args:
        isp: the ISP.
        out: the file, or a folder to make.
        white_balance: as-shot multipliers R, G, B of the setting; the fit's typical one by default.

    Returns:
        The files, each written whole.

    Raises:
        ValueError: for another extension; for ONNX, if a package is missing or ONNX Runtime differs from PyTorch.
    """
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
    table = reverse_table(isp, typical_setting(isp, white_balance), NODES)
    values = [[round(value, 7) for value in row] for row in table.tolist()]
    content = description(isp, white_balance) | {"lut": {"size": NODES, "fastest": "red", "values": values}}
    with replacing(path) as partial:
        partial.write_text(json.dumps(content) + "\n")


def _write_cube(isp: DictionaryISP, path: Path, white_balance: Sequence[float] | None) -> None:
    setting = typical_setting(isp, white_balance)
    gains = " ".join(f"{gain:.4f}" for gain in setting.gains[0].tolist())
    lines = [
        f'TITLE "rawaug {path.stem}: sRGB to linear camera RGB"',
        f"# gains R G B {gains}, included; lens shading and mosaic are not",
        f"LUT_3D_SIZE {NODES}",
        "DOMAIN_MIN 0.0 0.0 0.0",
        "DOMAIN_MAX 1.0 1.0 1.0",
        *(" ".join(f"{value:.7f}" for value in row) for row in reverse_table(isp, setting, NODES).tolist()),
    ]
    with replacing(path) as partial:
        partial.write_text("\n".join(lines) + "\n")


def _write_onnx(isp: DictionaryISP, path: Path, white_balance: Sequence[float] | None) -> None:
    setting = typical_setting(isp, white_balance)
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
    """The reverse pass of an ISP as a function of tensors alone: sRGB, matrix and gains to packed RAW, any size.

    Args:
        isp: whose tone, shading and mosaic are taken; tone curves of a dictionary are mixed as is typical.
    """

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
