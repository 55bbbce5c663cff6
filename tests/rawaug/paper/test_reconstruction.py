"""The table: what its figures are the means of, what a fit may see, and what a stopped run finds again."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from rawaug.bayer import CFA
from rawaug.data.pairs import Pair
from rawaug.io import RawFrame
from rawaug.isp.fit import FitConfig
from rawaug.paper import reconstruction
from rawaug.paper.baselines import Training
from rawaug.paper.downstream import DownstreamConfig
from rawaug.paper.reconstruction import Comparison, compare

FrameOf = Callable[..., Pair]
TINY = FitConfig(steps=1, curve_steps=2, pixels=256, batch=64, prior_steps=20)


class Laboratory:
    """Stands in for fits and scores: frame k of n under seed s scores ``10 (k + 1) + s`` dB, and all is noted."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.frames = 8
        self.pairs: list[Pair] = []
        self.folds: list[tuple[str, str, tuple[float, int, int], int]] = []
        self.wholes: list[tuple[str, int]] = []
        self.denoisers: list[tuple[Path, int, str]] = []
        self.shown: list[tuple[str, str, str]] = []
        self.stop_after = 10**6
        self.cameras = self.min_side = 0
        stands_in = ("open_pairs", "open_pictures", "fit_family", "score_rows", "draw_frame", "cycle_psnr", "psnr_d")
        for name in stands_in:
            monkeypatch.setattr(reconstruction, name, getattr(self, name))

    def open_pairs(self, spec: str, split: str) -> list[Pair]:
        if self.pairs:
            return self.pairs
        srgb, raw = torch.zeros(3, 2, 2, dtype=torch.uint8), torch.zeros(1, 2, 2)
        return [Pair(f"f{k}", RawFrame(raw, CFA.RGGB), srgb) for k in range(self.frames)]

    def open_pictures(self, spec: str, min_side: int) -> list[torch.Tensor]:
        self.min_side = min_side
        return [torch.arange(192, dtype=torch.uint8).reshape(3, 8, 8)]

    def fit_family(
        self, family: str, pairs: Sequence[Pair], fit: FitConfig, training: Training, sizes: Any = None
    ) -> Any:
        seconds, seed = training.seconds or 0.0, training.seed
        names = [pair.name for pair in pairs]
        left_out = [f"f{k}" for k in range(self.frames) if f"f{k}" not in names]
        if not left_out:
            self.wholes.append((family, seed))
        else:
            if len(self.folds) == self.stop_after:
                raise KeyboardInterrupt
            self.folds.append((family, left_out[0], (seconds, training.crop, training.batch), seed))
        self.cameras += 1
        model = SimpleNamespace(info={"frames": names}, cfa=CFA.RGGB, number=self.cameras)
        return SimpleNamespace(model=model, seconds=seconds + len(self.folds) % 2, parameters=1234, seed=seed)

    def score_rows(self, fitted: Any, pair: Pair, patches: int | None, balanced: bool = False) -> dict[str, Any]:
        value = 10.0 * (int(pair.name[1:]) + 1) + fitted.seed
        rows = {"blind": value, "as-shot": value + 1}
        return {"rows": rows, "mpix_s": 2.0 ** int(pair.name[1:]), "forward": value - 5}

    def draw_frame(self, family: str, model: Any, pair: Pair, folder: Path) -> None:
        self.shown.append((family, pair.name, folder.name))

    def cycle_psnr(self, fitted: Any, pictures: Sequence[torch.Tensor]) -> dict[str, float]:
        return {"cycle": 33.0}

    def psnr_d(self, model: Any, pictures: Any, config: DownstreamConfig, folder: Path, seed: int, key: str) -> float:
        self.denoisers.append((folder, seed, key))
        return 40.0 + seed


@pytest.fixture
def laboratory(monkeypatch: pytest.MonkeyPatch) -> Laboratory:
    return Laboratory(monkeypatch)


def settings(folder: Path, **changes: Any) -> Comparison:
    return Comparison(**{"methods": ["dictionary"], "data": "known", "out": str(folder), "seeds": 2, **changes})


def test_every_figure_is_the_mean_that_its_name_says(laboratory: Laboratory, tmp_path: Path) -> None:
    rows = compare(settings(tmp_path))
    assert list(rows) == ["dictionary", "dictionary, as-shot gains"]
    row = rows["dictionary"]
    assert row["psnr_r"] == [45.0, 46.0]  # frames 10 ... 80 dB, one more under the second seed
    assert row["worst25"] == [15.0, 16.0] and row["best25"] == [75.0, 76.0]
    assert row["frames"] == {f"f{k}": [10.0 * (k + 1), 10.0 * (k + 1) + 1] for k in range(8)}
    assert rows["dictionary, as-shot gains"]["worst25"] == [16.0, 17.0]
    assert row["seconds"] == 20.5 and row["mpix_s"] == 12.0 and row["parameters"] == 1234
    assert row["forward"] == [40.0, 41.0] and "forward" not in rows["dictionary, as-shot gains"]
    assert row["cycle"] == 33.0 and "cycle" not in rows["dictionary, as-shot gains"]
    assert [frame for _, frame, _, seed in laboratory.folds if seed == 0] == [f"f{k}" for k in range(8)]
    assert laboratory.wholes == [("dictionary", 0)] and laboratory.denoisers == [] and laboratory.min_side == 2
    assert laboratory.shown == [("dictionary", "f0", "shown")], "the first frame, with the first seed"


