"""Faults of the machine in short form: what was there stays whole, and a run goes on or ends in one line."""

from __future__ import annotations

import os
import resource
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch.utils.data import DataLoader, Dataset

import denoisers
from benchmarks import faults
from rawaug.bayer import CFA
from rawaug.cli import main
from rawaug.data import PictureFolder
from rawaug.data.formats import write_npz, write_tiff
from rawaug.errors import resource_error
from rawaug.evaluation.figures import new_figure, read_log, save_figure
from rawaug.evaluation.page import Page
from rawaug.files import LOCK, locked, write_json, write_tensors
from rawaug.io import RawFrame, read_picture, write_dng, write_picture
from rawaug.synthesis import files as pair_files
from rawaug.synthesis.folder import synth
from rawaug.training.config import TrainConfig
from rawaug.training.journal import Journal
from rawaug.training.state import TrainingState

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="needs forks, signals and limits of Linux")


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("inputs")
    faults.make_inputs(folder)
    return folder


@pytest.fixture(autouse=True)
def read_here(monkeypatch: pytest.MonkeyPatch) -> None:
    """Decoders in this process: to start another takes seconds."""
    monkeypatch.setenv("RAWAUG_READ_SECONDS", "0")


# -- kills ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("name", "number"), [("fit", "SIGINT"), ("synth", "SIGTERM"), ("denoise", "SIGKILL")])
def test_a_killed_command_goes_on_bit_for_bit(inputs: Path, name: str, number: str) -> None:
    """As benchmarks.faults has it; ``run`` takes too long for a test."""
    whole, seconds = faults.uninterrupted(inputs, name)
    assert whole
    assert faults.killed(inputs, name, getattr(signal, number), 0.7 * seconds, whole) is None


# -- one run at a time ------------------------------------------------------------------------------------------------


def in_child(work: Callable[[], object]) -> int:
    """The exit status of ``work`` in a fork of this process; 1 for an exception."""
    pid = os.fork()
    if pid == 0:
        try:
            work()
        except BaseException:
            os._exit(1)
        os._exit(0)
    return os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])


def test_a_second_run_is_refused_with_the_name_of_the_folder(tmp_path: Path) -> None:
    def second() -> None:
        with pytest.raises(ValueError, match=rf"{tmp_path}: in use.*rawaug\.lock"):
            locked(tmp_path / LOCK).__enter__()

    with locked(tmp_path / LOCK):
        assert in_child(second) == 0
        with pytest.raises(ValueError, match="in use"):
            locked(tmp_path / LOCK).__enter__()
    with locked(tmp_path / LOCK):
        pass
    assert not list(tmp_path.iterdir())


def test_the_lock_of_a_dead_process_is_taken_over(tmp_path: Path) -> None:
    def die() -> None:
        lock = locked(tmp_path / LOCK)
        lock.__enter__()
        os.kill(os.getpid(), signal.SIGKILL)

    assert in_child(die) == -signal.SIGKILL
    assert (tmp_path / LOCK).exists()
    with locked(tmp_path / LOCK):
        pass
    assert not list(tmp_path.iterdir())


def test_a_folder_that_was_only_made_for_the_lock_is_taken_away(tmp_path: Path, inputs: Path) -> None:
    out = tmp_path / "new" / "pairs"
    with pytest.raises(ValueError, match="'bogus' is unknown"):
        synth(inputs / "pictures", out, noise="bogus", workers=0)
    assert not out.exists()


@pytest.mark.parametrize("command", ["synth", "denoise", "fit", "run"])
def test_two_at_once(command: str, inputs: Path, tmp_path: Path, refused: Callable[..., str]) -> None:
    fitted = tmp_path / "camera.safetensors"
    arguments = {
        "fit": (inputs / "shots", "--out", fitted),
        "run": (inputs / "recipe.yaml", "--out", tmp_path.parent, "--name", tmp_path.name),
        "synth": (inputs / "pictures", tmp_path, "--workers", 0),
        "denoise": (inputs / "shots", tmp_path, "--denoiser", inputs / "denoiser.safetensors"),
    }
    with locked(Path(f"{fitted}.lock") if command == "fit" else tmp_path / LOCK):
        assert "in use by" in refused(command, *arguments[command])


# -- disks and folders ------------------------------------------------------------------------------------------------

FRAME = RawFrame(
    torch.rand((1, 128, 128), generator=torch.Generator().manual_seed(0)),
    CFA.RGGB, (0.0,) * 4, 4095.0, (2.0, 1.0, 1.5), (2.0, 1.0, 1.5), torch.eye(3),
    "Maker Model", None, None, 0, "a",
)  # fmt: skip


def _save_checkpoint(path: Path) -> None:
    TrainingState(denoisers.build("DnCNN", width=24, depth=4), TrainConfig(steps=1)).save(path, key="key")


NOISE = torch.rand((3, 128, 128), generator=torch.Generator().manual_seed(0))


def _figure() -> Any:
    figure = new_figure(4, 3)
    figure.subplots().plot(range(1000), NOISE.flatten()[:1000])
    return figure


WRITERS: dict[str, Callable[[Path], object]] = {
    "safetensors": lambda path: write_tensors({"x": torch.zeros(40_000)}, {"format": "rawaug"}, path),
    "json": lambda path: write_json(["x" * 100_000], path),
    "dng": lambda path: write_dng(path, FRAME),
    "checkpoint": _save_checkpoint,
    "png": lambda path: write_picture(path, NOISE),
    "jpg": lambda path: write_picture(path, NOISE),
    "tif": lambda path: write_picture(path, NOISE),
    "npz": lambda path: write_npz(path, NOISE, NOISE, {}),
    "tiff": lambda path: write_tiff(path, NOISE, {}),
    "html": lambda path: Page("x" * 100_000).write(path, {}),
    "svg": lambda path: save_figure(_figure(), path),
    "denoiser": lambda path: denoisers.save(denoisers.build("DnCNN", width=32, depth=4), path, {"cfa": "RGGB"}),
}


