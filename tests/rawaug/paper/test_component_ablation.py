"""The ablation of the learned parts: what is fitted to what, scored on what, and found again."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
import torch

from rawaug.data import PictureFolder
from rawaug.data.pairs import Pair
from rawaug.io import write_picture
from rawaug.isp.fit import FitConfig
from rawaug.isp.model import DictionaryISP
from rawaug.paper import component_ablation as learned_parts
from rawaug.paper.component_ablation import ComponentAblation, ablate_components, score

FrameOf = Any
TINY = FitConfig(encoders="on", joint_steps=0, steps=2, curve_steps=5, pixels=256, batch=64)
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

    monkeypatch.setattr(learned_parts, "fit_isp", fit)
    monkeypatch.setattr(learned_parts, "score", scored)
    return asked


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Seven pictures, one of them too narrow for a frame."""
    (tmp_path / "pictures").mkdir()
    for k in range(7):
        write_picture(
            tmp_path / "pictures" / f"{k}.png", torch.full((3, 290, 300 if k == 3 else 450), 20 * k + 40).byte()
        )
    return tmp_path


def settings(folder: Path, **changes: Any) -> ComponentAblation:
    given: dict[str, Any] = {
        "pictures": str(folder / "pictures"),
        "frames": 4,
        "left_out": 2,
        "fit": TINY,
        "variants": VARIANTS,
    }
    return ComponentAblation(**{**given, "seeds": 2, "out": str(folder), **changes})


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
