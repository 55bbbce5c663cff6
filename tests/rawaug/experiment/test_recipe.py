"""Recipes: how they are read, what is refused by name, and that what their headers say is there."""

from __future__ import annotations

import re
import shlex
from collections.abc import Callable
from pathlib import Path
from typing import Any, get_args

import pytest
import torch
from pydantic import TypeAdapter

from rawaug.cli import main
from rawaug.commands.run import with_values
from rawaug.experiment import run as experiment
from rawaug.experiment.recipe import EXPERIMENTS, find_kind, find_recipe, find_settings, kinds, read_recipe
from rawaug.experiment.settings import ArmConfig, DataConfig, ISPSource, NoiseSetting, Recipe
from rawaug.experiment.task import TASKS
from rawaug.isp.fit.samples import BLOCK
from rawaug.noise import noise_model
from rawaug.paper.baselines import BASELINES
from rawaug.paper.methods import FAMILIES, ROWS
from rawaug.paper.reconstruction import Comparison
from rawaug.plugin.draw import Draw
from rawaug.training.config import TrainConfig, Weighing

FOLDER = find_recipe("fewshot").parent
NAMES = [file.relative_to(FOLDER).with_suffix("").as_posix() for file in sorted(FOLDER.rglob("*.yaml"))]
OTHERS = {"pictures": "srgb", "rgb2raw": "reconstruction", "any": "mosaic", "demosaic": "rgb"}
"""These recipes have another kind than RAW, and are not named after it."""
HEAD = "isp: universal\ndata: {pairs: null, pictures: 'demo:'}\narms: {augmented: {augmented: 1.0}}\n"
LAUGHS = "a0: &a0 [ha, ha]\n" + "".join(f"a{k}: &a{k} [*a{k - 1}, *a{k - 1}, *a{k - 1}]\n" for k in range(1, 40))


def header(name: str) -> str:
    """The comment that a recipe opens with, a command's broken line joined."""
    lines = find_recipe(name).read_text().splitlines()
    head = "\n".join(lines[: next(k for k, line in enumerate(lines) if not line.startswith("#"))])
    return re.sub(r" *\\\n# +", " ", head)


def test_every_kind_has_settings_that_name_it() -> None:
    assert set(TASKS) == {"raw", "rgb", "mosaic", "srgb"}
    assert set(EXPERIMENTS) == {"reconstruction", "ablation", "paper"}
    for name in TASKS:
        assert find_settings(name).kind == name and TASKS[name].settings is find_settings(name)
    for name in ("reconstruction", "ablation"):
        assert find_settings(name)().name == name