@pytest.mark.parametrize("kind", list(WRITERS))
def test_a_full_disk_leaves_what_was_there_and_says_so(kind: str, tmp_path: Path) -> None:
    path = tmp_path / f"a.{kind}"
    WRITERS[kind](path)
    before = path.read_bytes()
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (16_384, limits[1]))  # as on a full disk, a write is cut short or fails
    try:
        with pytest.raises(OSError) as caught:
            WRITERS[kind](path)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert path.read_bytes() == before and [file.name for file in tmp_path.iterdir()] == [path.name]
    assert caught.value.filename == str(path) and caught.value.strerror


def test_a_full_disk_stops_no_log_for_ever(tmp_path: Path) -> None:
    Journal(tmp_path, 0).log(1, loss=0.5)
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (8, limits[1]))
    try:
        with pytest.raises(OSError):
            Journal(tmp_path, 1).log(2, loss=0.25)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    Journal(tmp_path, 1).log(2, loss=0.25)
    assert [row["step"] for row in read_log(tmp_path / "log.csv")] == ["1", "2"]


def test_an_output_folder_that_is_removed_on_the_way_is_reported(
    tmp_path: Path, inputs: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write, calls = pair_files.write_pair, list[Path]()

    def write_and_remove(stem: Path, *rest: Any) -> None:
        write(stem, *rest)
        calls.append(stem)
        if len(calls) == 2:
            for file in (tmp_path / "out").iterdir():
                file.unlink()
            (tmp_path / "out").rmdir()

    monkeypatch.setattr(pair_files, "write_pair", write_and_remove)
    with pytest.raises(OSError, match=r"out: .*replaced"):
        synth(inputs / "pictures", tmp_path / "out", workers=0)


@pytest.mark.skipif(os.getuid() != 0, reason="becomes another user")
def test_a_folder_without_the_right_to_write_is_named(tmp_path: Path) -> None:
    def as_nobody() -> None:
        os.chdir(tmp_path)
        os.setuid(65534)
        with pytest.raises(PermissionError) as caught:
            locked(Path("out", LOCK)).__enter__()
        assert caught.value.filename is not None

    tmp_path.chmod(0o555)
    assert in_child(as_nobody) == 0


# -- inputs -----------------------------------------------------------------------------------------------------------


def test_a_picture_that_vanishes_is_named_and_the_rest_is_made(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "in").mkdir()
    for k in range(3):
        write_picture(tmp_path / "in" / f"{k}.png", torch.full((3, 16, 16), 0.2 * k))

    def unlucky(path: Path, *rest: Any) -> Any:
        picture = read_picture(path, *rest)
        if path.name == "1.png":
            path.unlink()
        return picture

    monkeypatch.setattr(pair_files, "read_picture", unlucky)
    result = synth(tmp_path / "in", tmp_path / "out", workers=0)
    assert result.made == 2 and list(result.broken) == ["1.png"] and "1.png" in result.broken["1.png"]


# -- workers, shared memory -------------------------------------------------------------------------------------------


class Deadly(PictureFolder):
    """Its second picture has the worker killed by the system."""

    def read(self, index: int) -> torch.Tensor:
        if index:
            os.kill(os.getpid(), signal.SIGKILL)
        return super().read(index)


class Wrong(Dataset[Any]):
    def __len__(self) -> int:
        return 1

    def __getitem__(self, index: int) -> torch.Tensor:
        raise ValueError("a.png: is too small")


def test_a_worker_that_the_system_kills_is_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for k in range(2):
        write_picture(tmp_path / f"{k}.png", torch.zeros(3, 8, 8))
    datasets: list[Dataset[Any]] = [Deadly(tmp_path), Wrong()]

    def load(words: list[str], **_: Any) -> None:
        list(DataLoader(datasets.pop(0), num_workers=1))

    monkeypatch.setattr("rawaug.cli.app", SimpleNamespace(meta=load))
    assert main(["x"]) == 2
    error = capsys.readouterr().err
    assert "a worker process was killed, perhaps for its memory; use fewer workers" in error and error.count("\n") == 1
    assert "find a damaged file with rawaug data check" in error
    assert main(["x"]) == 2
    assert capsys.readouterr().err == "rawaug: a.png: is too small\n"


@pytest.mark.parametrize(
    ("said", "way_out"),
    [
        ("unable to allocate shared memory(shm) for file </torch_1>: No space left on device (28)", "enlarge /dev/shm"),
        ("DataLoader worker (pid 5) is killed by signal: Bus error. It is possible that dataloader's workers are out "
         "of shared memory. Please try to raise your shared memory limit.", "enlarge /dev/shm"),
        ("received 0 items of ancdata", "ulimit -n"),
        ("unable to open shared memory object </torch_1> in read-write mode: Too many open files (24)", "ulimit -n"),
        ("DataLoader worker (pid(s) 5, 6) exited unexpectedly", "fewer workers"),
        ("[gloo/transport/tcp/pair.cc:537] Read error [127.0.0.1]:23682: Connection reset by peer.", "process"),
        ("CUDA out of memory. Tried to allocate 2.00 GiB.\nMore lines", "smaller batch"),
    ],
)  # fmt: skip
def test_what_the_machine_lacks_is_said_in_one_line(said: str, way_out: str) -> None:
    line = resource_error(RuntimeError(said))
    assert line is not None and way_out in line and "\n" not in line
    assert resource_error(RuntimeError("mat1 and mat2 shapes cannot be multiplied")) is None
    assert "smaller batch" in str(resource_error(MemoryError()))
