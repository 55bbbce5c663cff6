"""Development for the eye and what is shown: neutral grey stays grey, panels share one exposure."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from rawaug import bayer
from rawaug.bayer import CFA
from rawaug.data.development import develop_packed, exposure_gain
from rawaug.data.pairs import Pair
from rawaug.evaluation.figures import Panels, save_picture
from rawaug.evaluation.tables import mean_and_spread, print_table
from rawaug.evaluation.trials import raw_trial
from rawaug.evaluation.verdict import verdict
from rawaug.io import RawFrame


@pytest.fixture
def grey_pair() -> Pair:
    """A grey card under a light for which the camera needs gains of 2 and 1.6."""
    light = 0.4 / torch.tensor([2.0, 1.0, 1.6])
    raw = bayer.mosaic(light[:, None, None].expand(3, 32, 32), "GBRG")
    srgb = torch.zeros(3, 32, 32, dtype=torch.uint8)
    matrix = torch.tensor([[1.6, -0.5, -0.1], [-0.2, 1.5, -0.3], [0.0, -0.5, 1.5]])
    return Pair("grey", RawFrame(raw, CFA.GBRG, white_balance=(2.0, 1.0, 1.6), color_matrix=matrix), srgb)


def test_grey_is_developed_to_grey_and_the_brightest_near_white(grey_pair: Pair) -> None:
    packed = bayer.pack(grey_pair.clean.mosaic[None], "GBRG")
    panel = develop_packed(packed, CFA.GBRG, grey_pair)
    torch.testing.assert_close(panel, panel[:1].expand(3, 32, 32), atol=1e-5, rtol=0)
    assert panel.mean().item() == pytest.approx(0.665, abs=0.002)  # the sRGB value of linear 0.4
    assert exposure_gain(packed, grey_pair) * 0.4 == pytest.approx(0.9, abs=1e-4)
    assert (
        exposure_gain(packed * 0, replace(grey_pair, clean=replace(grey_pair.clean, mosaic=0 * grey_pair.clean.mosaic)))
        < 1e4
    )


def test_the_figure_is_written(grey_pair: Pair, tmp_path: Path) -> None:
    packed = bayer.pack(grey_pair.clean.mosaic[None], "GBRG")
    trial = raw_trial(grey_pair, packed, packed, packed, None, CFA.GBRG)
    row = Panels(trial, {"noisy": packed, "clean": packed}, {"noisy": "20.00 dB", "clean": "grey"})
    assert save_picture([row], tmp_path / "new" / "figure.png").stat().st_size > 1000


def test_the_table_names_every_arm(capsys: pytest.CaptureFixture[str]) -> None:
    assert (mean_and_spread([40.123], 2), mean_and_spread([40.0, 41.0], 2)) == ("40.12", "40.50 ± 0.71")
    scores = {"psnr": 40.0, "ssim": 0.95, "psnr_noisy": 33.0, "ssim_noisy": 0.8, "images": []}
    print_table({"real": [{"plain": scores, "self_ensemble": {**scores, "psnr": 40.5}}]}, "title")
    text = capsys.readouterr().out
    assert "noisy input" in text and "33.00" in text and "real" in text and "40.50" in text


def with_own_noise(psnr: float, own_psnr: float, noisy_psnr: float, **more: float) -> dict[str, Any]:
    """A summary on references whose own noise is as strong as an error of ``own_psnr``."""
    share = 10.0 ** ((psnr - own_psnr) / 10.0)
    image = {"psnr": psnr, "psnr_noisy": noisy_psnr, "own_noise": share}
    return {"psnr": psnr, "own_noise": share, "images": [image, image], **more}


@pytest.mark.parametrize(
    ("mine", "other", "noisy", "use"),
    [
        (50.0, 48.0, 47.3, ""),  # more than a perfect denoiser, which scores 47.3
        (45.0, 48.0, 47.3, ""),  # so does the other
        (46.8, 46.0, 47.3, ""),  # less, but the lead may be kept noise
        (46.8, 43.0, 47.3, "mine"),  # no denoiser gains so much by keeping it
        (46.8, 46.0, 30.0, "mine"),  # strong noise hides that of the references
    ],
)
def test_nothing_is_recommended_where_the_references_noise_decides(
    mine: float, other: float, noisy: float, use: str
) -> None:
    results = {"mine": [{"plain": with_own_noise(mine, 47.3, noisy)}]}
    result = verdict(results, {"NLM": with_own_noise(other, 47.3, noisy)})
    assert result.use == use
    assert use or ("pairs:PATH" in result.sentence and "bin 4" in result.sentence)


@pytest.mark.parametrize(
    ("gain", "developed", "use"),
    [(0.11, -0.13, ""), (-0.3, 0.2, ""), (0.01, 0.4, ""), (0.11, 0.0, "mine"), (-0.3, -0.2, "NLM"), (0.0, 0.0, "NLM")],
)
def test_nothing_is_recommended_while_raw_and_developed_scores_disagree(
    gain: float, developed: float, use: str
) -> None:
    def scores(more: float, more_srgb: float) -> dict[str, Any]:
        image = {"psnr": 40.0 + more, "psnr_srgb": 30.0 + more_srgb}
        return {**image, "images": [image, image]}

    result = verdict({"mine": [{"plain": scores(gain, developed)}]}, {"NLM": scores(0.0, 0.0)})
    assert result.use == use and bool(use) == result.sentence.startswith("Use ")
