"""How the readers handle damaged files: each must be read, or refused in one line that names it.

    python -m benchmarks.fuzz [--cases 10000] [--seed 0] [--kinds dng mat5 ...] [--quick] [--keep FOLDER] [--json FILE]

Small files of every kind are made first; real camera files take part where RAWAUG_SHARED, or shared/data beside the
repository, has them. Half of the mutations know the structure of the file (benchmarks/mutations.py); the others flip
bits, cut the file short, overwrite numbers, exchange or repeat pieces (benchmarks/damage.py); all are keyed by (seed,
kind, number). The helper process of :mod:`rawaug.io.isolated` reads one after the other, every eighth by the commands
too, and is restarted when a decoder takes it down. Counted are files that were read; that were refused as documented
(ValueError or OSError of one line with the file's name); that crashed a decoder, by its name, which the package
contains; and what must not be: other exceptions and numbers that are not finite, more than 10 s of a processor (60 with
commands), more than 2 GiB. Exit status 1 if there is any of the last three. ``--keep`` keeps all files but those of the
first two columns. Linux only.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.attempts import attempt
from benchmarks.damage import make_originals, mutated
from benchmarks.mutations import MUTATIONS
from rawaug.io.isolated import isolated
from rawaug.seeding import derived_seed

WAITING_SECONDS = 240
"""For a file, which may have to wait for a processor."""
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

BY_COMMANDS = 8
"""Of so many files one is read by the commands as well."""
OUTCOMES = ("read", "refused", "crashed", "fault", "hung", "memory")
FORBIDDEN = OUTCOMES[3:]


def judged(kind: str, path: Path, by_commands: bool) -> tuple[str, str]:
    """What became of a file: one of :data:`OUTCOMES`, and why."""
    try:
        return isolated(attempt, path, kind, by_commands)
    except OSError as error:  # of the helper
        text = str(error)
        hung = "SIGXCPU" in text or "cannot be read within" in text
        return ("hung", text) if hung else ("crashed", f"{DECODERS[kind]}: {text}")


def fuzz(kinds: list[str], count: int, seed: int, keep: Path | None) -> dict[str, Any]:
    """By kind: how often each outcome, the slowest file in seconds, and why, of all but the first two outcomes."""
    results: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        originals = make_originals(folder)
        wanted = [kind for kind in kinds if originals[kind]]
        shares = np.diff(np.linspace(0, count, len(wanted) + 1).round().astype(int)).tolist()
        for kind, share in zip(wanted, shares, strict=True):
            results[kind] = _fuzz_kind(kind, originals[kind], share, seed, folder / kind, keep)
            failures = sum(results[kind][outcome] for outcome in FORBIDDEN)
            print(f"{kind}: {failures} failures", file=sys.stderr, flush=True)
    return results


def _fuzz_kind(
    kind: str, originals: list[Path], count: int, seed: int, folder: Path, keep: Path | None
) -> dict[str, Any]:
    folder.mkdir()
    for original in originals:
        copy = _placed(original, folder, "whole", original.read_bytes())
        if (result := judged(kind, copy, by_commands=True))[0] != "read":
            raise ValueError(f"{original}: intact, but was {result[0]} ({result[1]})")
        _empty(folder)
    outcomes, reasons, slowest = Counter[str](), [], 0.0
    for number in range(count):
        rng = np.random.default_rng(derived_seed(seed, kind, number))
        original = originals[number % len(originals)]
        path = _placed(original, folder, str(number), _damaged(original, rng))
        start = time.perf_counter()
        outcome, why = judged(kind, path, by_commands=number % BY_COMMANDS == 0)
        slowest = max(slowest, time.perf_counter() - start)
        outcomes[outcome] += 1
        if outcome not in OUTCOMES[:2]:
            reasons.append(f"{number}: {outcome}: {why}")
            if keep is not None:
                keep.mkdir(parents=True, exist_ok=True)
                shutil.copy(path, keep / f"{kind}-{path.name}")
        _empty(folder)
    counted = {outcome: outcomes[outcome] for outcome in OUTCOMES}
    return {"mutated": count, **counted, "slowest_s": round(slowest, 2), "reasons": reasons}


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
    parser.add_argument("--json", type=Path, help="write the figures to this file")
    args = parser.parse_args(arguments)
    os.environ["RAWAUG_READ_SECONDS"] = str(WAITING_SECONDS)
    start = time.perf_counter()
    results = fuzz(args.kinds, 100 if args.quick else args.cases, args.seed, args.keep)
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
