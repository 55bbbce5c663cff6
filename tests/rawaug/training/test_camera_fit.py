"""``rawaug fit``: what it is fitted to, what it only looks at, and how a stopped fit goes on."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import rawaug
from rawaug.cli import main
from rawaug.evaluation.psnr_r import psnr_r
from rawaug.files import write_tensors
from rawaug.io import read_picture, read_raw_and_develop, write_picture
from rawaug.isp.fit import descent
from rawaug.isp.fit.descent import Descent
from rawaug.isp.fit.samples import sample_pixels
from rawaug.isp.model import DictionaryISP

QUICK = ["--steps", "4", "--curve-steps", "10", "--pixels", "512", "--batch", "128", "--noise", "off"]
SETTINGS: dict[str, Any] = {"steps": 4, "curve_steps": 10, "pixels": 512, "batch": 128}
INTERRUPTED = 130

Shoot = Callable[..., Path]


@pytest.fixture
def shoot(tmp_path: Path, bayer_dng: Shoot) -> Shoot:
    """Writes a DNG of coarse random greys: ``shoot("folder/name.dng", side)``."""

    def write(name: str, side: int = 96) -> Path:
        file = tmp_path / name
        file.parent.mkdir(parents=True, exist_ok=True)
        rng = np.random.default_rng(sum(name.encode()))
        coarse = rng.uniform(200, 3000, (side // 8, side // 8))
        return bayer_dng(file, np.kron(coarse, np.ones((8, 8))).astype(np.uint16))

    return write


def fit(out: Path, *arguments: object) -> DictionaryISP:
    assert main(["fit", *map(str, arguments), "--out", str(out), "--overwrite", *QUICK]) == 0
    return DictionaryISP.from_pretrained(out)


def same(a: DictionaryISP, b: DictionaryISP) -> bool:
    first, second = a.state_dict(), b.state_dict()
    return set(first) == set(second) and all(torch.equal(first[key], second[key]) for key in first)


def test_files_and_folders_are_fitted_together(
    tmp_path: Path, shoot: Shoot, capsys: pytest.CaptureFixture[str]
) -> None:
    one, two = shoot("one.dng"), shoot("two.dng")
    shoot("more/b.dng"), shoot("more/deep/a.dng")
    out = tmp_path / "x.safetensors"
    isp = fit(out, one, tmp_path / "more", two)
    assert isp.info["frames"] == ["one", "b", "a", "two"]
    assert isp.info["data"] == [str(one), str(tmp_path / "more"), str(two)]
    assert f"{out}: fitted to 4 frames in {isp.info['seconds']} s" in capsys.readouterr().out
    by_hand = rawaug.fit([one, tmp_path / "more", two], progress=False, noise="off", **SETTINGS)
    assert same(isp, by_hand)
    assert not same(isp, fit(tmp_path / "y.safetensors", one, two))


def test_what_cannot_be_fitted_together_is_named(tmp_path: Path, shoot: Shoot, refused: Callable[..., str]) -> None:
    one, two, out = shoot("shots/one.dng"), shoot("shots/two.dng"), ["--out", tmp_path / "x.safetensors", *QUICK]
    (tmp_path / "link.dng").symlink_to(one)
    for words, said in (
        ((one, "demo:train"), "demo:train: a kind:path dataset cannot be combined"),
        ((one, tmp_path / "gone.dng"), "gone.dng"),
        ((one, "--held-out", tmp_path / "gone"), "gone"),
        *(((one, "--held-out", held), "one.dng is also fitted") for held in (one, two.parent, tmp_path / "link.dng")),
        ((two.parent, "--held-out", two), "two.dng is also fitted"),
        (("demo:train", "--held-out", "demo:train"), "train_00_astronaut is also fitted"),
    ):
        assert said in refused("fit", *words, *out)
    assert not (tmp_path / "x.safetensors").exists() and not list(tmp_path.glob("*.state"))


@pytest.mark.parametrize("side", [96, 264])
def test_held_out_frames_are_scored_and_leave_no_trace_in_the_fit(
    side: int, tmp_path: Path, shoot: Shoot, capsys: pytest.CaptureFixture[str]
) -> None:
    seen, unseen = [shoot("a.dng"), shoot("b.dng")], shoot("unseen.dng", side)
    alone = fit(tmp_path / "alone.safetensors", *seen)
    capsys.readouterr()
    watched = fit(tmp_path / "watched.safetensors", *seen, "--held-out", unseen)
    assert same(alone, watched) and watched.info["frames"] == ["a", "b"]
    scores = watched.info["held_out"]
    assert len(scores) == 2 and scores[0].keys() == scores[1].keys() == {"blind", "as_shot"}
    assert all(5.0 < value < 70.0 for value in scores[-1].values())
    said = capsys.readouterr().out
    assert f"{scores[-1]['blind']:.2f} dB blind, {scores[-1]['as_shot']:.2f} dB with" in said
    pair, isp = rawaug.data.RawFolder(unseen)[0], DictionaryISP.from_pretrained(tmp_path / "watched.safetensors")
    for known, key in enumerate(scores[-1]):  # the last score is that of the file
        assert scores[-1][key] == pytest.approx(psnr_r(isp, pair, white_balance=bool(known)), abs=0.006)
    assert "held_out" not in alone.info


def test_a_stopped_fit_goes_on_from_its_state_and_removes_it(
    tmp_path: Path, shoot: Shoot, monkeypatch: pytest.MonkeyPatch, refused: Callable[..., str]
) -> None:
    frames, out = [shoot("a.dng"), shoot("b.dng")], tmp_path / "x.safetensors"
    state = tmp_path / "x.safetensors.state"
    whole = fit(tmp_path / "whole.safetensors", *frames)
    kept, taken = Descent._keep, list[str]()

    def stop(tensors: dict[str, torch.Tensor], *rest: Any) -> None:
        write_tensors(tensors, *rest)
        if any(name.startswith("sRGB to RAW") for name in tensors):
            raise KeyboardInterrupt

    def noted(self: Descent, stage: str, *rest: Any) -> None:
        taken.append(stage)
        kept(self, stage, *rest)

    monkeypatch.setattr(descent, "write_tensors", stop)
    said = refused("fit", *frames, "--out", out, *QUICK, "--quiet", status=INTERRUPTED)
    assert "run the same command again to resume" in said and state.is_file() and not out.exists()
    stopped = state.read_bytes()
    monkeypatch.setattr(descent, "write_tensors", write_tensors)
    monkeypatch.setattr(Descent, "_keep", noted)
    assert same(fit(out, *frames), whole)
    assert taken and not {"curve", "sRGB to RAW"} & {*taken} and not state.exists()

    state.write_bytes(stopped)  # of other frames it is not used
    fit(out, frames[0])
    assert "curve" in taken and not state.exists()
    state.write_bytes(b"cut off")
    assert "x.safetensors.state" in refused("fit", *frames, "--out", out, "--overwrite", *QUICK)


def test_the_cameras_jpeg_is_taken_unless_it_is_refused(tmp_path: Path, shoot: Shoot) -> None:
    raw = shoot("shots/a.dng", 128)
    plain = fit(tmp_path / "x.safetensors", raw)
    rendering = read_raw_and_develop(raw)[1]
    write_picture(tmp_path / "shots" / "a.jpg", rendering // 2 + 60)  # not what LibRaw would make of it
    assert read_picture(tmp_path / "shots" / "a.jpg").shape == rendering.shape
    seen, scores = shoot("seen.dng", 128), []
    with_jpeg = fit(tmp_path / "x.safetensors", raw)
    without = fit(tmp_path / "x.safetensors", raw, "--no-camera-jpeg")
    assert same(without, plain) and not same(with_jpeg, plain)
    for jpeg in ("--camera-jpeg", "--no-camera-jpeg"):
        scores.append(fit(tmp_path / "x.safetensors", seen, "--held-out", raw, jpeg).info["held_out"])
    assert scores[0] != scores[1]
    assert same(rawaug.fit(raw, False, "off", camera_jpeg=False, **SETTINGS), plain)


def test_pairs_are_fitted_as_they_are() -> None:
    pairs, other = rawaug.data.demo_pairs("train", count=2), rawaug.data.demo_pairs("validation", count=1)
    no_matrix = replace(pairs[0], clean=replace(pairs[0].clean, color_known=False))
    assert sample_pixels([no_matrix], pixels=8, seed=0).shots[0].white_balance == pairs[0].clean.white_balance
    unknown = replace(no_matrix, clean=replace(no_matrix.clean, white_balance=(1.0, 1.0, 1.0)))
    with pytest.raises(ValueError, match=r"train_00_astronaut: .*balance"):
        rawaug.fit([unknown], progress=False, noise="off", **SETTINGS)
    isp = rawaug.fit(pairs, progress=False, noise="off", held_out=other, **SETTINGS)
    assert isp.info["frames"] == [pair.name for pair in pairs] and len(isp.info["held_out"]) == 2


def test_pairs_that_do_not_state_their_cfa_and_levels_are_fitted_by_given_ones(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], refused: Callable[..., str]
) -> None:
    folders, rng = [tmp_path / "fitted", tmp_path / "held"], np.random.default_rng(0)
    for folder in folders:
        folder.mkdir()
        numbers = np.kron(rng.uniform(100, 900, (12, 12)), np.ones((8, 8))).astype(np.uint16)
        colour: dict[str, Any] = {"white_balance": [2.0, 1.0, 1.5], "color_matrix": np.eye(3)}
        np.savez(folder / f"{folder.name}.npz", clean=numbers, noisy=numbers, **colour)
    given = ["--cfa", "GRBG", "--black", "64", "--white", "1023"]
    out, (fitted, held) = tmp_path / "mine.safetensors", (f"pairs:{folder}" for folder in folders)
    isp = fit(out, fitted, "--held-out", held, *given)
    assert isp.cfa == "GRBG" and isp.info["frames"] == ["fitted"] and "held-out" in capsys.readouterr().out
    assert "does not state its CFA" in refused("fit", fitted, "--out", out, "--overwrite", *QUICK, *given[2:])
    line = refused("fit", "demo:train", "--out", out, "--overwrite", *QUICK, "--cfa", "GRBG")
    assert "cfa" in line and "demo:" in line
    with pytest.raises(ValueError, match="PATH"):
        rawaug.fit(rawaug.data.demo_pairs("train", count=1), cfa="GRBG")


def test_frames_that_cannot_be_read_are_named_and_the_rest_is_fitted(
    tmp_path: Path, shoot: Shoot, capsys: pytest.CaptureFixture[str]
) -> None:
    shoot("shots/a.dng"), shoot("shots/c.dng"), shoot("seen/d.dng")
    (tmp_path / "shots" / "b.dng").write_bytes((tmp_path / "shots" / "a.dng").read_bytes()[:400])
    (tmp_path / "seen" / "e.dng").write_bytes(b"damaged")
    isp = fit(tmp_path / "x.safetensors", tmp_path / "shots", "--held-out", tmp_path / "seen")
    assert isp.info["frames"] == ["a", "c"] and len(isp.info["held_out"]) >= 1
    said = capsys.readouterr().out.splitlines()
    assert said[0] == "left out of the fit: 1 of 3 frames, unreadable" and "b.dng" in said[1]
    assert said[2] == "left out of held-out frames: 1 of 2 frames, unreadable" and "e.dng" in said[3]
    assert said[4].count("fitted to 2 frames") == 1
    whole = fit(tmp_path / "y.safetensors", tmp_path / "shots" / "a.dng", tmp_path / "shots" / "c.dng")
    assert same(isp, whole) and "unreadable" not in whole.info
    (tmp_path / "shots" / "a.dng").write_bytes(b"damaged")
    for noise in ("off", "on"):
        with pytest.raises(ValueError, match="none"):
            rawaug.fit(tmp_path / "shots" / "a.dng", progress=False, noise=noise, **SETTINGS)
