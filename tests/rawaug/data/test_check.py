from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scipy.io import savemat

from rawaug.cli import main
from rawaug.data import PictureFolder, RawFolder, check
from rawaug.data.sidd_scenes import HELD_BACK
from rawaug.files import files_below
from rawaug.io import write_picture

Writer = Callable[[Path, dict[str, Any]], Path]


def write_pictures(folder: Path, count: int = 3) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for k in range(count):
        write_picture(folder / f"{k}.png", torch.full((3, 6, 8 + 2 * (k % 2)), k, dtype=torch.uint8))


def test_pictures_are_counted_by_size_and_the_broken_ones_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("RAWAUG_READ_SECONDS", "60")  # in the helper
    write_pictures(tmp_path, 5)
    (tmp_path / "3.png").write_bytes(b"broken")
    report = check(tmp_path)
    assert str(report).splitlines()[:4] == [
        str(tmp_path),
        "pictures: 5",
        "  sizes: 6 x 8 (3), 6 x 10 (1)",
        "  damaged: 1",
    ]
    (line,) = report.broken
    assert "3.png: cannot be read as a picture" in line
    assert "pictures: 5, 2 examined" in str(check(tmp_path, first=2))


def test_files_that_no_dataset_means_are_not_counted(tmp_path: Path, bayer_dng: Callable[..., Path]) -> None:
    write_pictures(tmp_path)
    bayer_dng(tmp_path / "a.dng", np.full((32, 48), 1000, np.uint16))
    (tmp_path / "__MACOSX").mkdir()
    for name in ("__MACOSX/._0.png", "__MACOSX/1.png", "._0.png", "._a.dng", ".DS_Store", "Thumbs.db"):
        (tmp_path / name).write_bytes(b"Mac OS X")
    raws, pictures = check(tmp_path).parts
    assert (raws.items, pictures.items) == (1, 3) and not raws.broken and not pictures.broken
    assert len(PictureFolder(tmp_path)) == 3 and RawFolder(tmp_path).names == ["a"]
    assert len(list(files_below(tmp_path))) == 4


def test_raw_files_report_levels_patterns_and_cameras(tmp_path: Path, bayer_dng: Callable[..., Path]) -> None:
    numbers = np.full((32, 48), 1000, np.uint16)
    bayer_dng(tmp_path / "a.dng", numbers, cfa="GRBG", black=(64,), white=1023)
    bayer_dng(tmp_path / "b.dng", numbers, cfa="BGGR", black=(64,), white=1023)
    (tmp_path / "c.dng").write_bytes((tmp_path / "a.dng").read_bytes()[:300])
    write_pictures(tmp_path)
    raws, pictures = check(tmp_path).parts
    assert raws.what == "RAW files" and raws.items == 3 and dict(raws.counts["cfas"]) == {"GRBG": 1, "BGGR": 1}
    assert dict(raws.counts["levels"]) == {"black 64, white 1023": 2} and dict(raws.counts["cameras"]) == {
        "Maker Model 1": 2
    }
    assert "c.dng" in raws.broken[0]
    assert pictures.what == "pictures" and pictures.items == 3


