"""Maps of defects: two frames settle which sites are defective, and a map is what is replaced."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

import rawaug
from rawaug import cli
from rawaug.denoising.defects import mend_sites, read_defects, write_defects
from rawaug.io import RawFrame, read_raw, write_dng
from rawaug.io.cells import MONOCHROME

LEVELS = (1e-4, 1e-6)
HOT = [(20, 31), (21, 31), (20, 30), (40, 9)]
"""Three of these defects touch each other."""
DEAD = (50, 60)


def scene(seed: int, star: tuple[int, int] | None = None, cfa: str = "RGGB") -> RawFrame:
    generator = torch.Generator().manual_seed(seed)
    coarse = torch.rand(1, 1, 5, 7, generator=generator)
    clean = 0.2 + 0.3 * torch.nn.functional.interpolate(coarse, (96, 120), mode="bilinear")[0]
    if star is not None:
        clean[0, star[0], star[1]] = 0.9

    mosaic = clean + (LEVELS[0] * clean + LEVELS[1]).sqrt() * torch.randn(clean.shape, generator=generator)
    for row, column in HOT:
        mosaic[0, row, column] = 0.8 + 0.05 * seed
    mosaic[0, DEAD[0], DEAD[1]] = 0.01
    return RawFrame(mosaic, cfa, white=16383.0, name=f"scene{seed}")


def sites_of(mask: Tensor) -> set[tuple[int, int]]:
    return {(row, column) for row, column in mask.nonzero().tolist()}


@pytest.mark.parametrize("cfa", ["RGGB", "GBRG", "XTRANS"])
def test_what_stands_out_in_both_frames_is_a_defect_and_a_star_in_one_is_none(cfa: str) -> None:
    frames = [scene(0, star=(70, 80), cfa=cfa), scene(1, cfa=cfa)]
    assert sites_of(rawaug.find_defects(frames, LEVELS)) == {*HOT, DEAD}
    with pytest.raises(ValueError, match="two frames"):
        rawaug.find_defects(frames[:1], LEVELS)
    with pytest.raises(ValueError, match="sensor"):
        rawaug.find_defects([frames[0], RawFrame(frames[1].mosaic[:, :-2], cfa)], LEVELS)


def test_frames_of_one_scene_are_refused() -> None:
    mosaic = torch.rand(1, 96, 120, generator=torch.Generator().manual_seed(3))
    with pytest.raises(ValueError, match="different scenes"):
        rawaug.find_defects([RawFrame(mosaic, "RGGB"), RawFrame(mosaic.clone(), "RGGB")], (1e-8, 1e-10))


def test_a_map_comes_back_and_its_sites_are_replaced_by_their_neighbours(tmp_path: Path) -> None:
    frame = scene(0)
    mask = torch.zeros(96, 120, dtype=torch.bool)
    for row, column in [*HOT, DEAD]:
        mask[row, column] = True
    path = tmp_path / "mine.badpixels"
    write_defects(mask, path)
    assert path.read_text().splitlines()[1] == "30 20", "dcraw's column comes first"

    mended = mend_sites(frame, read_defects(path))
    changed = mended.mosaic != frame.mosaic
    assert torch.equal(changed[0], mask)
    assert mended.mosaic.max() < 0.6 and mended.mosaic.min() > 0.1

    path.write_text("5 7 1166000000  # dcraw's third word is when it died\n\n")
    assert read_defects(path).tolist() == [[7, 5]]
    path.write_text("120 7\n")
    with pytest.raises(ValueError, match="column 120"):
        mend_sites(frame, read_defects(path))
    path.write_text("5\n")
    with pytest.raises(ValueError, match="line 1"):
        read_defects(path)


def test_a_star_is_kept_and_a_defect_of_the_map_is_not(tmp_path: Path) -> None:
    star = (70, 80)
    frame = scene(0, star)
    path = tmp_path / "mine.badpixels"
    write_defects(rawaug.find_defects([frame, scene(1)], LEVELS), path)

    def denoised(defects: str | Path) -> Tensor:
        return rawaug.denoise(frame, denoiser="rawaug-small", noise=LEVELS, defects=defects).mosaic[0]

    mended, kept, mapped = denoised("mend"), denoised("keep"), denoised(path)
    assert mended[star] < 0.6 and mended[HOT[3]] < 0.6
    assert kept[star] == frame.mosaic[0][star] and kept[HOT[3]] == frame.mosaic[0][HOT[3]]
    assert mapped[star] == frame.mosaic[0][star]
    for site in [*HOT, DEAD]:
        assert 0.1 < mapped[site] < 0.6, site
    assert (kept - mended).abs().median() == 0.0


def test_a_map_is_of_monochrome_sensors_too(tmp_path: Path) -> None:
    frame = replace(scene(0), cfa=MONOCHROME)
    path = tmp_path / "mine.badpixels"
    write_defects(rawaug.find_defects([frame, replace(scene(1), cfa=MONOCHROME)], LEVELS), path)
    denoised = rawaug.denoise(frame, denoiser="Wavelet", noise=LEVELS, defects=path)
    assert denoised.cfa == MONOCHROME
    for site in [*HOT, DEAD]:
        assert 0.1 < denoised.mosaic[0][site] < 0.6, site


def test_the_command_writes_a_map_that_denoise_takes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    files = []
    for seed in (0, 1):
        write_dng(tmp_path / f"{seed}.dng", scene(seed))
        files.append(str(tmp_path / f"{seed}.dng"))
    path = str(tmp_path / "mine.badpixels")
    assert cli.main(["defects", *files, "--out", path, "--noise", "[1e-4, 1e-6]"]) in (None, 0)
    assert len(read_defects(path)) == len(HOT) + 1

    out = str(tmp_path / "out.dng")
    command = ["denoise", files[0], out, "--classical", "Wavelet", "--noise", "[1e-4, 1e-6]", "--defects", path]
    assert cli.main(command) in (None, 0)
    assert "5 defects of the map mended" in capsys.readouterr().out
    assert read_raw(out).mosaic[0][HOT[0]] < 0.6
