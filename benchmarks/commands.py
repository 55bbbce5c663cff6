"""The commands on a damaged file, as a user would type them: status 0, or status 2 and one line on stderr."""

from __future__ import annotations

import contextlib
import io
import re
import shutil
from collections.abc import Sequence
from pathlib import Path

NOT_A_NUMBER = re.compile(r"(?<![\w.])[-+]?(nan|inf)(?![\w.])", re.IGNORECASE)
_FIT = ["--steps", "2", "--curve-steps", "2", "--pixels", "1024", "--batch", "64"]
_SYNTH = ["--workers", "0", "--noise", "[0.001, 1e-5]"]


def commands(kind: str, path: Path) -> list[list[str]]:
    """The command lines that read a file of this kind; the whole files that they need too are two folders above."""
    whole, out, file = path.parents[1], _out(path), str(path)
    isp, denoiser, dng = (f"{whole / name}" for name in ("isp.safetensors", "denoiser.safetensors", "own.dng"))
    if kind == "dng":
        return [
            ["fit", file, "--out", f"{out}/camera.safetensors", *_FIT],
            ["evaluate", isp, "--data", file],
            ["denoise", file, f"{out}/denoised.dng", "--denoiser", denoiser],
        ]
    if kind in ("jpeg", "picture"):
        return [["synth", f"{path.parent}", f"{out}/pairs", *_SYNTH]]
    if kind == "npy":
        return [["data", "check", f"{path.parent}"], ["evaluate", isp, "--data", f"rawir:{path.parent}"]]
    if kind == "safetensors" and path.stem.startswith("denoiser"):
        evaluate = ["evaluate", file, "--data", dng, "--noise", "[0.001, 1e-5]"]
        return [["info", file, "--json"], evaluate, ["denoise", dng, f"{out}/d.dng", "--denoiser", file]]
    if kind == "safetensors" and path.stem.startswith("isp"):
        return [["info", file, "--json"], ["evaluate", file, "--data", dng]]
    return []


def run(argv: Sequence[str]) -> tuple[str, str]:
    """``read``, ``refused`` or ``fault``, and why: what became of one command line."""
    from rawaug.cli import main

    said, wrong = io.StringIO(), io.StringIO()
    command = " ".join(argv[:2])
    try:
        with contextlib.redirect_stdout(said), contextlib.redirect_stderr(wrong):
            status = main([*argv, "--quiet"])
    except SystemExit as end:
        return "fault", f"{command}: exits with {end.code}: {wrong.getvalue()[-200:]!r}"
    except Exception as error:
        import traceback

        last = traceback.extract_tb(error.__traceback__)[-1]
        return "fault", f"{command}: {type(error).__name__} in {Path(last.filename).name}:{last.lineno}: {error}"
    lines = [line for line in wrong.getvalue().splitlines() if line.startswith("rawaug: ")]
    if status == 2 and len(lines) == 1:
        return "refused", lines[0]
    if status:
        return "fault", f"{command}: status {status}, {len(lines)} lines: {wrong.getvalue()[-200:]!r}"
    if number := NOT_A_NUMBER.search(said.getvalue()):
        return "fault", f"{command}: {number.group()} in a result, and status 0"
    return "read", ""


def run_all(kind: str, path: Path) -> tuple[str, str]:
    """The worst of what became of every command on this file."""
    found = []
    for argv in commands(kind, path):
        _out(path).mkdir()
        found.append(run(argv))
        shutil.rmtree(_out(path))
    return min(found, key=lambda one: ("fault", "refused", "read").index(one[0]), default=("read", ""))


def _out(path: Path) -> Path:
    return path.parents[1] / f"{path.stem}-out"
