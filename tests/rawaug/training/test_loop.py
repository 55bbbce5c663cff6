"""The loop: it learns, and a run that was cut off ends as one that was not."""

from __future__ import annotations

import multiprocessing
import socket
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from math import factorial
from pathlib import Path
from typing import Any

import pytest
import torch

from rawaug.bayer import CFA
from rawaug.data import demo_pairs, demo_photographs
from rawaug.evaluation.figures import read_log
from rawaug.evaluation.trials import Trial, make_trial
from rawaug.noise import noise_model
from rawaug.plugin.dataset import RawPairs
from rawaug.training import loop
from rawaug.training.config import DenoiserConfig, TrainConfig
from rawaug.training.estimators import Supervised
from rawaug.training.journal import Journal
from rawaug.training.sources import RealCrops
from rawaug.training.state import TrainingState, first_network, learning_rate_factor
from rawaug.training.stream import TrainingStream

NETWORK = DenoiserConfig("UNet", {"width": 4, "scales": 3, "deviation": True})
CONFIG = TrainConfig(steps=12, batch=2, crop=32, validate_every=6, checkpoint_every=5, learning_rate=3e-3, warmup=2)


@pytest.fixture(scope="module")
def stream() -> TrainingStream:
    pairs = demo_pairs("train", count=2)
    return TrainingStream(RealCrops(pairs, noise_model("cycleisp_sidd"), 32, pairs[0].cfa), None, 2, 0.0, seed=0)


@pytest.fixture(scope="module")
def validation() -> list[Trial]:
    pair = demo_pairs("validation", count=1)[0]
    return [replace(make_trial(pair, noise_model("cycleisp_sidd"), CFA.GRBG), develop=None)]


@pytest.fixture
def scored(monkeypatch: pytest.MonkeyPatch) -> Callable[..., list[dict[str, torch.Tensor]]]:
    """``scored(40.0, 30.0)``: the PSNR of each validation to come, and the weights that they have seen."""

    def say(*scores: float) -> list[dict[str, torch.Tensor]]:
        left, seen = iter(scores), list[dict[str, torch.Tensor]]()

        def validated(net: torch.nn.Module, *_: object) -> dict[str, float]:
            seen.append({key: value.clone() for key, value in net.state_dict().items()})
            return {"psnr": next(left)}

        monkeypatch.setattr(loop, "validate", validated)
        return seen

    return say


class Killed(Exception):
    pass


class Dying(Supervised):
    """Kills its training as a step begins."""

    def __init__(self, step: int) -> None:
        self.left = step

    def loss(self, *arguments: Any) -> torch.Tensor:
        self.left -= 1
        if not self.left:
            raise Killed
        return super().loss(*arguments)


def test_the_best_weights_survive_a_kill_after_which_scores_fall(
    stream: TrainingStream,
    validation: list[Trial],
    tmp_path: Path,
    scored: Callable[..., Any],
    capsys: pytest.CaptureFixture[str],
) -> None:
    seen = scored(30.0, 40.0, 20.0, 10.0)
    config = replace(CONFIG, steps=8, validate_every=2, checkpoint_every=4)
    with pytest.raises(Killed):
        loop.train(stream, validation, NETWORK, config, tmp_path, device="cpu", estimator=Dying(5))
    assert "resumed" not in capsys.readouterr().out
    kept = loop.train(stream, validation, NETWORK, config, tmp_path, device="cpu").state_dict()
    assert all(torch.equal(kept[key], value) for key, value in seen[1].items())
    assert "resumed after step 4 of 8" in capsys.readouterr().out


