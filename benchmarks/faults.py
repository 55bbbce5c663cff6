"""Kills and full disks: what was there stays whole, and a run goes on as if nothing had been.

    python -m benchmarks.faults [--kills 20] [--disks 20] [--seed 0] [--commands fit run synth ...] [--quick]

Every command that writes runs in a forked child on small generated files. First it runs to its end; then it is killed
``--kills`` times at moments drawn uniformly over that time, by SIGKILL, SIGTERM and SIGINT in turn, and after each kill
the same command is run again to its end in the same folder. Its files must then equal those of the run that was not
killed, bit for bit (tensors of safetensors), and nothing else may be left.

``--disks`` times it writes to a disk (a tmpfs, which needs root) whose free space is drawn uniformly up to what the
command needs. It must then end in one line with status 2, or with all its files; whatever it has left must be whole;
and the same command must complete once there is space. Exit status 1 if anything is otherwise. Two runs at once and
folders that vanish or cannot be written are in tests/test_faults.py.
"""

from __future__ import annotations

import multiprocessing
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch

from benchmarks.damage import small_frame
from benchmarks.measure import parser, write_pictures

SIGNALS = (signal.SIGKILL, signal.SIGTERM, signal.SIGINT)
FORK = multiprocessing.get_context("fork")
PATIENCE = 600.0
OUT = "out"
LEFT_OUT = (".csv", ".html", ".png", ".lock", ".tex")
"""Endings of files that hold times, or pictures of them."""
ENDS = {".csv": b"\n", ".html": b"</html>", ".png": b"IEND\xaeB`\x82", ".tex": b"}\n"}
"""A file with such an ending is whole if it ends with these bytes, but for blanks."""
ROOM = 2**18
"""What a command needs besides its files: locks, and a file beside the one that it replaces."""

