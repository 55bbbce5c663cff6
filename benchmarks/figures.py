r"""What was measured, for the pages that show it: ``docs/figures.json``.

    python -m benchmarks.strengths TABLE.json rawaug-base PBRID.safetensors --sets real:test demo:test
    python -m benchmarks.figures strengths TABLE.json --plot docs/cost.png "demo test, strong"

A set of figures has a name, the command, commit, machine and seed it comes from, its frames, and the SHA-256 of the
shipped networks among its columns. Figures are texts by row and column, as pages show them. ``RESULT.json`` is what
``rawaug benchmark``, ``benchmarks.bracket``, ``.strengths`` or ``.strong_pictures`` wrote; others call :func:`record`.
``python .ci/figures.py`` then puts the figures into the pages, and a test fails when a network is no longer the one
that was measured.

A row of drawn noise has the mean PSNR over frames, RAW / developed sRGB, bold where a denoiser is ahead of every other
one by paired differences, of PBRID, too. Two more rows have the mean difference to PBRID in RAW and its 95 % interval,

.. math:: d_n = \mathrm{PSNR}_n - \mathrm{PSNR}^\mathrm{PBRID}_n .
"""

from __future__ import annotations

import json
import math
import subprocess
from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import fmean, median
from typing import Any

import numpy as np
import torch
from scipy import stats

from benchmarks.measure import machine, parser
from benchmarks.strengths import GUARD
from benchmarks.strong_pictures import KINDS
from denoisers.files import find_denoiser, list_shipped
from rawaug.evaluation.benchmark import TOLD
from rawaug.evaluation.figures import plot_costs
from rawaug.evaluation.verdict import paired_interval
from rawaug.files import sha256, write_text

FIGURES = Path(__file__).parents[1] / "docs" / "figures.json"
OWN_NOISE_OF = "rawaug-base"
REFERENCE = "PBRID"
"""The strongest published denoiser, to which differences are stated."""

NAMES = {"noisy input": "noisy", "pmrid": "PMRID", "bf_dncnn": "BF-DnCNN", "pbrid": "PBRID"}
"""Heads of columns, where a benchmark has another name."""

Scores = Mapping[str, Sequence[tuple[float, float]]]
"""PSNR of RAW and of sRGB on each frame, by denoiser."""


def record(
    name: str,
    figures: Mapping[str, Mapping[str, str]],
    command: str,
    frames: str,
    seed: int = 0,
    commit: str | None = None,
    networks: Mapping[str, str] | None = None,
    path: Path = FIGURES,
) -> None:
    """Write a set of figures into the file, in place of the one of this name.

    Args:
        name: the name of the set.
        figures: texts by row and column; a column with the name of a shipped network, or with more behind a comma, is
            that network.
        command: what measured them.
        frames: what they were measured on.
        seed: seed of the noise or of the training.
        commit: the commit that was run; by default the present one.
        networks: the SHA-256 of the networks among the columns; by default those of the shipped ones.
        path: the file.
    """
    if commit is None:
        commit = subprocess.check_output(
            ["git", "rev-parse", "--short=8", "HEAD"], text=True, cwd=FIGURES.parent
        ).strip()

    columns = {column for row in figures.values() for column in row}
    if networks is None:
        networks = {column: sha256(find_denoiser(column)) for column in list_shipped()}
    names = {column.partition(", ")[0] for column in columns}
    networks = {name: networks[name] for name in sorted(names & networks.keys())}

    sets = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
    sets[name] = {
        "command": command,
        "commit": commit,
        "machine": machine(torch.device("cpu"), torch.get_num_threads()),
        "seed": seed,
        "frames": frames,
        "networks": networks,
        "figures": figures,
    }
    write_text(json.dumps(dict(sorted(sets.items())), indent=1, ensure_ascii=False) + "\n", path)


def figures_of_drawn_noise(row: str, scores: Scores) -> dict[str, dict[str, str]]:
    """A row of means, bold where paired differences say so, and two rows of differences to PBRID."""
    figures: dict[str, dict[str, str]] = {row: {}, f"{row}, over {REFERENCE}": {}, f"{row}, its interval": {}}
    for name, frames in scores.items():
        cells = []
        for k in range(2):
            text = f"{fmean(frame[k] for frame in frames):.2f}"
            if REFERENCE in scores and _leads(name, scores, k):
                text = f"**{text}**"
            cells.append(text)
        figures[row][name] = " / ".join(cells)

        if REFERENCE in scores and name != REFERENCE:
            differences = _differences(scores, name, REFERENCE, 0)
            figures[f"{row}, over {REFERENCE}"][name] = f"{fmean(differences):+.2f}"
            if len(differences) > 1:
                low, high = paired_interval(differences)
                figures[f"{row}, its interval"][name] = f"{low:+.2f} to {high:+.2f}"
    return figures


def _leads(name: str, scores: Scores, k: int) -> bool:
    for other in scores:
        if other != name and paired_interval(_differences(scores, name, other, k))[0] <= 0:
            return False
    return True


