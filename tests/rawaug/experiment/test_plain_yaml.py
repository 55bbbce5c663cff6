"""Recipes of strangers: what would never end, or never fit, is one line that names the key."""

from __future__ import annotations

from pathlib import Path

import pytest

from rawaug.cli import main
from rawaug.experiment.plain_yaml import read_yaml

LAUGHS = "a0: &a0 [ha, ha]\n" + "".join(f"a{k}: &a{k} [*a{k - 1}, *a{k - 1}, *a{k - 1}]\n" for k in range(1, 40))
NESTED = "denoiser: {settings: {width: " + "[" * 5000 + "1" + "]" * 5000 + "}}"
HEAD = "camera: universal\ndata: {pairs: null, pictures: 'demo:'}\narms: {augmented: {augmented: 1.0}}\n"


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        (LAUGHS, r"a8\.\d: more than 20000 values"),
        (f"denoiser:\n  settings:\n{LAUGHS}".replace("\na", "\n    a"), r"denoiser\.settings\.a8\.\d: more than"),
        (NESTED, r"denoiser\.settings\.width\..*: nested more than 32 deep"),
        ("a: &a [1, *a]", r"a\.1: the alias \*a refers to nothing, or to itself"),
        ("train: {steps: " + "9" * 5000 + "}", "Exceeds the limit"),
        ("a: [", "not a YAML file"),
        ("x: " + "y" * 2**20, "has 1048579 bytes, a recipe at most 1048576"),
    ],
)
def test_what_no_recipe_is_ends_in_one_line(text: str, reason: str, tmp_path: Path) -> None:
    path = tmp_path / "bomb.yaml"
    path.write_text(text)
    with pytest.raises(ValueError, match=reason) as error:
        read_yaml(path)
    assert str(path) in str(error.value) and "\n" not in str(error.value) and len(str(error.value)) < 500


def test_aliases_that_are_few_are_read(tmp_path: Path) -> None:
    (tmp_path / "a.yaml").write_text("one: &one {width: 4}\ntwo: {<<: *one, scales: 2}\n")
    assert read_yaml(tmp_path / "a.yaml")["two"] == {"width": 4, "scales": 2}


@pytest.mark.parametrize(
    ("line", "named"),
    [
        ("train: {loss: null}", "loss"),
        ("train: {steps: 1e25}", "steps"),
        ("isp: {steps: 1e25}", "steps"),
        ("isp: {pixels: -1}", "pixels"),
        ("seed: 1e25", "seed"),
        ("seeds: 1000000000000", "seeds"),
        ("denoiser: {settings: {scales: 1000000000}}", "scales"),
        ("denoiser: {settings: {width: 1e29}}", "width"),
        ("arms: {augmented: {augmented: 1.0, estimator: null}}", "estimator"),
        ("arms: null", "arms"),
    ],
)
def test_a_setting_that_nobody_means_is_named(
    line: str, named: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    head = HEAD.replace("arms: {augmented: {augmented: 1.0}}\n", "") if line.startswith("arms") else HEAD
    (tmp_path / "a.yaml").write_text(f"{head}{line}\n")
    assert main(["run", str(tmp_path / "a.yaml"), "--out", str(tmp_path)]) == 2
    (text,) = capsys.readouterr().err.strip().splitlines()
    assert named in text
