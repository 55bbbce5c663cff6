"""Kills: what was there stays whole, and a run goes on as if nothing had been.

    python -m benchmarks.faults [--kills 20] [--seed 0] [--commands fit run synth denoise] [--quick]

Every command runs in a forked child on small generated files. First it runs to its end; then it is killed ``--kills``
times at moments drawn uniformly over that time, by SIGKILL, SIGTERM and SIGINT in turn, and after each kill the same
command is run again to its end in the same folder. Its files must then equal those of the run that was not killed, bit
for bit (tensors of safetensors), and nothing else may be left. Exit status 1 if anything differs. Full disks, two runs
at once and folders that vanish or cannot be written are in tests/test_faults.py.
"""

from __future__ import annotations

import multiprocessing
import os
import random
import shutil
import signal
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import torch

from benchmarks.damage import small_frame
from benchmarks.measure import parser, write_pictures

SIGNALS = (signal.SIGKILL, signal.SIGTERM, signal.SIGINT)
FORK = multiprocessing.get_context("fork")
PATIENCE = 600.0
OUT = "out"
LEFT_OUT = (".csv", ".html", ".png", ".lock")
"""Endings of files that hold times, or pictures of them."""

COMMANDS: dict[str, list[str]] = {
    "fit": ["fit", "shots", "--out", f"{OUT}/camera.safetensors", "--steps", "10", "--pixels", "256", "--batch", "128",
            "--noise", "off"],
    "run": ["run", "recipe.yaml", "--out", OUT],
    "synth": ["synth", "pictures", OUT, "--per-image", "4", "--workers", "0", "--noise", "[0.001, 1e-5]"],
    "denoise": ["denoise", "shots", OUT, "--denoiser", "denoiser.safetensors"],
}  # fmt: skip
"""In a folder that :func:`make_inputs` has filled."""

RECIPE = """
name: small
data: {pairs: "demo:train", count: 1, pictures: "demo:", validation: null, test: "demo:test", test_count: 1}
fit: {steps: 2, curve_steps: 2, pixels: 512, batch: 128}
noise: [0.001, 1.0e-5]
denoiser: {name: DnCNN, settings: {width: 4, depth: 2}}
train: {steps: 12, batch: 2, crop: 32, warmup: 1, validate_every: 6, checkpoint_every: 2, workers: 0}
classical: []
self_ensemble: false
baselines: []
device: cpu
arms: {augmented: {augmented: 1.0}}
"""


def make_inputs(folder: Path) -> None:
    """Pictures, RAW files, a denoiser and a recipe."""
    import denoisers
    from rawaug.bayer import CFA
    from rawaug.io import write_dng

    (folder / "shots").mkdir()
    write_pictures(folder / "pictures", 4, (96, 128))
    generator = torch.Generator().manual_seed(0)
    for k in range(4):
        coarse = torch.rand(1, 1, 8, 8, generator=generator)
        light = torch.nn.functional.interpolate(coarse, (96, 128), mode="bilinear")[0]
        mosaic = light * 0.6 + 0.03 * torch.randn(1, 96, 128, generator=generator).abs()
        write_dng(folder / "shots" / f"{k}.dng", small_frame(mosaic, CFA.RGGB))
    denoisers.save(denoisers.build("DnCNN", width=4, depth=3), folder / "denoiser.safetensors", {"cfa": "RGGB"})
    (folder / "recipe.yaml").write_text(RECIPE)


# -- children ----------------------------------------------------------------------------------------------------------


class Child:
    """A forked process that runs a command in ``folder``; what it prints goes to ``folder/log.txt``."""

    def __init__(self, folder: Path, command: list[str]) -> None:
        self.log, self.start = folder / "log.txt", time.monotonic()
        self.process = FORK.Process(target=_run, args=(folder, self.log, command))
        self.process.start()

    def send(self, number: signal.Signals) -> None:
        """Send a signal, if the child is still there."""
        if self.process.is_alive() and self.process.pid:
            os.kill(self.process.pid, number)

    def wait(self) -> int:
        """The exit status, or minus the signal; TimeoutError if it does not end."""
        self.process.join(PATIENCE)
        if self.process.exitcode is None:
            self.process.kill()
            raise TimeoutError(f"hung for {PATIENCE:g} s; {self.said()}")
        return self.process.exitcode

    def said(self) -> str:
        """What it printed last."""
        return self.log.read_text(errors="replace")[-2000:]


