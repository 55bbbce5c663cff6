"""What recipes name is there, an unknown key in any of them fails, and the two main ones run in small."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml
from torch import Tensor

import denoisers
from rawaug.cli import main
from rawaug.experiment.recipe import find_kind, find_recipe, read_recipe
from rawaug.experiment.settings import ArmConfig, DataConfig, ISPSource, Recipe
from rawaug.training.estimators import Supervised

FOLDER = Path(__file__).parents[1] / "recipes"
FILES = {file.relative_to(FOLDER).with_suffix("").as_posix(): file for file in sorted(FOLDER.rglob("*.yaml"))}
ALL = {name: find_kind(read_recipe(file)) for name, file in FILES.items()}
NAMES = [name for name, kind in ALL.items() if kind in ("raw", "srgb")]
"""The recipes that train denoisers."""


@pytest.fixture(params=NAMES)
def name(request: pytest.FixtureRequest) -> str:
    value: str = request.param
    return value


def test_the_papers_rows_name_recipes_and_tests_that_exist() -> None:
    page = (FOLDER.parent / "docs" / "compare.md").read_text(encoding="utf-8").partition("## The paper's tables")[2]
    named = set(re.findall(r"rawaug run (\S+?)[`\s]", page))
    assert named <= set(ALL) and {"sidd/full", "sidd/fewshot", "sidd/unsupervised", "sidd/reconstruction"} <= named
    assert {"fivek/reconstruction", "sidd/siddplus", "ablation", "rgb2raw"} <= named
    tests = {file.name for file in Path(__file__).parent.rglob("test_*.py")}
    found = set(re.findall(r"`(test_\w+\.py)`", page))
    assert len(found) > 20 and found <= tests, found - tests


def test_an_unknown_key_is_named(name: str, tmp_path: Path, refused: Callable[..., str]) -> None:
    text, mine = find_recipe(name).read_text(), tmp_path / "mine.yaml"
    for place, bogus, said in (
        ("train:\n", "train:\n  stepz: 3\n", "mine.yaml: train.stepz: no such key (nearest: train.steps)"),
        ("name:", "nmae: x\nname:", "mine.yaml: nmae: no such key"),
    ):
        assert place in text
        mine.write_text(text.replace(place, bogus, 1))
        assert said in refused("run", mine)


SMALL = [
    "--train.validate-every", "1", "--train.batch", "4", "--train.crop", "32", "--data.test-count", "1", "--data.count",
    "2", "--data.pictures", "tiny:", "--data.test", "tiny:test", "--data.validation-crop", "64", "--fit.steps", "2",
    "--fit.curve-steps", "10", "--fit.prior-steps", "10", "--fit.pixels", "512", "--denoiser.settings",
    '{"width": 4, "scales": 2}', "--classical", "[]", "--steps", "2", "--device", "cpu",
]  # fmt: skip
"""A recipe in seconds."""


@pytest.mark.usefixtures("tiny")
@pytest.mark.parametrize("name", ["fewshot", "unsupervised"])
def test_it_runs(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["run", name, *SMALL, "--baselines", "[]", "--out", str(tmp_path)]) == 0
    arms = yaml.safe_load(find_recipe(name).read_text())["arms"]
    (folder,) = tmp_path.iterdir()
    results = json.loads((folder / "results.json").read_text())
    assert set(results["results"]) == set(arms)
    text = capsys.readouterr().out
    for arm in arms:
        (scores,) = results["results"][arm]
        assert 10.0 < scores["plain"]["psnr"] < 60.0 and 10.0 < scores["self_ensemble"]["psnr_srgb"] < 60.0
        assert arm[:8] in text
    assert (folder / "report.html").stat().st_size > 30_000


@pytest.mark.usefixtures("tiny")
def test_a_published_camera_is_trained_for(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    camera = ["--isp.camera", "Nikon D750", "--isp.iso", "800", "--noise", "Nikon D750"]
    small = [*SMALL, "--arms", "convex", "--baselines", "[]", "--self-ensemble", "false", "--out", str(tmp_path)]
    assert main(["run", "synthetic", *small, *camera]) == 0
    assert "ISP       universal as Nikon D750" in capsys.readouterr().out
    _, info = denoisers.load(tmp_path / "synthetic" / "seed0" / "convex" / "denoiser.safetensors")
    assert info["noise"] == {"name": "Nikon D750", "settings": {"iso": 800}}

    assert main(["run", "synthetic", *small, *camera[:1], "Canon EOS 5D", "--overwrite"]) == 0
    assert "already trained" not in capsys.readouterr().out, "the camera decides the weights"


@pytest.mark.usefixtures("tiny")
def test_a_dry_run_takes_every_arm_through_a_step_and_writes_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], refused: Callable[..., str], monkeypatch: pytest.MonkeyPatch
) -> None:
    steps: list[int] = []
    loss = Supervised.loss

    def counted(*given: Any) -> Tensor:
        steps.append(1)
        return loss(*given)

    monkeypatch.setattr(Supervised, "loss", counted)
    command = ["run", "synthetic", *SMALL, "--seeds", "3", "--baselines", "[]", "--out", str(tmp_path), "--dry-run"]
    assert main(command) == 0
    said = capsys.readouterr().out
    assert len(steps) == 2 and not list(tmp_path.iterdir())
    assert "test      1 of 2 of tiny:test" in said and said.endswith(f"nothing written to {tmp_path / 'synthetic'}\n")
    assert "gone" in refused(*command, "--baselines", "[gone]")


@pytest.mark.usefixtures("tiny")
def test_seeds_steps_and_device_work_and_nothing_is_done_twice(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    command = ["run", "synthetic", *SMALL, "--seed", "3", "--seeds", "2", "--out", str(tmp_path)]
    command += ["--arms", '{"convex": {"augmented": 1.0}}', "--baselines", "[]"]
    assert main(command) == 0
    results = json.loads((tmp_path / "synthetic" / "results.json").read_text())
    assert [len(runs) for runs in results["results"].values()] == [2]
    assert {path.name for path in (tmp_path / "synthetic").glob("seed*")} == {"seed3", "seed4"}
    assert results["recipe"]["train"]["steps"] == 2
    weights = tmp_path / "synthetic" / "seed3" / "convex" / "denoiser.safetensors"
    before = weights.stat().st_mtime_ns
    same_weights = ["--train.checkpoint-every", "1", "--data.memory-mb", "8", "--device", "auto"]
    same_weights += ["--self-ensemble", "false"]
    capsys.readouterr()
    assert main([*command, *same_weights]) == 0
    said = capsys.readouterr().out
    assert said.count("already trained") == said.count("already evaluated") == 2
    results = json.loads((tmp_path / "synthetic" / "results.json").read_text())
    assert [list(run) for run in results["results"]["convex"]] == [["plain"]] * 2, "what is not asked for is not shown"
    assert main([*command, *same_weights, "--data.test-count", "2", "--overwrite"]) == 0
    said = capsys.readouterr().out
    assert said.count("already trained") == 2 and "already evaluated" not in said
    assert weights.stat().st_mtime_ns == before
    monkeypatch.setattr(Supervised, "revision", 1)
    assert main([*command, "--seeds", "1", "--overwrite"]) == 0
    assert "already trained" not in capsys.readouterr().out, "another estimator of the same name"


def test_what_cannot_be_run_is_refused_before_anything_is_fitted(tmp_path: Path, refused: Callable[..., str]) -> None:
    arm = {"real": ArmConfig()}
    with pytest.raises(ValueError, match="arm"):
        Recipe()
    with pytest.raises(ValueError, match=r"data\.pairs: .*fitting"):
        Recipe(arms=arm, data=DataConfig(pairs=None))
    with pytest.raises(ValueError, match="cannot be mixed"):
        Recipe(arms={**arm, "r2r": ArmConfig(estimator="r2r")})
    with pytest.raises(ValueError, match="augmented: 1"):
        Recipe(arms=arm, data=DataConfig(pairs=None), isp=ISPSource())
    elsewhere = ["--out", str(tmp_path)]
    for flags in (["--steps", "0"], ["--train.batch", "0"], ["--train.crop", "63"], ["--train.checkpoint-every", "0"]):
        key = flags[0].removeprefix("--train.").removeprefix("--").replace("-", "_")
        assert key in refused("run", "fewshot", *elsewhere, *flags)
    wrong = {"noise": "Foo", "denoiser.settings": "{thickness: 3}", "classical": "[Median]"}
    for (key, value), said in zip(wrong.items(), ("noise 'Foo' is", "thickness", "'Median' is"), strict=True):
        assert said in refused("run", "fewshot", *elsewhere, f"--{key}", value)
    assert "sidd/full" in refused("run", "sidd/nothing")