def test_a_checkpoint_of_other_settings_is_not_resumed_and_a_damaged_one_is_named(
    stream: TrainingStream, validation: list[Trial], tmp_path: Path
) -> None:
    config = replace(CONFIG, steps=5, validate_every=5)
    first, again, other = (
        loop.train(stream, validation, NETWORK, config, tmp_path, seed, "cpu", key=key)
        for seed, key in ((0, "a"), (9, "a"), (9, "b"))
    )
    weights = [next(iter(net.state_dict().values())) for net in (first, again, other)]
    assert torch.equal(weights[0], weights[1]) and not torch.equal(weights[0], weights[2])
    whole = (tmp_path / "last.pt").read_bytes()
    for damaged in (b"", b"junk", whole[:2000], whole[: len(whole) // 2]):
        (tmp_path / "last.pt").write_bytes(damaged)
        with pytest.raises(ValueError, match=r"last\.pt: .*damaged"):
            loop.train(stream, validation, NETWORK, config, tmp_path, device="cpu", key="b")


@pytest.mark.parametrize("steps", [1, 10, 100])
def test_the_average_warms_up(steps: int) -> None:
    """Of weights that jump from 0 to 1, ``prod (1 + n) / (10 + n)`` of the 0 is left."""
    net = first_network(NETWORK, seed=0)
    state = TrainingState(net, replace(CONFIG, ema=0.999))
    for count, value in ((1, 0.0), (steps, 1.0)):
        for weights in net.parameters():
            torch.nn.init.constant_(weights, value)
        for _ in range(count):
            state.average.update_parameters(net)
    left = next(state.average_network.parameters()).flatten()[0].sub(1).abs().item()
    assert left == pytest.approx(factorial(10) * factorial(steps + 1) / factorial(steps + 10), abs=1e-6)


def test_the_log_has_the_mean_loss_since_the_row_before_and_the_rate(
    stream: TrainingStream, validation: list[Trial], tmp_path: Path
) -> None:
    losses = []

    class Noting(Supervised):
        def loss(self, *arguments: Any) -> torch.Tensor:
            losses.append(super().loss(*arguments))
            return losses[-1]

    for steps in (8, 12):  # the second run goes on from step 8, in the middle of a row
        config = replace(CONFIG, steps=steps, schedule="step")
        loop.train(stream, validation, NETWORK, config, tmp_path, device="cpu", estimator=Noting(), choose=False)
    head, *lines = (tmp_path / "log.csv").read_text().splitlines()
    assert head == "step,loss,psnr,learning_rate,samples_per_second"
    rows = [line.split(",") for line in lines]
    assert [int(row[0]) for row in rows] == [6, 8, 12]
    for row, part in zip(rows, (losses[:6], losses[6:8], losses[8:]), strict=True):
        assert float(row[1]) == pytest.approx(float(torch.stack(part).detach().mean()), rel=1e-4)
        assert float(row[3]) == pytest.approx(3e-3)


@pytest.mark.parametrize("choose", [True, False])
def test_the_best_weights_are_kept_or_the_last(
    choose: bool, stream: TrainingStream, validation: list[Trial], tmp_path: Path, scored: Callable[..., Any]
) -> None:
    seen = scored(40.0, 30.0)
    kept = loop.train(stream, validation, NETWORK, CONFIG, tmp_path, device="cpu", choose=choose).state_dict()
    assert all(torch.equal(kept[key], value) for key, value in seen[0 if choose else 1].items())


def test_a_diverged_training_says_so(stream: TrainingStream, validation: list[Trial], tmp_path: Path) -> None:
    config = replace(CONFIG, learning_rate=1e9, clip_norm=0.0, warmup=0)
    with pytest.raises(ValueError, match="diverged"):
        loop.train(stream, validation, NETWORK, config, tmp_path, device="cpu")


MEET = """
from rawaug.training.launch import launch
fabric = launch("cpu", 1, "32-true")
(where / str(fabric.global_rank)).write_text(str(fabric.world_size))
"""
NODE = """
from torch.distributed.launcher.api import LaunchConfig, elastic_launch
rendezvous = {"rdzv_backend": "static", "rdzv_endpoint": endpoint, "rdzv_configs": {"rank": rank}, "run_id": "meet"}
config = LaunchConfig(2, 2, 2, **rendezvous, max_restarts=0, monitor_interval=0.05, start_method="fork")
elastic_launch(config, exec)(meet, {"where": where})
"""
"""What ``torchrun --nnodes 2 --nproc-per-node 2 --node-rank RANK`` does on a node, for code in place of a file."""


def test_torchrun_s_processes_count(tmp_path: Path) -> None:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        endpoint = f"127.0.0.1:{free.getsockname()[1]}"
    nodes = []
    for rank in (0, 1):
        variables = {"rank": rank, "endpoint": endpoint, "meet": MEET, "where": tmp_path}
        nodes.append(multiprocessing.get_context("forkserver").Process(target=exec, args=(NODE, variables)))
        nodes[-1].start()
    for node in nodes:
        node.join(400)
    assert {file.name: file.read_text() for file in tmp_path.iterdir()} == {str(rank): "4" for rank in range(4)}


def test_the_rate_warms_up_and_falls() -> None:
    factors = [learning_rate_factor(step, CONFIG) for step in range(CONFIG.steps + 1)]
    assert factors[0] == 0.5 and factors[2] == 1.0
    assert factors[-1] == pytest.approx(0.01)
    assert all(a >= b for a, b in pairwise(factors[2:]))
    config = replace(CONFIG, schedule="step", halve_every=3, warmup=2)
    assert [learning_rate_factor(step, config) for step in range(8)] == [0.5, 1, 1, 0.5, 0.5, 0.5, 0.25, 0.25]


def test_the_log_has_the_rows_of_this_run_alone(tmp_path: Path) -> None:
    for loss, start in ((9.0, 0), (0.5, 0), (0.25, 2)):  # another run, this one, and this one resumed
        journal = Journal(tmp_path, start)
        for step in (start + 1, start + 2):
            journal.log(step, loss=loss, learning_rate=1e-3)
    rows = (tmp_path / "log.csv").read_text().splitlines()
    assert [row.split(",")[:2] for row in rows[1:]] == [["1", "0.5"], ["2", "0.5"], ["3", "0.25"], ["4", "0.25"]]


@pytest.mark.parametrize("damaged", ["", "step,loss\n1,0.5\nabc,1\n", "step,loss\n1,0.5\n2,0", "\0\xff"])
def test_a_damaged_log_stops_no_training(tmp_path: Path, damaged: str) -> None:
    (tmp_path / "log.csv").write_text(damaged)
    Journal(tmp_path, 2).log(3, loss=0.25)
    steps = [row["step"] for row in read_log(tmp_path / "log.csv")]
    assert steps == (["1", "3"] if "0.5" in damaged else ["3"])


def test_a_short_training_has_a_curve_and_a_long_one_its_own_period() -> None:
    assert replace(CONFIG, steps=100, validate_every=100).validation_period == 20
    assert replace(CONFIG, steps=3, validate_every=100).validation_period == 1
    assert replace(CONFIG, steps=200, validate_every=100).validation_period == 100


def test_fabric_logs_what_the_journal_has(stream: TrainingStream, validation: list[Trial], tmp_path: Path) -> None:
    config = replace(CONFIG, steps=4, validate_every=2, logger="csv")
    loop.train(stream, validation, NETWORK, config, tmp_path, device="cpu")
    journal, logged = (read_log(tmp_path / name) for name in ("log.csv", "csv/metrics.csv"))
    assert [row["step"] for row in logged] == [row["step"] for row in journal] == ["2", "4"]
    assert [float(row["psnr"]) for row in logged] == pytest.approx([float(row["psnr"]) for row in journal], rel=1e-5)


def test_a_training_learns_the_same_of_pairs_that_the_device_makes(
    validation: list[Trial], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pictures = list(demo_photographs("train").values())[:2]
    config = replace(CONFIG, steps=2, validate_every=2)
    weights = []
    for kind in ("cuda", "cpu"):
        monkeypatch.setattr(loop, "MAKE_PAIRS", {kind})
        stream = TrainingStream(None, RawPairs(pictures, "universal", crop=32), 2, 1.0, seed=0)
        network = loop.train(stream, validation, NETWORK, config, tmp_path / kind, device="cpu")
        weights.append(torch.cat([weight.flatten() for weight in network.parameters()]))
    torch.testing.assert_close(*weights)
