"""What each stage is worth, in the order of the pass; and the learned parts: what is fitted to what, scored on what."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
import torch
from skimage.color import rgb2yuv

from rawaug import bayer
from rawaug.data import PictureFolder
from rawaug.data.pairs import Pair
from rawaug.io import write_picture
from rawaug.isp.config import POINTWISE_STAGES
from rawaug.isp.fit import FitConfig, fit_isp
from rawaug.isp.model import DictionaryISP
from rawaug.paper import ablation
from rawaug.paper.ablation import (
    LEFT_OUT,
    SPACES,
    TITLES,
    Ablation,
    ComponentAblation,
    ablate,
    ablate_components,
    score,
    stage_psnr,
)

FrameOf = Callable[..., Pair]
LAMPS = (1.2, 1.0, 2.6)
TINY = FitConfig(steps=2, curve_steps=8, pixels=1024, batch=256, encoders="off", prior_steps=10)


def test_every_stage_of_the_true_camera_brings_the_image_nearer(known_camera: DictionaryISP, frame_of: FrameOf) -> None:
    rows = stage_psnr(known_camera, frame_of("daylight"), white_balance=False)
    assert rows[0] == rows[1]  # its tone is left as it is
    for space, curve in zip(SPACES, zip(*rows[1:], strict=True), strict=True):
        assert all(after > before for before, after in pairwise(curve)), space
    assert min(rows[-1]) > 60.0


def test_the_figures_are_psnr_in_rgb_y_and_uv(known_camera: DictionaryISP, frame_of: FrameOf) -> None:
    pair = frame_of("daylight")
    picked = (slice(None), slice(None, None, 4), slice(None, None, 4))
    x = (pair.srgb / 255.0)[picked].double()
    raw = bayer.demosaic(pair.raw[None], pair.cfa)[0][picked].double()
    yuv = torch.from_numpy(rgb2yuv((x - raw).numpy(), channel_axis=0))
    expected = [-10 * (part**2).mean().log10().item() for part in (x - raw, yuv[:1], yuv[1:])]
    assert stage_psnr(known_camera, pair, white_balance=False)[0] == pytest.approx(expected, abs=0.02)


def test_an_unregistered_pair_is_compared_over_blocks(known_camera: DictionaryISP, frame_of: FrameOf) -> None:
    pair = frame_of("daylight")
    shifted = replace(pair, srgb=pair.srgb.roll(2, -1), registered=False)
    rows = stage_psnr(known_camera, shifted, white_balance=True)
    assert rows[-1][0] > 40.0 > rows[-2][0]  # the mask shows; site by site the shift would be most of the error
    assert stage_psnr(known_camera, replace(shifted, registered=True), True)[-1][0] < 40.0


@pytest.fixture
def frames(frame_of: FrameOf, given: list[Pair]) -> list[Pair]:
    """Three shots, two of them in one light, which the ablation opens."""
    given.extend([frame_of("a"), frame_of("b", LAMPS), frame_of("c")])
    return given


def test_each_frame_is_measured_by_fits_on_the_others(
    frames: list[Pair], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    fits: list[tuple[str, set[str]]] = []
    blind: list[list[list[float]]] = []

    def fit(pairs: Sequence[Pair], config: FitConfig, progress: bool) -> DictionaryISP:
        lacking = set(POINTWISE_STAGES) - set(config.isp.get("stages", POINTWISE_STAGES))
        fits.append(("".join(pair.name for pair in pairs), lacking))
        assert config.seed == 4
        return fit_isp(pairs, config, progress)

    def curve(isp: DictionaryISP, pair: Pair, white_balance: bool) -> list[list[float]]:
        rows = stage_psnr(isp, pair, white_balance)
        blind.extend([] if white_balance else [rows])
        return rows

    monkeypatch.setattr(ablation, "fit_isp", fit)
    monkeypatch.setattr(ablation, "stage_psnr", curve)
    result = ablate(Ablation(data="given:", fit=TINY, seed=4, out=str(tmp_path)))
    expected: list[set[str]] = [set(), *({stage} for stage in LEFT_OUT)]
    assert fits == [(others, lacking) for others in ("bc", "ac", "ab") for lacking in expected]

    torch.testing.assert_close(torch.tensor(result["stages"]["blind"]), torch.tensor(blind).mean(0))
    without = result["without"]
    assert list(without) == ["none", *LEFT_OUT]
    assert all(without[stage] < without["none"] - 3.0 for stage in ("colour", "gains", "shading"))
    shapes = {given: (len(rows), {len(row) for row in rows}) for given, rows in result["stages"].items()}
    assert shapes == {"blind": (len(TITLES), {len(SPACES)}), "as-shot gains": (len(TITLES), {len(SPACES)})}
    assert result["stages"]["as-shot gains"][5][0] > result["stages"]["blind"][5][0] + 3.0
    folder, said = tmp_path / "ablation", capsys.readouterr().out
    assert json.loads((folder / "ablation.json").read_text()) == json.loads(json.dumps(result))
    assert (folder / "ablation.png").stat().st_size > 20_000
    assert all(f"{stage} {value:.2f}" in said for stage, value in without.items())


def test_one_frame_leaves_none_to_fit(given: list[Pair], frame_of: FrameOf) -> None:
    given.append(frame_of("a"))
    with pytest.raises(ValueError, match="data: given: has 1 frame; leave-one-out needs two or more"):
        ablate(Ablation(data="given:"))


LEARNED = FitConfig(encoders="on", joint_steps=0, steps=2, curve_steps=5, pixels=256, batch=64)
VARIANTS: dict[str, dict[str, Any]] = {"all parts": {}, "without encoders": {"encoders": "off", "consistency": 0.0}}


@pytest.fixture
def fits(monkeypatch: pytest.MonkeyPatch, known_camera: DictionaryISP) -> list[tuple[FitConfig, list[str]]]:
    """Fits that were asked for, each answered by the known camera."""
    asked: list[tuple[FitConfig, list[str]]] = []

    def fit(frames: Sequence[Pair], config: FitConfig, **_: Any) -> DictionaryISP:
        asked.append((config, [frame.name for frame in frames]))
        return known_camera

    def scored(isp: DictionaryISP, pair: Pair) -> dict[str, float]:
        config, names = asked[-1]
        assert pair.name not in names and pair.name.startswith("left-out")
        worth = 10.0 * int(pair.name.split("_")[1]) + (config.encoders == "on") + 0.1 * config.seed
        return {"psnr_r": 40.0 + worth, "as_shot": 50.0, "forward": 30.0, "cycle": 33.0}

    monkeypatch.setattr(ablation, "fit_isp", fit)
    monkeypatch.setattr(ablation, "score", scored)
    return asked


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Seven pictures, one of them too narrow for a frame."""
    (tmp_path / "pictures").mkdir()
    for k in range(7):
        picture = torch.full((3, 290, 300 if k == 3 else 450), 20 * k + 40).byte()
        write_picture(tmp_path / "pictures" / f"{k}.png", picture)
    return tmp_path