def _differences(scores: Scores, name: str, other: str, k: int) -> list[float]:
    return [frame[k] - rival[k] for frame, rival in zip(scores[name], scores[other], strict=True)]


def figures_of_benchmark(result: Mapping[str, Any], frames: str) -> dict[str, dict[str, str]]:
    """The table of known levels of ``rawaug benchmark``, of the frames whose name begins with one of these words."""
    figures: dict[str, dict[str, str]] = {"GMAC": {}}
    by_strength: dict[str, dict[str, list[tuple[float, float]]]] = {}
    for name, row in result["rows"].items():
        column = _column(name)
        if row["gmac"]:
            figures["GMAC"][column] = f"{row['gmac']:.3g}"
        for strength, cell in row["scores"][TOLD].items():
            images = [image for image in cell["images"] if image["name"].startswith(tuple(frames.split()))]
            pairs = [(image["psnr"], image["psnr_srgb"]) for image in images]
            by_strength.setdefault(strength, {})[column] = pairs

    for strength, scores in by_strength.items():
        figures |= figures_of_drawn_noise(strength, scores)
    return figures


def figures_of_harm(harm: Mapping[str, Any]) -> dict[str, dict[str, str]]:
    """The table of ``rawaug benchmark --harm``: PSNR by condition, and the share of its flux that a light keeps."""
    figures: dict[str, dict[str, str]] = {}
    for name, row in harm.items():
        for condition, scores in row["frames"].items():
            figures.setdefault(condition, {})[_column(name)] = f"{scores['psnr']:.2f}"
        for width, psnr in row["fields"].items():
            figures.setdefault(f"field {width}", {})[_column(name)] = f"{psnr:.2f}"
        for width, shares in row["kept"].items():
            for place, share in shares.items():
                figures.setdefault(f"{width}, {place}", {})[_column(name)] = f"{100 * share:.0f}"
    return figures


def figures_of_strengths(table: Mapping[str, Any]) -> dict[str, dict[str, str]]:
    """The table of ``benchmarks.strengths`` at known levels, by row; a denoiser lacks no frame of its rows.

    *Own noise* is the share of the references' own noise in the squared error of :data:`OWN_NOISE_OF`.
    """
    by_row: dict[str, dict[str, list[tuple[float, float]]]] = {}
    own_noise: dict[str, list[float | None]] = {}
    for key, cells in table.items():
        if key == "GMAC":
            continue
        frames, condition, strength, frame = key.split(" | ")
        if condition != TOLD:
            continue
        groups = [_short(frames)]
        groups += [camera for camera in ("hero6", "hero7", "hero") if frame.startswith(camera)]
        for group in dict.fromkeys(groups):
            row = by_row.setdefault(f"{group}, {strength}", {})
            for name, (raw, srgb, own) in cells.items():
                row.setdefault(_column(name), []).append((raw, srgb))
                if name == OWN_NOISE_OF:
                    own_noise.setdefault(f"{group}, {strength}", []).append(own)

    figures: dict[str, dict[str, str]] = {"GMAC": {}}
    for name, gmac in table.get("GMAC", {}).items():
        if gmac is not None:
            figures["GMAC"][_column(name)] = f"{gmac:.3g}"

    for row_name, columns in by_row.items():
        most = max(map(len, columns.values()))
        scores = {name: frames for name, frames in columns.items() if len(frames) == most}
        figures |= figures_of_drawn_noise(row_name, scores)
        shares = [share for share in own_noise.get(row_name, []) if share is not None]
        if shares:
            figures[row_name]["own noise"] = f"{100 * fmean(shares):.0f} %"
    return figures


def figures_of_bracket(result: Mapping[str, Any]) -> dict[str, dict[str, str]]:
    """The tables of ``benchmarks.bracket``, and by how much PBRID is ahead in the median over all blocks."""
    figures: dict[str, dict[str, str]] = {}
    errors: dict[str, list[float]] = {}
    for title, shot in result.items():
        if not isinstance(shot, Mapping) or "errors" not in shot:
            continue
        row = title.partition(" against")[0]
        scores = {_column(name): f"{raw:.2f} / {srgb:.2f}" for name, (raw, srgb) in shot["scores"].items()}
        best_in = {_column(name): str(count) for name, count in shot["first in"].items()}
        winner = max(shot["first in"], key=lambda name: shot["first in"][name])
        if all(high < 0 for _, _, high in shot["gains"].values()):
            best_in[_column(winner)] = f"**{best_in[_column(winner)]}**"
        gains = {_column(name): gain for name, gain in shot["gains"].items()}
        figures[row] = scores
        figures[f"{row}, best in"] = best_in
        figures[f"{row}, over {_column(winner)}"] = {name: f"{gain[0]:+.2f}" for name, gain in gains.items()}
        figures[f"{row}, its interval"] = {name: f"{gain[1]:+.2f} to {gain[2]:+.2f}" for name, gain in gains.items()}

        for name, blocks in shot["errors"].items():
            errors.setdefault(_column(name), []).extend(raw for raw, _ in blocks)

    for name, of_blocks in errors.items():
        gains_of_blocks = []
        for error, rival in zip(of_blocks, errors.get(REFERENCE, []), strict=False):
            if min(error, rival) > 0:
                gains_of_blocks.append(10 * math.log10(rival / error))
        if name == REFERENCE or not gains_of_blocks:
            continue
        interval = stats.bootstrap((gains_of_blocks,), np.median, method="percentile", rng=0).confidence_interval
        figures.setdefault(f"all blocks, {REFERENCE} ahead in", {})[name] = str(
            sum(gain < 0 for gain in gains_of_blocks)
        )
        figures.setdefault(f"all blocks, {REFERENCE} ahead by", {})[name] = f"{-median(gains_of_blocks):.2f}"
        ends = f"{-interval.high:.2f} to {-interval.low:.2f}"
        figures.setdefault("all blocks, its interval", {})[name] = ends
    return figures


