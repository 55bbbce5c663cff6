"""How the readers handle damaged files: each must be read, or refused in one line that names it.

    python -m benchmarks.fuzz [--cases 10000] [--seed 0] [--kinds dng mat5 ...] [--quick] [--keep FOLDER]
                              [--journal FILE] [--json FILE]

Small files of every kind are made first; real camera files take part where RAWAUG_SHARED, or shared/data beside the
repository, has them. Half of the mutations know the structure of the file (benchmarks/mutations.py); the others flip
bits, cut the file short, overwrite numbers, exchange or repeat pieces (benchmarks/damage.py); all are keyed by (seed,
kind, number). A worker process reads one after the other, every eighth by the commands too,
and is restarted when a decoder takes it down. Counted are files that were read; that were refused as documented
(ValueError or OSError of one line with the file's name); that crashed a decoder, by its name, which the package
contains (:mod:`rawaug.io.isolated`); and what must not be: other exceptions and numbers that are not finite, more than
10 s of a processor (60 with commands), more than 2 GiB. Exit status 1 if there is any of the last three. ``--keep``
keeps all files but those of the first two columns; a run with ``--journal`` that was stopped goes on where it was.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import multiprocessing
import os
import shutil
import signal
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from benchmarks.attempts import work
from benchmarks.damage import make_originals, mutated
from benchmarks.mutations import MUTATIONS
from rawaug.seeding import derived_seed

SECONDS, WAITING_SECONDS, MEBIBYTES = 10.0, 120.0, 2048.0
"""Of a processor for a file, of a wait for it, and of memory."""
START_SECONDS = 600.0
DECODERS = {
    "picture": "OpenImageIO",
    "jpeg": "OpenImageIO",
    "npy": "NumPy",
    "mat5": "SciPy",
    "mat73": "HDF5",
    "safetensors": "safetensors",
    "recipe": "PyYAML",
    "dng": "LibRaw",
    "raw": "LibRaw",
}
"""What reads each kind for us, the cheapest first."""

BY_COMMANDS, COMMANDS_COST = 8, 6
"""Of so many files one is read by the commands as well, and then has so many times the seconds."""

IMPORTED = ["rawaug.experiment.kinds", "rawaug.training.camera", "rawaug.plugin.dataset", "lightning_fabric"]
"""What the readers and commands need, in whole."""
OUTCOMES = ("read", "refused", "crashed", "fault", "hung", "memory")
FORBIDDEN = OUTCOMES[3:]


class Worker:
    """A process that reads files, each in at most ``seconds``, restarted after a crash or a fault."""

    def __init__(self, folder: Path, seconds: float = WAITING_SECONDS) -> None:
        self.log, self.seconds = folder / "stderr.txt", seconds
        self.process: Any = None
        self.asked: Any = None

    def read(self, kind: str, path: Path, by_commands: bool = False) -> tuple[str, str]:
        """What became of a file, read by readers alone or by commands too: one of OUTCOMES, and why."""
        process = self.process or self._start()
        _forget_peak(process.pid)
        with contextlib.suppress(ConnectionError):  # it may have died since
            self.asked.send((kind, str(path), by_commands))
        allowed = SECONDS * (COMMANDS_COST if by_commands else 1)
        end, busy = time.monotonic() + self.seconds, _processor_seconds(process.pid) + allowed
        answered = False
        while not answered and time.monotonic() < end and _processor_seconds(process.pid) < busy:
            if _peak_mebibytes(process.pid) >= MEBIBYTES:
                break
            answered = self.asked.poll(0.05)
        peak = _peak_mebibytes(process.pid)
        if answered and peak < MEBIBYTES:
            with contextlib.suppress(EOFError, ConnectionError):
                outcome, why = self.asked.recv()
                return outcome, why
        self.stop()
        if peak >= MEBIBYTES:
            return "memory", f"{peak:.0f} MiB"
        if not answered:
            return "hung", f"more than {allowed:g} s of a processor, or {self.seconds:g} s in all"
        name = signal.Signals(-process.exitcode).name if process.exitcode < 0 else f"status {process.exitcode}"
        return "crashed", f"{DECODERS[kind]}: {name} in {_innermost(self.log)}"

    def _start(self) -> Any:
        """Forked from a server that has imported the readers once, so that a crash costs no second start."""
        multiprocessing.set_forkserver_preload(IMPORTED)
        context = multiprocessing.get_context("forkserver")
        self.asked, theirs = context.Pipe()
        self.process = context.Process(target=work, args=(theirs, str(self.log)), daemon=True)
        self.process.start()
        theirs.close()
        with contextlib.suppress(EOFError):  # it ended
            if self.asked.poll(START_SECONDS):
                self.asked.recv()
                return self.process
        self.process.kill()
        said = self.log.read_text()[-500:] if self.log.is_file() else "it wrote nothing"
        raise OSError(f"the reader process failed to start: {said}")

    def stop(self) -> None:
        """End the process, if there is one."""
        if self.process is not None:
            self.asked.close()
            self.process.join(1)
            if self.process.is_alive():
                self.process.kill()
            self.process.join()
            self.process = None


def _processor_seconds(process: int) -> float:
    """What a process has used of the processors, which other programs on the machine do not lengthen; 0 if unknown."""
    try:
        fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return 0.0
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def _forget_peak(process: int) -> None:
    peak = Path(f"/proc/{process}/clear_refs")
    if peak.exists():
        peak.write_text("5")


def _peak_mebibytes(process: int) -> float:
    """Peak of resident memory since :func:`_forget_peak`; 0 where unavailable."""
    try:
        status = Path(f"/proc/{process}/status").read_text()
    except OSError:
        return 0.0
    return next((int(line.split()[1]) / 1024 for line in status.splitlines() if line.startswith("VmHWM")), 0.0)


def _innermost(log: Path) -> str:
    """Where Python was when a decoder crashed, from faulthandler's log."""
    lines = (line.strip() for line in log.read_text(errors="replace").splitlines())
    return next((line for line in lines if line.startswith("File ")), "unknown location")