def settings(folder: Path, **changes: Any) -> ComponentAblation:
    given: dict[str, Any] = {
        "pictures": str(folder / "pictures"),
        "frames": 4,
        "left_out": 2,
        "seeds": 2,
        "out": str(folder),
    }
    return ComponentAblation(**{"fit": LEARNED, "variants": VARIANTS, **given, **changes})


def test_every_variant_of_a_seed_has_the_same_frames_and_is_scored_on_others(
    folder: Path, fits: list[tuple[FitConfig, list[str]]], capsys: pytest.CaptureFixture[str]
) -> None:
    rows = ablate_components(settings(folder))
    assert [(config.encoders, config.consistency, config.seed) for config, _ in fits] == [
        ("on", 1.0, 0), ("off", 0.0, 0), ("on", 1.0, 1), ("off", 0.0, 1),
    ]  # fmt: skip
    assert fits[0][1] == fits[1][1] and len(fits[0][1]) == 4
    assert rows["all parts"]["psnr_r"] == pytest.approx([46.0, 46.1])  # of 40 and 50 dB, 1 for encoders, 0.1 a seed
    assert rows["without encoders"]["worst25"] == pytest.approx([40.0, 40.1])
    stored = json.loads((folder / "learned" / "table.json").read_text())
    assert stored["rows"] == rows and stored["settings"]["frames"] == 4
    said = capsys.readouterr().out
    assert "46.05 ± 0.07" in said and "-1.00 ± 0.00" in said
    assert ablate_components(settings(folder)) == rows and len(fits) == 4, "nothing is fitted twice"
    ablate_components(settings(folder, fit=FitConfig(encoders="on", joint_steps=0, steps=3)), overwrite=True)
    assert len(fits) == 8


def test_too_few_pictures_and_unknown_keys_are_refused(folder: Path, fits: list[Any]) -> None:
    with pytest.raises(ValueError, match=r"has 6 of 288 x 448 or more, but frames and left_out together need 7"):
        ablate_components(settings(folder, frames=5))
    assert fits == [] and len(PictureFolder(folder / "pictures", 2)) == 7
    wrong = {"encodres": "nearest: encoders", "seed": "share its seed", "encoders": "must be auto", "attention": "bool"}
    for key, reason in wrong.items():
        with pytest.raises(ValueError, match=reason):
            settings(folder, variants={"mine": {key: "maybe"}})
    with pytest.raises(ValueError, match="must each be at least one"):
        settings(folder, variants={})


def test_scores_are_those_of_the_passes(known_camera: DictionaryISP, frame_of: FrameOf) -> None:
    known_camera.forward_encoders.gain.set_prior(torch.tensor([1.0, 0.0]))
    right = score(known_camera, frame_of("daylight"))
    assert right["psnr_r"] > 70.0 and right["as_shot"] > 70.0 and all(map(math.isfinite, right.values()))
    lamps = score(known_camera, frame_of("lamps", (1.2, 1.0, 2.6)))
    assert lamps["psnr_r"] < 32.0 < 70.0 < lamps["as_shot"]
    assert lamps["forward"] < right["forward"] - 3.0, "the forward pass is under its own choice of light"
