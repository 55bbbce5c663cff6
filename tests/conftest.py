"""One thread a process, for two processes test at once (``make test``); which tests need a GPU; and where real camera
files lie, if any do.

No test fails because the machine is slow: hypothesis has neither a deadline nor a limit for its inputs. Processes that
tests start through multiprocessing's forkserver have what takes seconds to import already.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import gc
import multiprocessing
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from tempfile import mkdtemp

import pytest
import torch
from hypothesis import HealthCheck, settings

from denoisers.classical import FILTERS
from denoisers.network import DENOISERS
from rawaug.data import demo_pairs, demo_pictures
from rawaug.data.pairs import DATASETS, PICTURES, Pair
from rawaug.experiment.recipe import EXPERIMENTS
from rawaug.experiment.task import TASKS
from rawaug.isp.stages import STAGES
from rawaug.noise.models import NOISE
from rawaug.paper.baselines.base import BASELINES
from rawaug.registry import Registry
from rawaug.training.estimators import ESTIMATORS
from rawaug.training.losses import LOSSES

torch.set_num_threads(1)
settings.register_profile("rawaug", max_examples=50, deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("rawaug")
multiprocessing.set_forkserver_preload(
    ["rawaug.experiment.run", "rawaug.training.camera_fit", "rawaug.plugin.dataset", "lightning_fabric"]
)


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Iterator[None]:
    """What is collected stays to the end: to look through it for garbage again and again would take seconds."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.enable()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Long tests come first, so that no process waits for the other at the end; ``gpu`` is skipped without a device."""
    items.sort(key=lambda item: item.get_closest_marker("long") is None)
    if torch.cuda.is_available():
        return
    for item in items:
        if item.get_closest_marker("gpu"):
            item.add_marker(pytest.mark.skip(reason="no CUDA device"))


@pytest.fixture(scope="session", autouse=True)
def no_home(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """``HOME`` and the caches below it are empty, time zone and locale neutral, in the processes of tests too."""
    home = str(tmp_path_factory.mktemp("home"))
    with pytest.MonkeyPatch.context() as patch:
        for name in ("XDG_CACHE_HOME", "XDG_CONFIG_HOME", "XDG_DATA_HOME", "MPLCONFIGDIR"):
            patch.delenv(name, raising=False)
        homes = dict.fromkeys(("HOME", "USERPROFILE", "TRITON_HOME"), home)  # Triton has read HOME when it was imported
        for name, value in {**homes, "TZ": "UTC", "LC_ALL": "C.UTF-8"}.items():
            patch.setenv(name, value)
        yield


@pytest.fixture(autouse=True)
def empty_folder(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> None:
    """The current folder is an empty one."""
    monkeypatch.chdir(mkdtemp(dir=tmp_path_factory.getbasetemp()))


@pytest.fixture(scope="session")
def camera_files() -> Path:
    """The folder of real camera files, beside the repository or where RAWAUG_SHARED says."""
    beside = Path(__file__).parents[2] / "shared" / "data"
    folder = Path(os.environ.get("RAWAUG_SHARED", beside))
    if not (folder / "raw").is_dir():
        pytest.skip(f"no real camera files in {folder}; RAWAUG_SHARED names their folder")
    return folder


@pytest.fixture
def registries(monkeypatch: pytest.MonkeyPatch) -> list[Registry]:
    """All registries, with the built-in things in them; what a test registers is forgotten after it."""
    kinds = [
        BASELINES,
        DATASETS,
        DENOISERS,
        ESTIMATORS,
        EXPERIMENTS,
        FILTERS,
        LOSSES,
        NOISE,
        PICTURES,
        STAGES,
        TASKS,
    ]
    for kind in kinds:
        monkeypatch.setattr(kind, "_things", {name: kind[name] for name in kind})
    return kinds


@cache
def _middles(split: str) -> list[Pair]:
    return [pair.middle(96) for pair in demo_pairs(split, count=2)]


@pytest.fixture
def tiny(registries: list[Registry]) -> None:
    """``tiny:SPLIT``: the middle of two shots by the demo camera; ``tiny:``: a corner of four of its pictures."""

    @DATASETS.register("tiny")
    def pairs(path: str = "", split: str = "test") -> list[Pair]:
        return list(_middles(path or split))

    @PICTURES.register("tiny")
    def pictures(path: str = "", min_side: int = 2) -> list[torch.Tensor]:
        return [picture[:, :128, :160] for picture in demo_pictures(4)]


@pytest.fixture
def refused(capsys: pytest.CaptureFixture[str]) -> Callable[..., str]:
    """The one line on stderr with which a command line is refused: ``refused("fit", path, "--out", out)``."""

    def line(*arguments: object, status: int = 2) -> str:
        from rawaug.cli import main

        capsys.readouterr()
        assert main([str(argument) for argument in arguments]) == status
        (line,) = capsys.readouterr().err.strip().splitlines()
        return str(line)

    return line


@pytest.fixture
def no_gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    """The machine has no GPU, whatever it has."""
    monkeypatch.setattr(torch.backends.mps, "is_available", lambda: False)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 0)


@pytest.fixture
def unread(registries: list[Registry]) -> str:
    """The name of a dataset that must not be opened."""

    @DATASETS.register("unread")
    def opened(path: str = "", split: str = "") -> list[Pair]:
        pytest.fail("data was read")

    return "unread:"


@pytest.fixture
def given(registries: list[Registry]) -> list[Pair]:
    """What is opened as ``"given:"``, whatever the split: a list to be filled."""
    pairs: list[Pair] = []

    @DATASETS.register("given")
    def opened(path: str = "", split: str = "") -> list[Pair]:
        return pairs

    return pairs
