"""An ISP as a .cube gives the reverse pass that PyTorch gives; its description as JSON."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from scipy.interpolate import RegularGridInterpolator

from rawaug.cli import main
from rawaug.commands.export import export_cube
from rawaug.commands.info import read_facts
from rawaug.isp.model import DictionaryISP
from rawaug.isp.stages import LensShading


@pytest.fixture(scope="module", params=["canon-powershot", "gopro-hero", "universal-small"])
def isp(request: pytest.FixtureRequest) -> DictionaryISP:
    """A learned curve, one with lens shading, and a mixture of measured curves."""
    return DictionaryISP.from_pretrained(request.param)


def centred(isp: DictionaryISP, srgb: torch.Tensor, white_balance: tuple[float, ...] | None = None) -> torch.Tensor:
    """Camera RGB at the centre of the lens shading."""
    shading = isp.stages.find(LensShading)
    mean = torch.zeros(2) if shading is None else shading.mask.mean
    place = mean[None, :, None, None].expand(1, 2, *srgb.shape[-2:])
    with torch.no_grad():
        return isp.stages.reverse(srgb, isp.typical_setting(white_balance), place)


def test_the_cube_interpolates_the_reverse_pass(isp: DictionaryISP, tmp_path: Path) -> None:
    path = tmp_path / "camera.cube"
    export_cube(isp, path, (2.0, 1.0, 1.5))
    lines = path.read_text().splitlines()
    assert "LUT_3D_SIZE 33" in lines
    rows = [[float(value) for value in line.split()] for line in lines if line[0].isdigit() or line[0] == "-"]
    table = torch.tensor(rows, dtype=torch.float64).reshape(33, 33, 33, 3)  # blue, green, red: red is the fastest
    srgb = torch.rand(1, 3, 16, 64, generator=torch.Generator().manual_seed(0))
    axis = torch.linspace(0, 1, 33, dtype=torch.float64)
    read = RegularGridInterpolator((axis, axis, axis), table.numpy())(srgb[0].flatten(1).T.flip(1).numpy())
    expected = centred(isp, srgb, (2.0, 1.0, 1.5))[0].flatten(1).T.double()
    least = 70 if isp.tone is None else 40  # measured tone curves bend too sharply for 33 nodes
    assert -10 * (torch.from_numpy(read) - expected).square().mean().log10() > least
    assert (expected[:, 0] - expected[:, 2]).abs().mean() > 0.01, "red and blue cannot be told apart"


def test_the_commands_write_and_print_and_refuse(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], refused: Callable[..., str]
) -> None:
    assert main(["info", "canon-powershot", "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed == json.loads(json.dumps(read_facts("canon-powershot")))
    assert len(printed["tone_curve"]) == 256 and printed["kind"] == "isp"
    assert main(["info", "rawaug-small", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["name"] == "DRUNet"
    assert main(["info", "canon-powershot"]) == 0
    described = capsys.readouterr().out
    assert "tone and gamma, grey code to linear: 16 0.0" in described and "colour atoms" in described
    assert main(["export", "canon-powershot", str(tmp_path / "a.cube"), "--white-balance", "[2.0, 1.0, 1.6]"]) == 0
    assert "a.cube: 1.1 MB" in capsys.readouterr().out
    for arguments, message in (
        (["canon-powershot", str(tmp_path / "a.txt")], "an ISP is exported to a .cube"),
        (["rawaug-small", str(tmp_path / "a.onnx"), "--white-balance", "[2, 1, 1]"], "--white-balance"),
    ):
        assert message in refused("export", *arguments)
