"""The kinds of experiment: a recipe names its own, and what its header says is there."""

from __future__ import annotations

import re
import shlex
from functools import cache
from pathlib import Path
from typing import Any

import pytest
import yaml

from rawaug.cli import _parser
from rawaug.commands.spelling import require_known_keys, require_known_options
from rawaug.experiment.kinds import kind_named, kind_of, quickly
from rawaug.experiment.plain_yaml import read_yaml
from rawaug.experiment.recipe import ArmConfig, DataConfig, Recipe, find_recipe
from rawaug.isp.fit.samples import BLOCK
from rawaug.paper.ablation import Ablation
from rawaug.paper.baselines import BASELINES
from rawaug.paper.methods import FAMILIES, ROWS
from rawaug.paper.reconstruction import Comparison
from rawaug.registry import EXPERIMENTS
from rawaug.training.config import TrainConfig

FOLDER = find_recipe("fewshot").parent
NAMES = [file.relative_to(FOLDER).with_suffix("").as_posix() for file in sorted(FOLDER.rglob("*.yaml"))]


OTHERS = {"rgb2raw": "reconstruction"}
"""Recipes that neither train nor are named after their kind."""


@cache
def parsers_of(kind: str) -> tuple[Any, dict[str, Any]]:
    """The command line, and the parser of ``run`` for recipes of this kind."""
    return _parser(kind, ["run"])


def header(name: str) -> str:
    """The comment that a recipe opens with, a command's broken line joined."""
    lines = find_recipe(name).read_text().splitlines()
    head = "\n".join(lines[: next(k for k, line in enumerate(lines) if not line.startswith("#"))])
    return re.sub(r" *\\\n# +", " ", head)


def test_every_kind_has_settings_that_name_it() -> None:
    assert set(EXPERIMENTS) == {"training", "reconstruction", "ablation", "learned", "denoisers"}
    for name in ("reconstruction", "ablation", "learned", "denoisers"):
        assert kind_named(name).settings().experiment == kind_named(name).settings().name == name


@pytest.mark.parametrize("name", NAMES)
def test_a_recipe_is_of_the_kind_that_it_names(name: str) -> None:
    last = name.rpartition("/")[2]
    expected = last if last in EXPERIMENTS else OTHERS.get(name, "training")
    assert kind_of(find_recipe(name)) == expected
    parser, commands = parsers_of(expected)
    require_known_keys(name, read_yaml(find_recipe(name)), commands["run"])
    assert parser.parse_args(["run", "--recipe", str(find_recipe(name))]).run.name == name


@pytest.mark.parametrize("name", NAMES)
def test_the_commands_of_a_header_can_be_given(name: str) -> None:
    commands = re.findall(r"^#   (rawaug run [^\n]+?)(?:  +\S.*)?$", header(name), re.MULTILINE)
    assert len(commands) >= 3 and any("--smoke" in command for command in commands)
    parser, parsers = parsers_of(kind_of(find_recipe(name)))
    for command in commands:
        _, _, named, *rest = shlex.split(command)
        assert named == name
        require_known_options("run", parsers["run"], rest)
        given = parser.instantiate(parser.parse_args(["run", "--recipe", str(find_recipe(name)), *rest])).run
        kind = kind_named(kind_of(find_recipe(name)))
        recipe = kind.settings(**{key: getattr(given, key) for key in kind.settings.__dataclass_fields__})
        assert not given.smoke or kind.smoke(recipe).name.endswith("-smoke")


def test_smoke_replaces_no_data_in_silence(capsys: pytest.CaptureFixture[str]) -> None:
    data = DataConfig(pairs="mine", test="others", count=3)
    recipe = Recipe(data=data, train=TrainConfig(steps=9), devices=2, arms={"real": ArmConfig()})
    for key in ("data.pairs", "data.test"):
        with pytest.raises(ValueError, match=rf"^--{key}: --smoke runs on built-in data; .* with --dry-run"):
            quickly("training", recipe, {key, "smoke"})
    with pytest.raises(ValueError, match=r"^--data: --smoke runs on built-in data"):
        quickly("ablation", Ablation(data="mine"), {"data"})
    assert quickly("training", recipe, {"train.steps", "devices", "data.count", "seed", "arms.real"}).train.steps == 4
    assert capsys.readouterr().out == "--smoke sets data.count to 1, devices to 1, train.steps to 4\n"


def test_the_reconstruction_header_lists_methods_rows_and_budgets() -> None:
    head = header("reconstruction")
    (named,) = re.findall(r"--methods '\[(.*?)\]'", head)
    assert set(named.split(", ")) <= set(FAMILIES) and {"dictionary", "dictionary-encoders"} < set(named.split(", "))
    assert set(named.split(", ")) & set(BASELINES) >= {"upi", "upi-tuned", "unet", "cycleisp", "invisp"}
    assert len(ROWS) == 3 and "fills four rows: blind" in head
    for row in ROWS.values():
        assert row in head
    keys = set(Comparison.__dataclass_fields__)
    assert set(re.findall(r"`(\w+)`", find_recipe("reconstruction").read_text())) <= keys


def test_the_ablation_header_gives_the_block_size() -> None:
    assert f"at {BLOCK} times lower resolution" in header("ablation")


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (
            b"experiment: reconstruktion\n",
            r"experiment 'reconstruktion' is unknown; use one of .*\(nearest: reconstruction\)",
        ),
        (
            b"experiment: [ablation]\n",
            r"experiment .*\['ablation'\].* is unknown; use one of ablation,",
        ),
        (b"experiment:\n", "experiment 'None' is unknown; use one of ablation,"),
        (b"experiment: [ablation\n", "not a YAML file .*see the recipes"),
        (b"\xff\xfe\x00\x81", "not a YAML file .*see the recipes"),
    ],
)
def test_what_names_no_kind_is_refused_by_the_files_name(content: bytes, message: str, tmp_path: Path) -> None:
    (tmp_path / "mine.yaml").write_bytes(content)
    with pytest.raises(ValueError, match=r"(?s)mine\.yaml: " + message):
        kind_of(tmp_path / "mine.yaml")


def test_a_recipe_that_names_no_kind_trains(tmp_path: Path) -> None:
    for content in ("name: x\n", "", "just words\n"):
        (tmp_path / "mine.yaml").write_text(content)
        assert kind_of(tmp_path / "mine.yaml") == "training"
    with pytest.raises(FileNotFoundError, match=r"gone\.yaml"):
        kind_of(tmp_path / "gone.yaml")


@pytest.mark.parametrize(("text", "key"), [("data: 5", "data"), ("train:", "train"), ("isp: [1]", "isp")])
def test_a_section_that_is_none_is_refused(text: str, key: str) -> None:
    _, commands = parsers_of("training")
    with pytest.raises(ValueError, match=rf"mine.yaml: {key}: must have keys below it, such as {key}\.\w+, got"):
        require_known_keys("mine.yaml", yaml.safe_load(text), commands["run"])


def test_null_where_a_number_or_a_list_belongs_is_refused() -> None:
    with pytest.raises(ValueError, match="augmented must be between 0 and 1, got None"):
        ArmConfig(augmented=None)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="methods: none; choose from"):
        Comparison(methods=None)  # type: ignore[arg-type]
