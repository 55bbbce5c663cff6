"""A fifth task is one file: the mean of a burst, trained, scored, shown and reported as every other task is."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from rawaug.cli import main

BURST = '''
"""RAW of a burst: the mean of several shots of a scene in, packed RAW out."""

from dataclasses import dataclass, replace
from typing import ClassVar

from rawaug.evaluation.trials import make_trials, make_trial
from rawaug.noise import noise_model
from rawaug.experiment.task import TASKS
from rawaug.experiment.raw import RawTask
from rawaug.experiment.settings import Recipe


@dataclass
class BurstRecipe(Recipe):
    """Denoisers of the mean of a burst.

    Args:
        shots: number of shots of a scene.
    """

    kind: ClassVar[str] = "burst"
    from_pictures: ClassVar[bool] = True
    shots: int = 4


@TASKS.register("burst")
class BurstTask(RawTask):
    """A mean of shots has a share of the variance of one."""

    settings = BurstRecipe

    def __init__(self, recipe, isp, frames):
        super().__init__(recipe, isp, frames)
        shot_var, read_var = recipe.noise
        self.noise = noise_model((shot_var / recipe.shots, read_var / recipe.shots))

    def test(self):
        def make(pair):
            clean = replace(pair, noisy=None)
            return make_trial(clean, self.noise, self.isp.cfa, condition=f"{self.recipe.shots} shots")

        return make_trials(self.frames["test"], make)
'''

RECIPE = """
experiment: burst
name: burst
isp: universal
data: {pairs: null, pictures: "tiny:", validation: null, test: "tiny:validation", test_count: 1}
denoiser: {name: UNet, settings: {width: 4, scales: 2}}
noise: [4.0e-3, 4.0e-5]
train: {steps: 2, batch: 2, crop: 32}
arms: {pictures: {augmented: 1.0}}
self_ensemble: false
device: cpu
"""


@pytest.mark.usefixtures("tiny")
def test_a_fifth_task_is_one_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "burst.py").write_text(BURST)
    (tmp_path / "burst.yaml").write_text(RECIPE)
    command = ["--import", str(tmp_path / "burst.py"), "run", str(tmp_path / "burst.yaml"), "--out", str(tmp_path)]
    assert main([*command[:4], "--keys"]) == 0
    assert "shots of a scene" in capsys.readouterr().out
    command += ["--isp.camera", "Nikon D750"]
    assert main(command) == main([*command, "--shots", "1", "--name", "one"]) == 0
    assert capsys.readouterr().out.count("universal as Nikon D750") == 2

    burst = json.loads((tmp_path / "burst" / "results.json").read_text())["4 shots"]
    single = json.loads((tmp_path / "one" / "results.json").read_text())["1 shots"]
    psnr = [table["results"]["pictures"][0]["plain"]["psnr_noisy"] for table in (burst, single)]
    assert psnr[0] == pytest.approx(psnr[1] + 6.02, abs=0.05), "a mean of four shots has a quarter of the variance"
    for name in ("picture.png", "report.html", "report_scores_4_shots.csv"):
        assert (tmp_path / "burst" / name).is_file()