def test_every_dataset_is_recognised(tmp_path: Path, mat73: Writer) -> None:
    scene = tmp_path / "sidd" / "Data" / "0001_001_S6_00100_00060_3200_L"
    frame = np.random.default_rng(0).random((64, 66)).astype(np.float32)
    for kind in ("GT", "NOISY"):
        mat73(scene / f"0001_{kind}_RAW_010.MAT", {"x": frame})
    tags = {"AsShotNeutral": [[0.5, 1.0, 0.7]], "ColorMatrix2": np.eye(3).reshape(1, 9)}
    savemat(scene / "0001_METADATA_RAW_010.MAT", {"metadata": tags})
    blocks = np.full((len(HELD_BACK), 32, 8, 8), 0.5, np.float32)
    savemat(tmp_path / "sidd" / "BenchmarkNoisyBlocksRaw.mat", {"BenchmarkNoisyBlocksRaw": blocks})
    savemat(tmp_path / "sidd" / "ValidationNoisyBlocksRaw.mat", {"ValidationNoisyBlocksRaw": blocks})
    frames, validation, benchmark = check(tmp_path / "sidd", first=40).parts
    assert frames.what == "SIDD, full frames" and dict(frames.counts["cfas"]) == {"GRBG": 1} and not frames.broken
    assert validation.items == 0 and "contains no ValidationGtBlocksRaw.mat" in validation.broken[0]
    assert benchmark.items == 1280 and dict(benchmark.counts["cfas"]) == {"GRBG": 32, "BGGR": 8}

    np.save(tmp_path / "a.npy", np.zeros((4, 6, 4), np.uint16))
    write_picture(tmp_path / "a.png", torch.zeros(3, 8, 12, dtype=torch.uint8))
    (rawir,) = (part for part in check(tmp_path, first=1).parts if part.what.startswith("RAWIR"))
    assert rawir.items == 1 and dict(rawir.counts["sizes"]) == {"8 x 12": 1} and not rawir.broken


def test_what_crashes_the_helper_is_named_and_the_rest_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_pictures(tmp_path, 4)
    module = sys.modules["rawaug.data.check"]
    whole = module.isolated

    def isolated(read: Any, opening: bytes, index: int, name: object) -> Any:
        if index == 1:
            raise OSError(f"{name}: crashes the decoder")
        return whole(read, opening, index, name=name)

    monkeypatch.setattr(module, "isolated", isolated)
    (part,) = check(tmp_path).parts
    assert part.counts["sizes"].total() == 3 and part.items == part.examined == 4
    assert part.broken == [f"{tmp_path / '1.png'}: crashes the decoder"]


def test_what_is_unknown_is_reported(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="none:"):
        check(tmp_path / "none")
    (tmp_path / "notes.txt").write_text("nothing")
    with pytest.raises(ValueError, match="contains"):
        check(tmp_path)


def test_the_command_prints_the_report(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_pictures(tmp_path)
    assert main(["data", "check", str(tmp_path)]) == 0
    assert "pictures: 3" in capsys.readouterr().out
    (tmp_path / "1.png").write_bytes(b"")
    assert main(["data", "check", str(tmp_path), "--first", "2"]) == 2
    printed = capsys.readouterr()
    assert "1.png" in printed.out and "damaged" in printed.err
    assert main(["data", "check", str(tmp_path / "none")]) == 2
    assert "none: no such file or folder" in capsys.readouterr().err


def test_kinds_of_data_are_opened_as_everywhere(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("RAWAUG_READ_SECONDS", "120")
    pictures, pairs = "pictures of shapes:3", "pairs of real:test"
    report = check("shapes:3")
    assert [part.what for part in report.parts] == [pictures] and report.parts[0].items == 3 and not report.broken
    report = check("demo:validation", first=1)
    assert [part.what for part in report.parts] == ["pairs of demo:validation"] and not report.broken
    report = check("real:test", first=1)
    assert [part.what for part in report.parts] == [pairs] and report.parts[0].examined == 1 and not report.broken
    assert set(report.parts[0].counts) >= {"sizes", "cfas"}
    with pytest.raises(ValueError, match="reel"):
        check("reel:test")


def test_a_linear_dng_is_not_called_damaged_and_odd_tags_are_counted(
    tmp_path: Path, bayer_dng: Callable[..., Path]
) -> None:
    numbers = np.random.default_rng(0).integers(0, 4096, (32, 48)).astype(np.uint16)
    bayer_dng(tmp_path / "a.dng", numbers, noise_profile=(-1.0, 0.0))
    bayer_dng(tmp_path / "b.dng", np.stack([numbers] * 3, -1), cfa=None)
    (part,) = check(tmp_path).parts
    assert not part.broken
    (reason,) = part.unfit
    assert "b.dng" in reason and "linear DNG" in reason
    assert list(part.counts["tags that are not used"]) == ["NoiseProfile is out of range: -1, 0"]