def figures_of_strong_pictures(scores: Mapping[str, Mapping[str, Any]]) -> dict[str, dict[str, str]]:
    """The table of ``benchmarks.strong_pictures``, and by how much ours, blind and told 40, are ahead of all others."""
    figures: dict[str, dict[str, str]] = {}
    for kind in KINDS:
        for spec, by_kind in scores.items():
            decibels, similarity = zip(*by_kind[kind], strict=True)
            figures.setdefault(kind, {})[_told(spec)] = f"{fmean(decibels):.2f} / {fmean(similarity):.4f}"

            for ours, words in (("rawaug-srgb", "blind"), ("rawaug-srgb@40", "told 40")):
                if spec == ours or ours not in scores:
                    continue
                gains = [one[0] - other[0] for one, other in zip(scores[ours][kind], by_kind[kind], strict=True)]
                low, high = paired_interval(gains)
                cell = f"{fmean(gains):+.2f} ({low:+.2f} to {high:+.2f})"
                figures.setdefault(f"{kind}, {words} ahead", {})[_told(spec)] = cell
    return figures


def _told(spec: str) -> str:
    """The name of a denoiser of pictures in a table: ``FFDNet+refill@25`` is *FFDNet, refilled, told 25*."""
    name, _, level = spec.partition("@")
    name = Path(name).name.replace("ffdnet_color.safetensors", "FFDNet").replace("+refill", ", refilled")
    return f"{name}, told {level}" if level else name


def plot_row(figures: Mapping[str, Mapping[str, str]], row: str) -> bytes:
    """Plot the PSNR of a row over the operations of its denoisers, as PNG."""
    points: dict[str, tuple[float | None, float, float]] = {}
    for name, cell in figures[row].items():
        if name not in ("noisy", "own noise"):
            raw, srgb = cell.replace("*", "").split(" / ")
            gmac = figures["GMAC"].get(name)
            points[name] = (None if gmac is None else float(gmac), float(raw), float(srgb))
    return plot_costs(points)


def _short(frames: str) -> str:
    """The name of a set of frames in a marker: the folder in lower case, ``real:test`` without the colon."""
    return Path(frames.partition("@")[0]).name.replace(":", " ").lower()


def _column(name: str) -> str:
    name = name.removesuffix(", published weights")
    if name.endswith(GUARD):
        return f"{name.removesuffix(GUARD)}, guarded"
    return NAMES.get(name, name)


def main(command: Sequence[str] | None = None) -> None:
    options = parser(__doc__)
    options.add_argument("name", help="name of the set")
    options.add_argument("result", type=Path, help="JSON file that a benchmark wrote")
    options.add_argument("--frames", default="", help="beginnings of the names of the frames that count")
    options.add_argument("--on", default="", help="what the frames are; by default their names")
    options.add_argument("--command", default="", help="what wrote the file; by default what it says itself")
    options.add_argument("--plot", nargs=2, metavar=("PNG", "ROW"), help="PSNR of a row over operations, as a picture")
    options.add_argument("--commit", help="the commit that wrote it, if it is not the present one")
    args = options.parse_args(command)
    result = json.loads(args.result.read_text(encoding="utf-8"))

    on = args.on
    if "harm" in result:
        figures = figures_of_harm(result["harm"])
        on = on or ", ".join(result["frames"])
    elif "finished" in result.get("noisy", ()):
        figures = figures_of_strong_pictures(result)
    elif "rows" in result:
        figures = figures_of_benchmark(result, args.frames or " ".join(result["frames"]))
        on = on or args.frames or ", ".join(result["frames"])
    elif "GMAC" in result:
        figures = figures_of_strengths(result)
    else:
        figures = figures_of_bracket(result)
    how = args.command or result.get("command", "")
    record(args.name, figures, how, on, result.get("seed", 0), args.commit, result.get("weights_sha256"))
    if args.plot:
        picture, row = args.plot
        Path(picture).write_bytes(plot_row(figures, row))


if __name__ == "__main__":
    main()