@pytest.mark.parametrize("name", NAMES)
def test_the_commands_of_a_header_can_be_given(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    last = name.rpartition("/")[2]
    kind = find_kind(read_recipe(find_recipe(name)))
    assert kind == (last if last in kinds() else OTHERS.get(name, "raw"))
    given: list[Any] = []

    for name_of_function in ("run_kind", "dry_run"):
        monkeypatch.setattr(experiment, name_of_function, lambda kind, settings, overwrite: given.append(settings))
    head = header(name)
    commands = re.findall(r"^#   rawaug (run [^\n]+?)(?:  +\S.*)?$", head, re.MULTILINE)
    assert len(commands) >= 3 and any("--dry-run" in command for command in commands)
    assert kind != "raw" or ("--seeds 3" in head and re.search(r"about \d+ (minutes|hours)", head)), "the cost"
    for command in commands:
        assert shlex.split(command)[1] == name
        assert main(shlex.split(command)) == 0
    assert len(given) == len(commands) and given[0].name == name


def test_the_reconstruction_header_lists_methods_rows_and_budgets() -> None:
    head = header("reconstruction")
    (named,) = re.findall(r"--methods '\[(.*?)\]'", head)
    assert set(named.split(", ")) <= set(FAMILIES) and {"dictionary", "dictionary-encoders"} < set(named.split(", "))
    assert set(named.split(", ")) & set(BASELINES) >= {"upi", "upi-tuned", "unet", "cycleisp"}
    assert "fills three rows: blind" in head
    for row in (ROWS["as-shot"], ROWS["samples"]):
        assert row in head
    assert f"at {BLOCK} times lower resolution" in header("ablation")
    keys = set(Comparison.__dataclass_fields__)
    assert set(re.findall(r"`(\w+)`", find_recipe("reconstruction").read_text())) <= keys


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        ("experiment: reconstruktion", r"'reconstruktion'.*ablation"),
        ("experiment: [ablation]", r"\['ablation'\]"),
        ("experiment: [ablation", "not a recipe"),
        ("just words", "keys and values"),
        (LAUGHS, r"uses aliases \(\*name\)"),
        ("denoiser: {settings: {width: " + "[" * 48 + "1" + "]" * 48 + "}}", "nested"),
        ("x: " + "[" * 20_000, "nested"),
        ("train: {steps: " + "9" * 5000 + "}", "Exceeds the limit"),
        ("x: " + "y" * 2**20, "1048579 bytes"),
    ],
)
def test_what_is_no_recipe_ends_in_one_line_with_its_name(content: str, reason: str, tmp_path: Path) -> None:
    file = tmp_path / "mine.yaml"
    file.write_text(content)
    with pytest.raises(ValueError, match=rf"mine\.yaml: {reason}|mine\.yaml: .*{reason}") as error:
        find_kind(read_recipe(file), file)
    assert "\n" not in str(error.value) and len(str(error.value)) < 500


def test_a_recipe_that_names_no_kind_trains_and_bytes_are_none(tmp_path: Path) -> None:
    mine = tmp_path / "mine.yaml"
    for content in ("name: x\n", ""):
        mine.write_text(content)
        assert find_kind(read_recipe(mine)) == "raw"
    mine.write_bytes(b"\xff\xfe\x00\x81")
    with pytest.raises(ValueError, match=r"mine\.yaml"):
        read_recipe(mine)


@pytest.mark.parametrize(
    ("line", "named"),
    [
        ("train: {loss: null}", r"train\.loss"),
        ("train: {steps: 1e25}", r"train\.steps"),
        ("train: null", "train"),
        ("data: 5", "data"),
        ("fit: {steps: 1e25}", "steps"),
        ("seed: 1e25", "seed"),
        ("denoiser: {settings: {scales: 1000000000}}", "scales"),
        ("denoiser: {settings: {width: 1e29}}", "width"),
        ("denoiser: {settings: null}", r"denoiser\.settings"),
        ("data: {pairs: null, pictures: []}", r"data\.pictures"),
        ("device: null", "device"),
        ("arms: null", "arms"),
        ("arms: {augmented: {augmented: 1.0, estimator: null}}", "estimator"),
        ("arms: {augmented: {augmented: null}}", r"arms\.augmented\.augmented"),
        ("experiment: reconstruction\nmethods: null", "methods"),
    ],
)
def test_null_or_a_setting_that_nobody_means_is_named(
    line: str, named: str, tmp_path: Path, refused: Callable[..., str]
) -> None:
    head = "".join(kept for kept in HEAD.splitlines(True) if kept.partition(":")[0] != line.partition(":")[0])
    (tmp_path / "a.yaml").write_text(f"{line}\n" if "experiment" in line else f"{head}{line}\n")
    text = refused("run", tmp_path / "a.yaml", "--out", tmp_path)
    assert re.search(named, text)


@pytest.mark.parametrize("name", ["noisier", "noise2noise", "r2r", "neighbor2neighbor"])
def test_a_weighing_that_moves_the_mean_of_noisy_targets_is_refused(name: str) -> None:
    unbiased = ["linear"] if name == "neighbor2neighbor" else ["linear", "normalised"]
    for weigh in get_args(Weighing):
        given: dict[str, Any] = {"own": ArmConfig(1.0, estimator=name, weigh=weigh)}
        for arms, train in (
            (given, TrainConfig()),
            ({"own": ArmConfig(1.0, estimator=name)}, TrainConfig(weigh=weigh)),
        ):
            if weigh in unbiased:
                Recipe(arms=arms, train=train)
                continue
            with pytest.raises(ValueError, match=f"arms.own: weigh: {weigh} .*{name}"):
                Recipe(arms=arms, train=train)


