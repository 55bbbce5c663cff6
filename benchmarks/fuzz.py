"""How the readers handle hostile files: each must be read, or refused in one line that names it.

    python -m benchmarks.fuzz [--cases 10000] [--seed 0] [--kinds dng mat5 ...] [--quick] [--keep FOLDER] [--json FILE]

Small files of every kind are made and damaged (benchmarks/damage.py), half of some as their structure suggests, keyed
by (seed, kind, number); real camera files take part where RAWAUG_SHARED, or shared/data beside the repository, has
them. The helper process of :mod:`rawaug.io.isolated` reads one after the other. Counted are files that were read; that
were refused as documented (ValueError or OSError of one line with the file's name); that crashed a decoder, which the
package contains; and what must not be: other exceptions and numbers that are not finite, more than 10 s of a processor,
more than 2 GiB. Exit status 1 if there is any of the last three. ``--keep`` keeps all files but those of the first two
columns. Linux only.
"""

from __future__ import annotations

import json
import os
import re
import resource
import shutil
import signal
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch

import denoisers
from benchmarks.damage import IMPORTED, IRREGULAR, MUTATIONS, make_originals, mutated
from benchmarks.measure import parser
from rawaug import DictionaryISP
from rawaug.commands.info import describe_file
from rawaug.commands.run import with_values
from rawaug.data.formats import read_mosaic
from rawaug.data.mat import read_value
from rawaug.data.published import read_packed
from rawaug.data.sidd_scenes import read_sidd_colour, read_sidd_mosaic
from rawaug.evaluation.tables import print_rows
from rawaug.experiment.recipe import find_kind, find_settings, read_recipe
from rawaug.experiment.settings import Recipe
from rawaug.io import RawFrame, read_picture, read_raw, read_raw_and_develop, write_dng
from rawaug.io.isolated import isolated
from rawaug.plugin.params import load_params
from rawaug.seeding import derive_seed
from rawaug.training.state import first_network

WAITING_SECONDS = 240
"""For a file, which may have to wait for a processor."""
DECODERS = {
    "picture": "OpenImageIO", "npy": "NumPy", "mat5": "SciPy", "mat73": "HDF5",
    "pair": "tifffile", "safetensors": "safetensors", "recipe": "PyYAML", "dng": "LibRaw", "raw": "LibRaw",
}  # fmt: skip
"""What reads each kind for us, the cheapest first."""

IRREGULAR_SHARE = 0.05
"""Of the files, those in whose place a pipe, a link to itself or an endless device lies."""
OUTCOMES = ("read", "refused", "crashed", "fault", "hung", "memory")
FORBIDDEN = OUTCOMES[3:]
SECONDS, MEBIBYTES = 10, 2048
"""Of a processor, and of memory, that a file may take."""


def readers(kind: str, path: Path) -> list[Callable[[], object]]:
    """Every reader in the package for this kind of file."""

    def frame_of() -> RawFrame:
        frame = read_raw(path)
        numbers = [*frame.white_balance, *frame.daylight, *(frame.noise_profile or ()), frame.white, *frame.black]
        for tensor in (frame.mosaic, frame.color_matrix, *(m.gains for m in frame.gain_maps), torch.tensor(numbers)):
            if not tensor.isfinite().all():
                raise ArithmeticError(f"not finite: {tensor.flatten()[:20].tolist()}")
        return frame

    def isp_of(path: Path) -> None:
        raw = DictionaryISP.from_pretrained(path).reverse(torch.linspace(0, 1, 192).reshape(1, 3, 8, 8)).raw
        if not raw.isfinite().all():
            raise ArithmeticError("not finite: RAW of this ISP")

    def rewritten() -> None:
        frame = frame_of()
        write_dng(path.with_name(f"{path.stem}.out.dng"), frame, source=path)

    if kind == "raw":
        return [frame_of]
    if kind == "dng":
        return [lambda: read_raw_and_develop(path), rewritten]
    if kind == "picture":
        return [lambda: read_picture(path)]
    if kind == "recipe":
        return [lambda: _set_up(path)]
    if kind == "pair":
        return [lambda: read_mosaic(path, "noisy", {}, path.suffix == ".npz")]
    if kind == "npy":
        return [lambda: read_packed(path, path.with_suffix(".png"), None)]
    if kind != "safetensors":
        values = [lambda name=name: read_value(path, name) for name in ("cells", "text")]
        return [lambda: read_sidd_mosaic(path), lambda: read_sidd_colour(path), *values]
    load = {"isp": isp_of, "denoiser": denoisers.load, "params": load_params}
    kept = path.stem.split("-")[0]
    return [lambda: load[kept](path), *([lambda: describe_file(path)] if kept != "params" else [])]


def _set_up(path: Path) -> None:
    """A recipe as the command line sets it up, its networks without their memory."""
    content = read_recipe(path)
    recipe = with_values(find_settings(find_kind(content, path)), content, path)
    try:
        if isinstance(recipe, Recipe):
            with torch.device("meta"):
                for arm in recipe.arms:
                    first_network(recipe.network(arm), seed=0)
    except (ValueError, FileNotFoundError) as error:  # the command line has named the file already
        raise ValueError(f"{path}: {' '.join(str(error).split())}") from error


def read(kind: str, path: Path) -> tuple[str, str]:
    """``read``, ``refused`` or ``fault``, and why: what became of a file by its readers."""
    outcome = "read", ""
    for reader in readers(kind, path):
        try:
            reader()
        except (ValueError, OSError) as error:
            text = str(error)
            if "\n" in text or path.stem not in text:
                return "fault", f"{type(error).__name__} without name, or of many lines: {text!r}"
            outcome = "refused", text
        except Exception as error:
            return "fault", _described(error)
    return ("fault", "a name in the file was imported") if IMPORTED in sys.modules else outcome