def test_a_published_split_is_fitted_once_and_scored_on_every_test_frame(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    scored: list[Pair] = []
    test = [
        Pair(f"t{k}", RawFrame(torch.zeros(1, 6, 6), cfa), torch.zeros(3, 6, 6, dtype=torch.uint8))
        for k, cfa in enumerate((CFA.RGGB, CFA.BGGR, CFA.GRBG))
    ]

    class Split(Laboratory):
        def open_pairs(self, spec: str, split: str) -> list[Pair]:
            return test if spec == "blocks" else super().open_pairs(spec, split)

        def score_rows(self, fitted: Any, pair: Pair, patches: int | None, balanced: bool = False) -> dict[str, Any]:
            scored.append(pair)
            return {"rows": {"blind": 40.0 + int(pair.name[1:])}, "mpix_s": 1.0, "forward": None}

    laboratory = Split(monkeypatch)
    rows = compare(settings(tmp_path, test="blocks", methods=["dictionary"], seeds=1))
    assert laboratory.folds == [] and laboratory.wholes == [("dictionary", 0)], "one fit for all that is measured"
    assert rows["dictionary"]["frames"] == {"t0": [40.0], "t1": [41.0], "t2": [42.0]}
    assert {pair.cfa for pair in scored} == {CFA.RGGB} and scored[1].clean.mosaic.shape == (1, 4, 4)
    assert "3 frames of blocks" in capsys.readouterr().out
    with pytest.raises(ValueError, match=r"test: .*unseen"):
        compare(settings(tmp_path, test="known", name="other"))


def test_a_stopped_run_goes_on_from_its_files(laboratory: Laboratory, tmp_path: Path) -> None:
    laboratory.stop_after = 5
    with pytest.raises(KeyboardInterrupt):
        compare(settings(tmp_path))
    done = tmp_path / "reconstruction" / "dictionary-without-f2-seed0.json"
    figures = json.loads(done.read_text())
    assert figures["frames"] == [f"f{k}" for k in range(8) if k != 2]
    figures["rows"]["blind"] = 99.0
    done.write_text(json.dumps(figures))
    laboratory.stop_after = 10**6
    rows = compare(settings(tmp_path))
    assert len(laboratory.folds) == len(set(laboratory.folds)) == 16  # none fitted twice
    assert rows["dictionary"]["frames"]["f2"] == [99.0, 31.0]  # what the file says
    assert compare(settings(tmp_path)) == rows and len(laboratory.folds) == 16
    assert laboratory.wholes == [("dictionary", 0)]


@pytest.mark.parametrize(
    ("changes", "folds", "wholes"),
    [
        ({"seconds": 9.0}, 16, 1),
        ({"steps": 9}, 16, 1),
        ({"sizes": {"upi": {}}}, 0, 0),
        ({"balanced": True}, 16, 0),
        ({"picture_count": 1}, 0, 1),
        ({"crop": 32}, 16, 1),
        ({"batch": 1}, 16, 1),
        ({"patches": None}, 16, 0),
        ({"data": "other"}, 16, 1),
        ({"fit": FitConfig(steps=7)}, 16, 1),
        ({"seed": 1}, 8, 1),  # the second seed of the first run is there
        ({"seeds": 3}, 8, 1),
        ({"pictures": "other"}, 0, 1),
        ({"downstream": DownstreamConfig(methods=["dictionary"], noise="cycleisp_dnd")}, 0, 1),
        ({"methods": ["upi", "dictionary"]}, 16, 1),
        ({"name": "elsewhere"}, 16, 1),
    ],
)
def test_files_of_other_settings_are_not_used(
    changes: dict[str, Any], folds: int, wholes: int, laboratory: Laboratory, tmp_path: Path
) -> None:
    first = settings(tmp_path, downstream=DownstreamConfig(methods=["dictionary"]))
    compare(first)
    before = len(laboratory.folds), len(laboratory.wholes), set(laboratory.denoisers)
    compare(replace(first, **changes), overwrite=True)
    assert (len(laboratory.folds) - before[0], len(laboratory.wholes) - before[1]) == (folds, wholes)
    later = set(laboratory.denoisers[len(before[2]) :])
    if "seeds" in changes:  # the camera is the same: its denoisers are kept, and one is added
        assert before[2] < later and len(later) == 3
    elif wholes and "methods" not in changes:  # another camera's denoiser is not resumed from this one's checkpoint
        assert not before[2] & later


def test_frames_that_cannot_make_a_table_are_refused(laboratory: Laboratory, tmp_path: Path) -> None:
    laboratory.frames = 1
    with pytest.raises(ValueError, match="data:"):
        compare(settings(tmp_path))
    laboratory.frames = 3
    pairs = laboratory.open_pairs("", "")
    for odd, message in (
        (replace(pairs[1], registered=False), "f1 is not registered pixel by pixel; unet cannot share"),
        (replace(pairs[1], clean=replace(pairs[1].clean, cfa=CFA.BGGR)), "f1 has a different CFA"),
        (replace(pairs[1], name="f0"), "several frames are named f0"),
    ):
        laboratory.pairs = [pairs[0], odd, pairs[2]]
        with pytest.raises(ValueError, match=message):
            compare(settings(tmp_path, methods=["unet"]))
    assert laboratory.folds == []