COMMANDS: dict[str, list[str]] = {
    "fit": ["fit", "shots", "--out", f"{OUT}/camera.safetensors", "--steps", "10", "--pixels", "256", "--batch", "128",
            "--noise", "off"],
    "run": ["run", "recipe.yaml", "--out", OUT],
    "synth": ["synth", "pictures", OUT, "--per-image", "4", "--workers", "0", "--noise", "[0.001, 1e-5]"],
    "denoise": ["denoise", "shots", OUT, "--denoiser", "denoiser.safetensors"],
    "previews": ["denoise", "shots", OUT, "--denoiser", "denoiser.safetensors", "--preview", f"{OUT}/previews"],
    "shards": ["synth", "pictures", OUT, "--format", "webdataset", "--per-shard", "2", "--workers", "0", "--noise",
               "[0.001, 1e-5]"],
    "evaluate": ["evaluate", "denoiser.safetensors", "--data", "shots", "--noise", "upi", "--json",
                 f"{OUT}/scores.json", "--report", f"{OUT}/page.html", "--overwrite"],
    "benchmark": ["benchmark", "--data", "shots", "--count", "1", "--crop", "32", "--noise", "[0.001, 1e-5]", "--json",
                  f"{OUT}/scores.json", "--report", f"{OUT}/page.html", "--table", f"{OUT}/table.tex", "--figure",
                  f"{OUT}/crops.png", "--overwrite"],
    "hdr": ["hdr", "pictures/000000.jpg", "--out", f"{OUT}/merged.tif", "--overwrite"],
    "hdr-light": ["hdr", "pictures/000000.jpg", "--out", f"{OUT}/merged.exr", "--overwrite"],
    "preview": ["preview", "pictures/000000.jpg", "--out", f"{OUT}/stages.jpg", "--count", "1", "--overwrite"],
    "submit": ["submit", "sidd:sidd", f"{OUT}/SubmitRaw.csv", "--denoiser", "denoiser.safetensors", "--overwrite"],
    "judge": ["judge", "clear.dng", "--denoisers", "[Wavelet]", "--noise", "[1e-3, 1e-5]", "--json",
              f"{OUT}/judged.json", "--picture", f"{OUT}/judged.png", "--overwrite"],
    "export": ["export", "denoiser.safetensors", f"{OUT}/denoiser.onnx", "--overwrite"],
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
    from scipy.io import savemat

    import denoisers
    from rawaug.bayer import CFA
    from rawaug.data.sidd_scenes import HELD_BACK
    from rawaug.io import write_dng

    (folder / "shots").mkdir()
    write_pictures(folder / "pictures", 4, (96, 128))
    generator = torch.Generator().manual_seed(0)
    for k in range(4):
        coarse = torch.rand(1, 1, 8, 8, generator=generator)
        light = torch.nn.functional.interpolate(coarse, (96, 128), mode="bilinear")[0]
        mosaic = light * 0.6 + 0.03 * torch.randn(1, 96, 128, generator=generator).abs()
        write_dng(folder / "shots" / f"{k}.dng", small_frame(mosaic, CFA.RGGB))
    light = torch.linspace(0.1, 0.6, 512).expand(1, 384, 512)
    clear = light + (1e-3 * light + 1e-5).sqrt() * torch.randn(light.shape, generator=generator)
    write_dng(folder / "clear.dng", small_frame(clear, CFA.RGGB))

    (folder / "sidd").mkdir()
    blocks = torch.rand(40, 32, 16, 16, generator=generator).numpy()  # as published, but of 16 x 16
    savemat(folder / "sidd" / "BenchmarkNoisyBlocksRaw.mat", {"BenchmarkNoisyBlocksRaw": blocks})
    header = "scene_instance_id, beta1_r, beta2_r, beta1_g, beta2_g, beta1_b, beta2_b\n"
    levels = [f"{name}, {', '.join(['1e-3, 1e-5'] * 3)}\n" for name in HELD_BACK]
    (folder / "sidd" / "noise_level_functions.csv").write_text(header + "".join(levels))
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
    import OpenImageIO

    from rawaug.files import read_tensors

    found: Files = {}
    for file in sorted(folder.rglob("*")):
        name = str(file.relative_to(folder))
        if not file.is_file() or file.suffix in LEFT_OUT:
            continue
        if file.suffix == ".safetensors":
            tensors = read_tensors(file, "it is damaged", infinite=("colour.spread",))[1]
            found[name] = {key: (value.shape, value.numpy().tobytes()) for key, value in tensors.items()}
        elif file.suffix == ".exr":  # holds the time
            pixels = OpenImageIO.ImageBuf(str(file)).get_pixels(OpenImageIO.HALF)
            assert pixels is not None, file
            found[name] = pixels.tobytes()
        elif file.name in ("scores.json", "judged.json"):  # say how long each denoiser took
            found[name] = re.sub(rb'"seconds": [\d.]+', b"", file.read_bytes())
        else:
            found[name] = file.read_bytes()
    return found


def fresh(folder: Path) -> Path:
    """The folder without what a run wrote."""
    shutil.rmtree(folder / OUT, ignore_errors=True)
    return folder


def torn(folder: Path) -> list[str]:
    """The files of a folder that are cut short, among those that are not compared."""
    names = []
    for file in sorted(folder.rglob("*")):
        if file.suffix not in ENDS or not file.is_file():
            continue
        content = file.read_bytes().rstrip(b" \n")
        if content and not content.endswith(ENDS[file.suffix].rstrip(b"\n")):
            names.append(str(file.relative_to(folder)))
    return names


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
    if status not in (0, -number, 128 + number) or "Traceback" in child.said():
        return f"{name}, {number.name} after {delay:.2f} s: status {status}: {child.said()}"
    if not differences(folder / OUT, whole):
        return None  # it had written everything before the signal came, and fit does not replace a file

    again = Child(folder, COMMANDS[name])
    if (status := again.wait()) or "Traceback" in again.said():
        return f"{name}, {number.name} after {delay:.2f} s, run again: status {status}: {again.said()}"
    different = differences(folder / OUT, whole)
    return f"{name}, {number.name} after {delay:.2f} s: {', '.join(different)} differ" if different else None


def differences(folder: Path, whole: Files) -> list[str]:
    """The files that are not those of the run that was left alone, and those that are cut short."""
    after = contents(folder)
    return sorted(key for key in whole.keys() | after.keys() if whole.get(key) != after.get(key)) + torn(folder)


def kills(folder: Path, name: str, count: int, seed: int, whole: Files, seconds: float) -> list[str]:
    """What went wrong with ``count`` kills of a command."""
    moments = random.Random(f"{seed} {name}")
    outcomes = (
        killed(folder, name, SIGNALS[k % len(SIGNALS)], moments.uniform(0, seconds), whole) for k in range(count)
    )
    return [outcome for outcome in outcomes if outcome]


# -- full disks --------------------------------------------------------------------------------------------------------


@contextmanager
def disk(folder: Path, size: int) -> Iterator[None]:
    """A disk of this size, in bytes, at ``folder``; PermissionError for others than root."""
    folder.mkdir(parents=True, exist_ok=True)
    mount = ["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", str(folder)]
    if subprocess.run(mount, capture_output=True, check=False).returncode:
        raise PermissionError("a disk of its own needs root")
    try:
        yield
    finally:
        subprocess.run(["umount", str(folder)], check=True)


def full_disk(folder: Path, name: str, share: float, whole: Files, size: int) -> str | None:
    """What went wrong on a disk with this share of the bytes that a command needs; None if nothing did."""
    label = f"{name}, {share:.0%} of a disk"
    with disk(fresh(folder) / OUT, size + ROOM):
        filler = folder / OUT / "filler"
        filler.write_bytes(bytes(int((1 - share) * size) + ROOM))
        child = Child(folder, COMMANDS[name])
        status = child.wait()
        filler.unlink()
        if status not in (0, 2) or "Traceback" in child.said():
            return f"{label}: status {status}: {child.said()}"
        left = contents(folder / OUT)
        cut = [key for key in left.keys() & whole.keys() if left[key] != whole[key]] + torn(folder / OUT)
        if cut or (status == 0 and left.keys() < whole.keys()):
            return f"{label}: status {status}, {', '.join(cut)} torn: {child.said()}"

        again = Child(folder, COMMANDS[name])
        if (status := again.wait()) or "Traceback" in again.said():
            return f"{label}, run again: status {status}: {again.said()}"
        different = differences(folder / OUT, whole)
        return f"{label}: {', '.join(different)} differ" if different else None


def full_disks(folder: Path, name: str, count: int, seed: int, whole: Files) -> list[str]:
    """What went wrong on ``count`` disks that a command fills."""
    size = sum(file.stat().st_size for file in (folder / OUT).rglob("*") if file.is_file())
    shares = random.Random(f"{seed} {name} disk")
    outcomes = (full_disk(folder, name, shares.random(), whole, size) for _ in range(count))
    return [outcome for outcome in outcomes if outcome]


def main(arguments: list[str] | None = None) -> int:
    cli = parser(__doc__)
    cli.add_argument("--kills", type=int, default=20, help="of each command")
    cli.add_argument("--disks", type=int, default=20, help="of each command")
    cli.add_argument("--seed", type=int, default=0)
    cli.add_argument("--commands", nargs="+", choices=COMMANDS, default=list(COMMANDS))
    cli.add_argument("--quick", action="store_true", help="one kill and one full disk of each command")
    args = cli.parse_args(arguments)
    torch.set_num_threads(1)
    kill_count, disk_count = (1, 1) if args.quick else (args.kills, args.disks)
    failures = list[str]()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        make_inputs(folder)
        for command in args.commands:
            whole, seconds = uninterrupted(folder, command)
            try:
                wrong = full_disks(folder, command, disk_count, args.seed, whole)
                disks = f"{disk_count} full disks, {len(wrong)} wrong"
            except PermissionError as error:
                wrong, disks = [], f"no full disk ({error})"
            failures += wrong
            wrong = kills(folder, command, kill_count, args.seed, whole, seconds)
            print(f"{command:9} {seconds:5.1f} s  {kill_count} kills, {len(wrong)} wrong; {disks}", flush=True)
            failures += wrong
    print(*failures, sep="\n", end="")
    return int(bool(failures))


if __name__ == "__main__":
    sys.exit(main())