# -- the run ----------------------------------------------------------------------------------------------------------


class Case(NamedTuple):
    """One mutated file and what became of it."""

    seed: int
    kind: str
    number: int
    outcome: str
    why: str
    seconds: float


class Journal:
    """The cases that were read so far, in a file with one line of JSON each, so that a stopped run goes on."""

    def __init__(self, path: Path | None) -> None:
        lines = path.read_text(encoding="utf-8").splitlines() if path is not None and path.is_file() else []
        self.path, self.cases = path, [Case(*json.loads(line)) for line in lines]
        self.known = {case[:3] for case in self.cases}

    def add(self, case: Case) -> None:
        """Add a case, in the file too."""
        self.cases.append(case)
        self.known.add(case[:3])
        if self.path is not None:
            with self.path.open("a", encoding="utf-8") as file:
                file.write(json.dumps(case) + "\n")


def fuzz(kinds: list[str], count: int, seed: int, keep: Path | None, journal: Journal) -> dict[str, Any]:
    """By kind: how often each outcome, the slowest file in seconds, and why, of all but the first two outcomes."""
    results: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        originals, worker = make_originals(folder), Worker(folder)
        wanted = [kind for kind in kinds if originals[kind]]
        shares = np.diff(np.linspace(0, count, len(wanted) + 1).round().astype(int)).tolist()
        try:
            for kind, share in zip(wanted, shares, strict=True):
                todo = [number for number in range(share) if (seed, kind, number) not in journal.known]
                if todo:
                    _fuzz_kind(kind, originals[kind], todo, seed, worker, folder / kind, keep, journal)
                cases = [c for c in journal.cases if c[:2] == (seed, kind) and c.number < share]
                row = results[kind] = _row(cases)
                print(f"{kind}: {sum(row[outcome] for outcome in FORBIDDEN)} failures", file=sys.stderr, flush=True)
        finally:
            worker.stop()
    return results


