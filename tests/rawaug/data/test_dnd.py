"""DND in its published form, small: struct array and frames of version 7.3, submission of version 5."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from rawaug.bayer import CFA
from rawaug.commands.submit import submit_dnd
from rawaug.data import Dnd, open_pairs, write_dnd_submission
from rawaug.data.mat import read_value
from rawaug.denoising.denoiser import RawDenoiser

Writer = Callable[[Path, dict[str, Any]], Path]
CFAS = ("RGGB", "GBRG", "GRBG", "BGGR")


def frame(k: int) -> np.ndarray:
    return np.random.default_rng(k).random((20 + k % 3, 34)).astype(np.float32)


def info(k: int) -> dict[str, Any]:
    """An element of ``info``; boxes of 6 x 8 from (2 b + k % 2, 3) on, counted from 1."""
    pattern = np.array(["RGB".index(colour) + 1.0 for colour in CFAS[k % 4]]).reshape(2, 2)
    boxes = np.array([[1 + b // 2 + k % 2, 4 + b % 4, 6 + b // 2 + k % 2, 11 + b % 4] for b in range(20)], float)
    colour = {"AsShotNeutral": np.array([[0.5], [1.0], [0.8]]), "ColorMatrix2": np.eye(3).reshape(1, 9)}
    return {"boundingboxes": boxes, "camera": {"pattern": pattern, **colour}, "nlf": {"a": 1e-3 * (k + 1), "b": 1e-6}}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory, mat73: Writer) -> Path:
    folder = tmp_path_factory.mktemp("dnd")
    mat73(folder / "info.mat", {"info": [info(k) for k in range(50)]})
    for k in range(50):
        mat73(folder / "images_raw" / f"{k + 1:04d}.mat", {"Inoisy": frame(k)})
    return folder


def test_boxes_are_cut_where_the_kit_cuts_them(folder: Path) -> None:
    dnd = Dnd(folder)
    assert len(dnd) == 1000
    for index in (0, 19, 20, 21 * 20 + 7, 999):
        k, b = divmod(index, 20)
        top, left, bottom, right = info(k)["boundingboxes"][b].astype(int)
        crop = dnd[index]
        assert crop.name == f"{k + 1:04d}_{b + 1:02d}" and crop.mosaic.shape == (1, 6, 8)
        assert np.array_equal(crop.mosaic[0].numpy(), frame(k)[top - 1 : bottom, left - 1 : right])
        assert crop.noise_profile == pytest.approx((1e-3 * (k + 1), 1e-6))
        assert crop.white_balance == pytest.approx((2, 1, 1.25))


def test_patterns_are_matlabs_and_move_with_the_box(folder: Path) -> None:
    dnd = Dnd(folder)
    for k, name in enumerate(CFAS):
        assert dnd.frames[k][1] == CFA(name)
        top, left = (info(k)["boundingboxes"][0][:2] - 1).astype(int)
        assert dnd[20 * k].cfa == CFA(name).shift(top, left)


def test_the_submission_is_the_kits(folder: Path, tmp_path: Path) -> None:
    dnd = Dnd(folder)
    out = tmp_path / "bundled"
    write_dnd_submission(out, (crop.mosaic * 0.5 for crop in dnd))
    assert len(list(out.iterdir())) == 50
    cells = read_value(out / "0022.mat", "Idenoised")
    assert np.array_equal(cells[7], dnd[21 * 20 + 7].mosaic[0].numpy() * 0.5) and cells[7].dtype == np.float32
    assert int(read_value(out / "0022.mat", "israw")) == 1 and read_value(out / "0022.mat", "eval_version") == "1.0"


def test_the_command_denoises_every_box_by_its_frames_levels_and_clips(folder: Path, tmp_path: Path) -> None:
    seen: list[tuple[float, float]] = []

    def halved(levels: tuple[float, float] | None) -> Callable[..., torch.Tensor]:
        assert levels is not None
        seen.append(levels)
        return lambda noisy, variance: noisy * 0.5 - 0.01

    denoiser = RawDenoiser(name="halved", model=halved, tiles=None)
    submit_dnd(str(folder), str(tmp_path / "out"), denoiser)
    assert len(seen) == 1000
    assert seen[0] == (1e-3, 1e-6) and seen[21 * 20] == (0.022, 1e-6)
    box = read_value(tmp_path / "out" / "0022.mat", "Idenoised")[7]
    expected = (Dnd(folder)[21 * 20 + 7].mosaic[0].numpy() * 0.5 - 0.01).clip(0.0)
    assert np.allclose(box, expected, atol=1e-7)


def test_wrong_submissions_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="1000 boxes"):
        write_dnd_submission(tmp_path / "a", [torch.zeros(1, 6, 8)] * 3)
    for wrong in (torch.full((1, 6, 8), torch.nan), torch.full((1, 6, 8), 1.5), torch.zeros(6, 8)):
        with pytest.raises(ValueError, match="box 1"):
            write_dnd_submission(tmp_path / "a", [torch.zeros(1, 6, 8), wrong])


def test_what_is_missing_or_wrong_is_reported(tmp_path: Path, mat73: Writer) -> None:
    with pytest.raises(FileNotFoundError, match=r"info\.mat"):
        Dnd(tmp_path)
    mat73(tmp_path / "info.mat", {"info": [info(0), info(1)]})
    mat73(tmp_path / "images_raw" / "0001.mat", {"Inoisy": 1000 * frame(0)})
    with pytest.raises(FileNotFoundError, match=r"0002\.mat.*1 of 2"):
        Dnd(tmp_path)
    mat73(tmp_path / "images_raw" / "0002.mat", {"Inoisy": frame(1)[:5]})
    dnd = Dnd(tmp_path)
    with pytest.raises(ValueError, match=r"0001\.mat.*black"):
        dnd[0]
    with pytest.raises(ValueError, match=r"0002\.mat.*box 1"):
        dnd[20]
    mat73(tmp_path / "info.mat", {"info": [info(0), {**info(1), "nlf": {"a": 1.0}}]})
    with pytest.raises(ValueError, match=r"info\.mat: frame 2"):
        Dnd(tmp_path)


def test_there_are_no_pairs(folder: Path) -> None:
    with pytest.raises(ValueError, match="public"):
        open_pairs(f"dnd:{folder}")