def test_on_and_off_are_words_and_truth_values_stay(tmp_path: Path) -> None:
    content = "fit: {encoders: on, shading: off, attention: true}\nself_ensemble: off\narms: {real: {}}\n"
    (tmp_path / "mine.yaml").write_text(content)
    recipe = with_values(find_settings("raw"), read_recipe(tmp_path / "mine.yaml"), "mine")
    assert (recipe.fit.encoders, recipe.fit.shading) == ("on", "off")
    assert recipe.fit.attention is True and recipe.self_ensemble is False


def test_null_is_taken_where_the_types_have_it() -> None:
    content = {"isp": "universal", "steps": None, "arms": {"real": {"denoiser": None}}}
    recipe = with_values(find_settings("raw"), content, "mine")
    assert recipe.steps is None and recipe.network("real") == recipe.denoiser
    for key in ("data", "fit", "train", "arms", "device", "seed", "out", "views", "noise"):
        with pytest.raises(ValueError, match=f"^mine: {key}.* got None"):
            with_values(find_settings("raw"), {key: None}, "mine")
    with pytest.raises(ValueError, match=r"^mine: .*denoiser"):
        with_values(find_settings("raw"), {"arms": {"real": {"denoiser": {"name": None}}}}, "mine")


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--isp", "univerzal"], "univerzal: not found"),
        (["--isp.camera", "Nikon D75O"], r"Nikon D75O.*similar: Nikon D750"),
        (["--isp", "gopro-hero", "--isp.camera", "Nikon D750"], "camera: needs an ISP with published cameras"),
        (["--isp.camera", "Nikon D750", "--isp.iso", "800", "--noise", "[1e-3, 1e-5]"], "isp.iso: "),
        (["--isp.kamera", "Nikon D750"], r"isp\.kamera: no such key \(nearest: isp\.camera\)"),
    ],
)
@pytest.mark.parametrize("dry", [[], ["--dry-run"]])
def test_a_mistyped_isp_or_camera_is_refused_before_any_frame_is_read(
    words: list[str], said: str, dry: list[str], unread: str, tmp_path: Path, refused: Callable[..., str]
) -> None:
    command = ["run", "synthetic", "--data.test", unread, "--data.pictures", unread, "--out", tmp_path]
    assert re.search(said, refused(*command, *words, *dry))


def test_the_noise_of_a_camera_is_at_the_iso_of_the_isp() -> None:
    arms = {"a": ArmConfig(1.0), "b": ArmConfig(1.0, draw=Draw(sampling="chosen"))}
    data = DataConfig(pairs=None)
    camera = ISPSource(camera="Nikon D750", iso=800, draw=Draw(light="A"))
    recipe = Recipe(arms=arms, data=data, isp=camera, noise="Nikon D750")
    assert recipe.noise_at_iso == {"name": "Nikon D750", "settings": {"iso": 800}} and recipe.draw.light == "A"
    assert camera.load().info["cameras"] == ["Nikon D750"]
    assert camera.load().info["key"] != ISPSource().load().info["key"]
    assert Recipe(arms=arms, data=data, isp=ISPSource()).noise_at_iso == "cycleisp_sidd"


def test_the_noise_of_a_recipe_may_be_several_cameras_at_an_iso_of_their_own() -> None:
    phone = {"name": "Motorola Nexus 6", "iso": 3200}
    noise = TypeAdapter(NoiseSetting).validate_python(["any camera", phone])
    drawn = noise_model(noise).sample(64, torch.Generator().manual_seed(0))["shot_var"]
    assert torch.isclose(drawn, torch.tensor(0.013773)).sum() in range(16, 49)
