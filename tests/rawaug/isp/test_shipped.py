"""Every ISP that ships can be opened by every table and command that takes one."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from PIL import Image

from rawaug.cli import main
from rawaug.data import demo_pairs
from rawaug.files import WEIGHTS
from rawaug.isp.model import DictionaryISP
from rawaug.paper import reconstruction
from rawaug.paper.reconstruction import Comparison, compare

NAMES = sorted(path.stem for path in WEIGHTS.glob("*.safetensors"))


@pytest.mark.parametrize("name", NAMES)
def test_a_shipped_isp_has_a_row_in_the_tables(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    cfa = DictionaryISP.from_pretrained(name).cfa
    pairs = [replace(pair.in_pattern(cfa).middle(64), name=str(k)) for k, pair in enumerate(demo_pairs("train", 2))]
    monkeypatch.setattr(reconstruction, "open_pairs", lambda spec, split: pairs)

    rows = compare(Comparison(methods=[name], seeds=1, cycle_crop=32, picture_count=1, out=str(tmp_path)))
    assert f"{name}, as-shot gains" in rows
    assert all(torch.tensor(row["psnr_r"]).isfinite().all() for row in rows.values())


@pytest.mark.parametrize("name", NAMES)
def test_a_shipped_isp_is_taken_by_every_command(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    picture = tmp_path / "picture.png"
    noise = torch.randint(256, (48, 64, 3), generator=torch.Generator().manual_seed(0), dtype=torch.uint8)
    Image.fromarray(noise.numpy()).save(picture)
    (tmp_path / "pictures").mkdir()
    picture.rename(tmp_path / "pictures" / "picture.png")

    assert main(["info", name, "--json"]) == 0
    assert main(["export", name, str(tmp_path / "isp.cube")]) == 0
    folder = str(tmp_path / "pictures")
    assert main(["synth", folder, str(tmp_path / "pairs"), "--isp", name, "--format", "npz"]) == 0
    assert main(["preview", f"{folder}/picture.png", "--isp", name, "--count", "1", "--out", f"{tmp_path}/p.png"]) == 0
    assert capsys.readouterr().out
