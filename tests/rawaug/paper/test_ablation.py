"""What each stage is worth, in the order of the pass."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import pytest
import torch
from skimage.color import rgb2yuv

from rawaug import bayer
from rawaug.data.pairs import Pair
from rawaug.isp.config import POINTWISE_STAGES
from rawaug.isp.fit import FitConfig, fit_isp
from rawaug.isp.model import DictionaryISP
from rawaug.paper import ablation
from rawaug.paper.ablation import (
    LEFT_OUT,
    SPACES,
    TITLES,
    Ablation,
    ablate,
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
    raw = bayer.demosaic(pair.clean.mosaic[None], pair.cfa)[0][picked].double()
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
    with pytest.raises(ValueError, match="data:"):
        ablate(Ablation(data="given:"))
