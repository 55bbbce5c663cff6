"""The engine as processes see it: a kill at any step changes nothing, nor does sharing a step among processes."""

from __future__ import annotations

import multiprocessing
import random
import signal
import socket
import time
from collections.abc import Iterator
from multiprocessing.context import ForkServerProcess
from pathlib import Path

import pytest
from safetensors.torch import load_file

SCRIPT = """
import os
import warnings

import torch

os.environ.update(environment)
warnings.filterwarnings("ignore")
torch.set_num_threads(1)
from safetensors.torch import save_file
from rawaug.bayer import CFA
from rawaug.training.noisy_frames import NoisyCrops, NoisyFrame, r2r_trials
from rawaug.training.estimators import Noisier
from rawaug.training.neighbor2neighbor import Neighbor2Neighbor
from rawaug.training.config import DenoiserConfig, TrainConfig
from rawaug.training.stream import TrainingStream
from rawaug.training.loop import train
from rawaug.evaluation.trials import Trial

generator = torch.Generator().manual_seed(0)
frame = NoisyFrame("frame", torch.rand(1, 64, 64, generator=generator), 1e-3, 1e-4, CFA.RGGB)
config = TrainConfig(
    steps=steps, batch=4, crop=32, warmup=2, loss="l2", ema=0.9, validate_every=1, checkpoint_every=3,
    learning_rate=3e-3,
)
network = DenoiserConfig("UNet", {"width": 4, "scales": 2})
watched = r2r_trials([frame], CFA.RGGB)
for name in names:
    estimator = {"noisier": Noisier(1.0, correct=True), "neighbor2neighbor": Neighbor2Neighbor()}[name]
    stream = TrainingStream(NoisyCrops([frame], estimator, 32, CFA.RGGB), None, 4, 0.0, seed=0)
    net = train(stream, watched, network, config, where / name, 0, "cpu", devices, estimator=estimator)
    save_file(net.state_dict(), where / name / f"end{environment.get('LOCAL_RANK', '')}.safetensors")
"""


def trained(where: Path, steps: int, *names: str) -> None:
    """The script in this process."""
    exec(SCRIPT, {"where": where, "steps": steps, "devices": 1, "names": names, "environment": {}})


def started(where: Path, steps: int, devices: int, *names: str, **environment: str) -> ForkServerProcess:
    """The script in a process of its own."""
    variables = {"where": where, "steps": steps, "devices": devices, "names": names, "environment": environment}
    process = multiprocessing.get_context("forkserver").Process(target=exec, args=(SCRIPT, variables))
    process.start()
    return process


def logged(folder: Path) -> list[list[str]]:
    """Rows of ``log.csv`` without the speed."""
    return [row.split(",")[:3] for row in (folder / "log.csv").read_text().splitlines()]


def rows_as_they_come(folder: Path, process: ForkServerProcess) -> Iterator[int]:
    """The last logged step, whenever it has changed."""
    last = -1
    while process.is_alive():
        path = folder / "log.csv"
        count = path.read_text().count("\n") - 1 if path.is_file() else 0
        if count != last:
            last = count
            yield count
        time.sleep(0.001)


STEPS = 30


@pytest.fixture(scope="module")
def unbroken(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("unbroken")
    trained(folder, STEPS, "noisier")
    return folder / "noisier"


def test_killed_at_a_random_step_it_ends_bit_for_bit_as_unbroken(unbroken: Path, tmp_path: Path) -> None:
    step = random.Random().randint(4, STEPS - 15)
    process = started(tmp_path, STEPS, 1, "noisier")
    folder = tmp_path / "noisier"
    for done in rows_as_they_come(folder, process):
        if done >= step:
            process.kill()
            break
    process.join()
    assert process.exitcode == -signal.SIGKILL, f"it was over before it could be killed at step {step}"
    assert not (folder / "end.safetensors").exists() and (folder / "last.pt").is_file()
    trained(tmp_path, STEPS, "noisier")
    whole, resumed = (load_file(place / "end.safetensors") for place in (unbroken, folder))
    assert whole.keys() == resumed.keys()
    assert all(bool((whole[key] == resumed[key]).all()) for key in whole), f"killed at step {step}"
    assert logged(folder) == logged(unbroken), f"killed at step {step}"


def test_two_processes_take_the_steps_of_one(tmp_path: Path) -> None:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = str(free.getsockname()[1])
    together, alone = tmp_path / "together", tmp_path / "alone"
    meeting = {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": port, "WORLD_SIZE": "2", "NODE_RANK": "0"}
    names = ("noisier", "neighbor2neighbor")
    ranks = [started(together, 20, 2, *names, LOCAL_RANK=str(rank), **meeting) for rank in (0, 1)]
    trained(alone, 20, *names)
    for process in ranks:
        process.join(400)
        assert process.exitcode == 0
    for name in names:
        one, two = ([float(row[1]) for row in logged(folder / name)[1:]] for folder in (alone, together))
        assert len(one) == 20
        assert two == pytest.approx(one, abs=1e-5)
        ends = [load_file(together / name / f"end{rank}.safetensors") for rank in (0, 1)]
        assert all(bool((ends[0][key] == ends[1][key]).all()) for key in ends[0])