def _described(error: Exception) -> str:
    last = traceback.extract_tb(error.__traceback__)[-1]
    return f"{type(error).__name__} in {Path(last.filename).name}:{last.lineno}: {error}"


# -- in the helper process ---------------------------------------------------------------------------------------------


def attempt(path: Path, kind: str) -> tuple[str, str]:
    """Read a file, and judge what became of it, and what it took of a processor and of memory."""
    _silence()
    before = time.process_time()
    resource.setrlimit(resource.RLIMIT_CPU, (int(before) + 2 * SECONDS, resource.RLIM_INFINITY))  # SIGXCPU ends a hang
    Path("/proc/self/clear_refs").write_text("5")  # forget the peak

    outcome = read(kind, path)

    status = Path("/proc/self/status").read_text()
    peak = int(re.findall(r"VmHWM:\s*(\d+)", status)[0]) / 1024
    if peak > MEBIBYTES:
        return "memory", f"{peak:.0f} MiB"
    if time.process_time() - before > SECONDS:
        return "hung", f"more than {SECONDS} s of a processor"
    return outcome


@cache
def _silence() -> None:
    """What decoders print is not of interest."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    for stream in (1, 2):
        os.dup2(nowhere, stream)
    warnings.simplefilter("ignore")
    signal.signal(signal.SIGXCPU, signal.SIG_DFL)


# -- all of them -------------------------------------------------------------------------------------------------------


def judged(kind: str, path: Path) -> tuple[str, str]:
    """What became of a file: one of :data:`OUTCOMES`, and why."""
    try:
        return isolated(attempt, path, kind)
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
    for original in originals:
        copy = _placed(original, folder, "whole", original.read_bytes())
        if (result := judged(kind, copy))[0] != "read":
            raise ValueError(f"{original}: intact, but was {result[0]} ({result[1]})")
    outcomes, reasons, slowest = Counter[str](), [], 0.0
    for number in range(count):
        rng = np.random.default_rng(derive_seed(seed, kind, number))
        original = originals[number % len(originals)]
        path = _placed(original, folder, str(number), _damaged(original, rng))
        if rng.random() < IRREGULAR_SHARE:
            path.unlink()
            IRREGULAR[int(rng.integers(len(IRREGULAR)))](path)
        start = time.perf_counter()
        outcome, why = judged(kind, path)
        slowest = max(slowest, time.perf_counter() - start)
        outcomes[outcome] += 1
        if outcome not in OUTCOMES[:2]:
            reasons.append(f"{number}: {outcome}: {why}")
            if keep is not None and path.is_file():
                keep.mkdir(parents=True, exist_ok=True)
                shutil.copy(path, keep / f"{kind}-{path.name}")
    counted = {outcome: outcomes[outcome] for outcome in OUTCOMES}
    return {"mutated": count, **counted, "slowest_s": round(slowest, 2), "reasons": reasons}


def _placed(original: Path, folder: Path, label: str, content: bytes) -> Path:
    """A file like the original with this content, alone in the folder but for its picture where it needs one."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    path = folder / f"{original.stem.split('.')[0]}-{label}{original.suffix}"
    path.write_bytes(content)
    if original.suffix == ".npy":
        path.with_suffix(".png").write_bytes(original.with_suffix(".png").read_bytes())
    return path


def _damaged(original: Path, rng: np.random.Generator) -> bytes:
    """The file mutated, in half of the cases as its structure suggests."""
    whole = original.read_bytes()
    mutate = next((mutate for end, mutate in MUTATIONS.items() if original.name.endswith(end)), None)
    return mutated(whole, rng) if mutate is None or rng.random() < 0.5 else mutate(whole, rng)


def print_table(results: dict[str, Any]) -> None:
    columns = ("mutated", *OUTCOMES, "slowest_s")
    rows = [[kind, DECODERS[kind], *(str(row[name]) for name in columns)] for kind, row in results.items()]
    print_rows("Hostile files", ["kind", "decoder", *columns], rows)
    print("\n".join(f"{kind}: {reason}" for kind, row in results.items() for reason in row["reasons"]))


def main(arguments: list[str] | None = None) -> int:
    cli = parser(__doc__)
    cli.add_argument("--cases", type=int, default=10_000, help="files of all kinds together")
    cli.add_argument("--seed", type=int, default=0)
    cli.add_argument("--kinds", nargs="+", choices=DECODERS, default=list(DECODERS))
    cli.add_argument("--quick", action="store_true", help="40 files")
    cli.add_argument("--keep", type=Path, help="folder to keep the files that failed in")
    cli.add_argument("--json", type=Path, help="write the figures to this file")
    args = cli.parse_args(arguments)
    os.environ["RAWAUG_READ_SECONDS"] = str(WAITING_SECONDS)
    start = time.perf_counter()
    results = fuzz(args.kinds, 40 if args.quick else args.cases, args.seed, args.keep)
    print_table(results)
    absent = [kind for kind in args.kinds if kind not in results]
    print(f"{time.perf_counter() - start:.0f} s; kinds without files: {', '.join(absent) or 'none'}")
    if args.json:
        args.json.write_text(json.dumps({"seed": args.seed, "kinds": results}, indent=1) + "\n", encoding="utf-8")
    return int(any(row[outcome] for row in results.values() for outcome in FORBIDDEN))


if __name__ == "__main__":
    from benchmarks import fuzz as importable  # for the helper process, which knows no __main__

    sys.exit(importable.main())
