"""The command line: each command on small input, and one line for each kind of bad input."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from functools import reduce
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
import torch

from denoisers.classical import FILTERS
from rawaug.cli import COMMANDS, app, main
from rawaug.commands.run import list_keys
from rawaug.data import demo_pictures
from rawaug.evaluation.benchmark import choose_strengths
from rawaug.experiment.recipe import find_settings, kinds
from rawaug.io import write_picture

QUICK_FIT = ["--steps", "4", "--curve-steps", "10", "--prior-steps", "10", "--pixels", "512", "--batch", "128"]
TINY = [
    "--data.pairs", "tiny:train", "--data.validation", "tiny:validation", "--data.test", "tiny:test",
    "--data.pictures", "tiny:",
]  # fmt: skip
QUICK_RUN = [
    *TINY, "--train.steps", "4", "--train.validate-every", "2", "--train.batch", "2", "--train.crop", "32",
    "--fit.steps", "2", "--fit.pixels", "512", "--fit.curve-steps", "10", "--fit.prior-steps", "10",
    "--denoiser.settings", '{"width": 4, "scales": 2}',
    "--classical", "[]", "--baselines", "[]",
]  # fmt: skip


def test_preview_draws_a_figure(tmp_path: Path, refused: Callable[..., str]) -> None:
    picture = tmp_path / "picture.png"
    write_picture(picture, demo_pictures(3)[2][:, 64:160, 64:192])
    command = ["preview", str(picture), "--out", str(tmp_path / "stages.png"), "--count", "2", "--cfa", "XTRANS"]
    assert main(command) == 0
    assert (tmp_path / "stages.png").stat().st_size > 10_000
    assert "gone.png" in refused("preview", tmp_path / "gone.png", "--out", tmp_path / "x.png")


@pytest.mark.long
@pytest.mark.usefixtures("tiny")
def test_run_is_resumable_and_ends_with_table_and_picture(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], refused: Callable[..., str], monkeypatch: pytest.MonkeyPatch
) -> None:
    arms = {"real": {"augmented": 0.0}, "augmented": {"augmented": 0.5}}
    command = ["run", "fewshot", *QUICK_RUN, "--out", str(tmp_path), "--arms", json.dumps(arms), "--views", "4"]
    place = tmp_path / "fewshot" / "seed0" / "real"

    def no_views(*_: object, **settings: object) -> None:
        raise ValueError("killed before the self-ensemble")

    with monkeypatch.context() as patch:
        patch.setattr("rawaug.denoising.denoiser.denoisers.SelfEnsemble", no_views)
        assert "killed before" in refused(*command, "--quiet")
    plain = json.loads((place / "plain.json").read_text())
    assert plain["tables"][""]["psnr"] > 20 and not (place / "self_ensemble.json").exists()  # written as it came
    assert main([*command, "--self-ensemble", "false"]) == 0
    listed = capsys.readouterr().out.strip().splitlines()
    results = json.loads((tmp_path / "fewshot" / "results.json").read_text())["results"]
    assert set(results) == set(arms) and not any("self_ensemble" in runs[0] for runs in results.values())
    assert (tmp_path / "fewshot" / "picture.png").stat().st_size > 10_000
    assert listed[-1].startswith("to use")  # after four steps the frames may be best as they are
    assert f"denoiser, real: {place / 'denoiser.safetensors'}" in listed
    assert any(line.startswith("Use ") for line in listed)
    before = (place / "denoiser.safetensors").stat().st_mtime_ns
    assert main(command) == 0
    text = capsys.readouterr().out
    assert text.count("already trained") == 2 and "evaluated real, seed 0, self_ensemble: " in text
    assert json.loads((place / "plain.json").read_text()) == plain
    assert json.loads((place / "self_ensemble.json").read_text())["tables"][""]["psnr"] > 20
    other = [*command, "--train.learning-rate", "0.002"]
    said = refused(*other)  # other settings are another run
    assert "holds a run with other settings (train.learning_rate 0.0007, now 0.002); give this run another" in said
    assert (place / "denoiser.safetensors").stat().st_mtime_ns == before
    one = ["--arms", json.dumps({"real": arms["real"]})]
    assert main([*other, *one, "--overwrite", "--self-ensemble", "false"]) == 0
    assert (place / "denoiser.safetensors").stat().st_mtime_ns != before


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("fit demo:train --out x.safetensors --learning-rat 1", "Did you mean --learning-rate?"),
        ("fit demo:train --out x.safetensors --pixels many", "Invalid value for --pixels: unable"),
        ("fit demo:train --out x.safetensors --tone curves", 'Invalid value "curves" for --tone'),
        ("fit demo:train", "--out"),
        ("data chek", 'Did you mean "check"?'),
        ("denoize a.dng", 'Unknown command "denoize". Did you mean "denoise"?'),
        ("denoise a.dng", "OUT"),
        ("denoise a b c", "['c']"),
        ("run fewshoot", "(nearest: fewshot)"),
        ("run fewshot x", "x: too many arguments"),
        ("run fewshot --seeds", "--seeds needs a value"),
        ("run fewshot --train.learning 1", "train.learning: no such key (nearest: train.learning_rate)"),
        ("run fewshot --arms.real.augmneted 1", "arms.real.augmneted: no such key (nearest: arms.NAME.augmented)"),
        ("run fewshot --arms.real.augmented 7", "arms.real.augmented: input should be less than or equal to 1, got 7"),
        ("run fewshot --data.count few", "data.count: input should be a valid integer"),
        ("run fewshot --fit.tone curves", "fit.tone: input should be 'auto', 'learned' or 'curve', got 'curves'"),
        ("run fewshot --device null", "device: input should be a valid string, got None"),
    ],
)
def test_what_is_misspelt_missing_or_too_much_is_named(words: str, said: str, refused: Callable[..., str]) -> None:
    assert said in refused(*words.split())


@pytest.mark.parametrize("command", ["", *COMMANDS, "data check"])
def test_every_option_says_what_it_does(command: str) -> None:
    found = reduce(lambda above, word: above[word], command.split(), app) if command else app.meta
    options = found.assemble_argument_collection(parse_docstring=True)
    said = {option.name: option.parameter.help for option in options if option.show}
    assert all(said.values()), said
    shared = [text for text in said.values() if list(said.values()).count(text) > 1]
    assert set(shared) <= {"pixels of each frame in a step."}, "the text of a whole group of options"
    for kind in kinds() if command == "run" else ():
        assert all(meaning for _, meaning in list_keys(find_settings(kind)).values()), kind


def test_help_is_quick() -> None:
    code = (
        "import sys, time; from rawaug.cli import main; main(['--help'])\n"
        "print(time.process_time(), 'torch' in sys.modules)"
    )
    runs = (subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True) for _ in range(3))
    for run in runs:
        assert "Denoise a RAW file to DNG" in run.stdout and "check" not in run.stdout
        seconds, has_torch = run.stdout.splitlines()[-1].split()
        assert has_torch == "False"
        if float(seconds) < 1.0:
            return
    pytest.fail(f"rawaug --help took {seconds} s of a processor")


def test_the_listing_says_what_the_docstrings_say_and_it_is_a_module_too() -> None:
    for name, summary in COMMANDS.items():
        assert import_module(f"rawaug.commands.{name}").run.__doc__.startswith(summary), name
    done = subprocess.run([sys.executable, "-m", "rawaug", "--version"], capture_output=True, text=True, check=True)
    assert done.stdout.startswith("rawaug 0.")


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_shells_complete_commands_and_options(shell: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["completion", shell]) == 0
    script = capsys.readouterr().out
    assert "self-ensemble" in script and "self_ensemble" not in script
    if shell == "bash":
        (tmp_path / "complete").write_text(script)
        ask = "COMP_WORDS=(rawaug denoise --self); COMP_CWORD=2; _rawaug; echo ${COMPREPLY[@]}"
        done = subprocess.run(
            ["bash", "-c", f"source complete; {ask}"], cwd=tmp_path, capture_output=True, text=True, check=True
        )
        assert done.stdout.strip() == "--self-ensemble"


@pytest.mark.usefixtures("tiny")
def test_quiet_prints_no_progress(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("RAWAUG_PROGRESS_SECONDS", "0")
    fit = ["fit", "tiny:validation", "--out", str(tmp_path / "isp.safetensors"), *QUICK_FIT]
    assert main(fit) == 0
    assert "steps, 00:00 elapsed" in capsys.readouterr().err
    assert main([*fit, "--quiet", "--overwrite"]) == 0
    assert capsys.readouterr().err == ""


@pytest.mark.usefixtures("no_gpu")
def test_evaluate_finds_what_is_wrong_before_it_reads(
    unread: str, tmp_path: Path, refused: Callable[..., str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "bm3d", None)
    evaluate = ["evaluate", "rawaug-small", "--data", unread]
    assert "nearest: cuda" in refused(*evaluate, "--device", "cudaa")
    assert "this machine has none" in refused(*evaluate, "--device", "cuda")
    assert "bm3d is not installed; licensed for non" in refused(*evaluate, "--classical", "[BM3D]")
    for option in ("--json", "--report"):
        assert "cannot be written: is a folder" in refused(*evaluate, option, tmp_path)
        for command in (evaluate, ["benchmark", "rawaug-small", "--data", unread]):
            assert f"{option}: needs the name of a file" in refused(*command, option, "")


@pytest.mark.usefixtures("tiny")
def test_bad_input_is_one_line(tmp_path: Path, refused: Callable[..., str], bayer_dng: Callable[..., Path]) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "bad.safetensors").write_bytes(b"not weights")
    whole = bayer_dng(tmp_path / "cut.dng", np.full((64, 64), 500, np.uint16))
    whole.write_bytes(whole.read_bytes()[: whole.stat().st_size // 2])
    sound = bayer_dng(tmp_path / "sound.dng", np.full((64, 64), 500, np.uint16))
    picture = tmp_path / "a.png"
    write_picture(picture, demo_pictures(1)[0])
    for words, said in (
        (("fit", tmp_path / "nowhere", "--out", "x.safetensors"), "nowhere"),
        (("fit", tmp_path / "empty", "--out", "x.safetensors"), "no RAW file"),
        (("fit", "bogus:x", "--out", "x.safetensors"), "bogus"),
        (("fit", "demo:train", "--out", tmp_path / "x.pt"), ".safetensors"),
        (("fit", whole, "--out", "x.safetensors"), "cut.dng"),
        (("run", "fewshot", *QUICK_RUN, "--out", tmp_path, "--data.pictures", tmp_path / "empty"), "no picture"),
        (("evaluate", tmp_path / "bad.safetensors", "--data", "demo:test"), "bad.safetensors"),
        (("info", tmp_path / "gone.safetensors"), "gone.safetensors"),
        (("fit", "demo:train", "--out", "x.safetensors", "--noise", "off", "--dark", "gone"), "dark gone: has no use"),
        *((("denoise", file, f"out{file.suffix}", "--denoiser", ""), "no such denoiser") for file in (whole, picture)),
        *((("synth", picture, "out", "--noise", noise), "noise") for noise in ("null", "true", "[[1,2],[3,4]]")),
        (("denoise", sound, "b.dng", "--noise", "[nan,1]"), "must be a name or a pair"),
    ):
        assert said in refused(*words)


def test_networks_take_memory_in_huge_pages_unless_told_otherwise(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for command, given, expected in (
        ("denoise", None, "1"),
        ("run", None, "1"),
        ("evaluate", "0", "0"),
        ("info", None, None),
    ):
        monkeypatch.setenv("THP_MEM_ALLOC_ENABLE", given or "")
        if given is None:
            monkeypatch.delenv("THP_MEM_ALLOC_ENABLE")
        main([command, "--help"])
        assert os.environ.get("THP_MEM_ALLOC_ENABLE") == expected, command


def test_what_a_file_of_ones_own_registers_is_used_by_name(tmp_path: Path, refused: Callable[..., str]) -> None:
    (tmp_path / "own_filter.py").write_text(
        "from denoisers.classical import Classical\n"
        "from denoisers.classical import FILTERS\n"
        "@FILTERS.register('Nothing')\n"
        "class Nothing(Classical):\n"
        "    def denoise(self, planes):\n"
        "        return planes\n"
    )
    evaluate = ["evaluate", "rawaug-small", "--data", str(tmp_path / "gone"), "--classical", "[Nothing]"]
    assert "rawaug --import FILE.py COMMAND, or an entry point in rawaug.filters" in refused(*evaluate)
    assert "no such file" in refused("--import", tmp_path / "own.py", *evaluate)
    assert "gone" in refused("--import", tmp_path / "own_filter.py", *evaluate)
    FILTERS._things.pop("Nothing")


def test_threads_sleep_where_they_wait_unless_the_user_says_otherwise(monkeypatch: pytest.MonkeyPatch) -> None:
    """Threads that spin stop a training where other programs want the cores."""
    monkeypatch.delenv("OMP_WAIT_POLICY", raising=False)
    main([])
    assert os.environ["OMP_WAIT_POLICY"] == "PASSIVE"
    monkeypatch.setenv("OMP_WAIT_POLICY", "ACTIVE")
    main([])
    assert os.environ["OMP_WAIT_POLICY"] == "ACTIVE"


def test_benchmark_takes_a_law_of_ones_own_at_an_iso() -> None:
    levels = "[{iso: 100, shot_var: 5.0e-5, read_var: 1.7e-8}, {iso: 6400, shot_var: 3.1e-3, read_var: 3.8e-6}]"
    law = f"{{name: MeasuredNoise, settings: {{camera: M1, levels: {levels}}}}}"

    _, bound, _ = app.parse_args(["benchmark", "--noise", law, "--iso", "800"], exit_on_error=False, print_error=False)
    levels_at = choose_strengths(bound.arguments["noise"], bound.arguments["iso"])

    shot_var, read_var = levels_at["ISO 800"].sample(1, torch.Generator())
    assert 5.0e-5 < float(shot_var) < 3.1e-3
    assert 1.7e-8 < float(read_var) < 3.8e-6


def test_sigterm_ends_a_command_as_ctrl_c_does(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    before = signal.getsignal(signal.SIGTERM)
    interrupt = signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background jobs ignore it
    try:
        for number in (signal.SIGTERM, signal.SIGINT):
            monkeypatch.setattr("rawaug.cli._add_plugins", lambda _, number=number: signal.raise_signal(number))
            assert main(["info"]) == 128 + number
            assert "stopped; run the same command again" in capsys.readouterr().err
    finally:
        signal.signal(signal.SIGINT, interrupt)
    assert signal.getsignal(signal.SIGTERM) is before