def _run(folder: Path, log: Path, command: list[str]) -> None:
    file = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    for stream in (1, 2):
        os.dup2(file, stream)
    sys.stdout, sys.stderr = (os.fdopen(stream, "w", buffering=1) for stream in (1, 2))
    try:
        for number in SIGNALS[1:]:
            signal.signal(number, signal.SIG_DFL)
        signal.signal(signal.SIGINT, signal.default_int_handler)
        torch.set_num_threads(1)
        os.environ["RAWAUG_READ_SECONDS"] = "0"  # decoders in the child itself
        os.chdir(folder)
        from rawaug.cli import main

        sys.exit(main(command))
    except KeyboardInterrupt:  # before the command line was reached
        sys.exit(130)


Files = dict[str, Any]
"""By name, what of each file is compared."""


def contents(folder: Path) -> Files:
    """The files of a folder."""
    from rawaug.files import read_tensors

    found: Files = {}
    for file in sorted(folder.rglob("*")):
        name = str(file.relative_to(folder))
        if not file.is_file() or file.suffix in LEFT_OUT:
            continue
        if file.suffix == ".safetensors":
            tensors = read_tensors(file, "it is damaged", infinite=("colour.spread",))[1]
            found[name] = {key: (value.shape, value.numpy().tobytes()) for key, value in tensors.items()}
        else:
            found[name] = file.read_bytes()
    return found


def fresh(folder: Path) -> Path:
    """The folder without what a run wrote."""
    shutil.rmtree(folder / OUT, ignore_errors=True)
    return folder


# -- kills -------------------------------------------------------------------------------------------------------------


def uninterrupted(folder: Path, name: str) -> tuple[Files, float]:
    """The files of a run that is left alone, and its seconds; ValueError if it fails."""
    child = Child(fresh(folder), COMMANDS[name])
    if status := child.wait():
        raise ValueError(f"{name}: status {status} without any fault: {child.said()}")
    return contents(folder / OUT), time.monotonic() - child.start


def killed(folder: Path, name: str, number: signal.Signals, delay: float, whole: Files) -> str | None:
    """What went wrong with a run that was killed after ``delay`` seconds and run again; None if nothing did."""
    child = Child(fresh(folder), COMMANDS[name])
    time.sleep(delay)
    child.send(number)
    status = child.wait()
    if status not in (0, -number, 130) or "Traceback" in child.said():
        return f"{name}, {number.name} after {delay:.2f} s: status {status}: {child.said()}"
    again = Child(folder, COMMANDS[name])
    if (status := again.wait()) or "Traceback" in again.said():
        return f"{name}, {number.name} after {delay:.2f} s, run again: status {status}: {again.said()}"
    after = contents(folder / OUT)
    different = sorted(key for key in whole.keys() | after.keys() if whole.get(key) != after.get(key))
    return f"{name}, {number.name} after {delay:.2f} s: {', '.join(different)} differ" if different else None


def kills(folder: Path, name: str, count: int, seed: int, whole: Files, seconds: float) -> list[str]:
    """What went wrong with ``count`` kills of a command."""
    moments = random.Random(f"{seed} {name}")
    outcomes = (
        killed(folder, name, SIGNALS[k % len(SIGNALS)], moments.uniform(0, seconds), whole) for k in range(count)
    )
    return [outcome for outcome in outcomes if outcome]


def main(arguments: list[str] | None = None) -> int:
    cli = parser(__doc__)
    cli.add_argument("--kills", type=int, default=20, help="of each command")
    cli.add_argument("--seed", type=int, default=0)
    cli.add_argument("--commands", nargs="+", choices=COMMANDS, default=list(COMMANDS))
    cli.add_argument("--quick", action="store_true", help="one kill of each command")
    args = cli.parse_args(arguments)
    torch.set_num_threads(1)
    count, failures = 1 if args.quick else args.kills, list[str]()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        make_inputs(folder)
        for command in args.commands:
            whole, seconds = uninterrupted(folder, command)
            wrong = kills(folder, command, count, args.seed, whole, seconds)
            print(f"{command:8} {seconds:5.1f} s  {count} kills, {len(wrong)} wrong", flush=True)
            failures += wrong
    print(*failures, sep="\n", end="")
    return int(bool(failures))


if __name__ == "__main__":
    sys.exit(main())