def _fuzz_kind(
    kind: str,
    originals: list[Path],
    numbers: list[int],
    seed: int,
    worker: Worker,
    folder: Path,
    keep: Path | None,
    journal: Journal,
) -> None:
    folder.mkdir()
    for original in originals:
        copy = _placed(original, folder, "whole", original.read_bytes())
        if (result := worker.read(kind, copy, by_commands=True))[0] != "read":
            raise ValueError(f"{original}: intact, but was {result[0]} ({result[1]})")
        _empty(folder)
    for number in numbers:
        rng = np.random.default_rng(derived_seed(seed, kind, number))
        original = originals[number % len(originals)]
        path = _placed(original, folder, str(number), _damaged(original, rng))
        start = time.perf_counter()
        outcome, why = worker.read(kind, path, by_commands=number % BY_COMMANDS == 0)
        if outcome not in ("read", "refused") and keep is not None:
            keep.mkdir(parents=True, exist_ok=True)
            shutil.copy(path, keep / f"{kind}-{path.name}")
        journal.add(Case(seed, kind, number, outcome, why, time.perf_counter() - start))
        _empty(folder)


def _placed(original: Path, folder: Path, label: str, content: bytes) -> Path:
    """A file like the original with this content, beside its picture where it needs one."""
    path = folder / f"{original.stem.split('.')[0]}-{label}{original.suffix}"
    path.write_bytes(content)
    if original.suffix == ".npy":
        path.with_suffix(".png").write_bytes(original.with_suffix(".png").read_bytes())
    return path


def _empty(folder: Path) -> None:
    for entry in folder.iterdir():
        shutil.rmtree(entry) if entry.is_dir() else entry.unlink()


def _row(cases: list[Case]) -> dict[str, Any]:
    outcomes = Counter(case.outcome for case in cases)
    reasons = [f"{case.number}: {case.outcome}: {case.why}" for case in cases if case.outcome not in OUTCOMES[:2]]
    slowest = round(max(case.seconds for case in cases), 2)
    return {"mutated": len(cases), **{o: outcomes[o] for o in OUTCOMES}, "slowest_s": slowest, "reasons": reasons}


def _damaged(original: Path, rng: np.random.Generator) -> bytes:
    """The file mutated, in half of the cases as its structure suggests."""
    whole = original.read_bytes()
    mutate = next((mutate for end, mutate in MUTATIONS.items() if original.name.endswith(end)), None)
    return mutated(whole, rng) if mutate is None or rng.random() < 0.5 else mutate(whole, rng)


def print_table(results: dict[str, Any]) -> None:
    columns = ("mutated", *OUTCOMES, "slowest_s")
    print("kind         decoder      " + "".join(name.rjust(10) for name in columns))
    for kind, row in results.items():
        print(f"{kind:13}{DECODERS[kind]:13}" + "".join(str(row[name]).rjust(10) for name in columns))
    for kind, row in results.items():
        for reason in row["reasons"]:
            print(f"{kind}: {reason}")


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", type=int, default=10_000, help="files of all kinds together")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--kinds", nargs="+", choices=DECODERS, default=list(DECODERS))
    parser.add_argument("--quick", action="store_true", help="100 files")
    parser.add_argument("--keep", type=Path, help="folder to keep the files that failed in")
    parser.add_argument("--journal", type=Path, help="file to go on from: what it lists is not read again")
    parser.add_argument("--json", type=Path, help="write the figures to this file")
    args = parser.parse_args(arguments)
    start = time.perf_counter()
    results = fuzz(args.kinds, 100 if args.quick else args.cases, args.seed, args.keep, Journal(args.journal))
    print_table(results)
    absent = [kind for kind in args.kinds if kind not in results]
    print(
        f"{time.perf_counter() - start:.0f} s" + (f"; no files of kind {', '.join(absent)} available" if absent else "")
    )
    if args.json:
        args.json.write_text(json.dumps({"seed": args.seed, "kinds": results}, indent=1) + "\n", encoding="utf-8")
    return int(any(row[outcome] for row in results.values() for outcome in FORBIDDEN))


if __name__ == "__main__":
    sys.exit(main())
