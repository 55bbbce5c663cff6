"""RAW reconstruction on equal terms: every method is fitted to the same pairs and scored on frames it has not seen.

Without ``test``, the protocol is leave-one-out: a method is fitted on all frames but one, and scored on that one. With
``test``, it is that of a published split: a method is fitted once to all frames, and scored on every frame of another
set. PSNR_d is measured on frames of cameras that no method has seen. The figures of each fit go into a separate file,
so that a stopped run can resume.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from itertools import product
from pathlib import Path
from statistics import fmean, median
from typing import Any

import torch

from rawaug import bayer
from rawaug.bayer import CFA
from rawaug.data import open_pairs, open_pictures
from rawaug.data.frames import Readable, as_frames, shared_frame, skip_broken
from rawaug.data.pairs import Pair, centre
from rawaug.data.selection import select_pairs
from rawaug.errors import count_of
from rawaug.evaluation.tables import mean_and_spread, print_rows
from rawaug.evaluation.trials import make_trial
from rawaug.experiment.folder import claim, require_free, run_folder
from rawaug.experiment.recipe import EXPERIMENTS
from rawaug.files import cached, fingerprint, write_json
from rawaug.isp.fit import FitConfig
from rawaug.metrics import worst_and_best_quarter
from rawaug.noise import noise_model
from rawaug.paper.baselines import BASELINES, Training
from rawaug.paper.downstream import DownstreamConfig, psnr_d
from rawaug.paper.methods import (
    FAMILIES,
    ROWS,
    Fitted,
    cycle_psnr,
    end_to_end,
    fit_family,
    is_method,
    learns_by_descent,
    mosaic_only_psnr,
    score_rows,
)
from rawaug.paper.pictures import draw_frame
from rawaug.plugin.pictures import trim_to_even
from rawaug.progress import progress
from rawaug.registry import check_settings
from rawaug.training.launch import require_trainable

COLUMNS = {
    "psnr_r": "PSNR_r", "worst25": "worst 25%", "best25": "best 25%", "balanced": "balanced", "forward": "RAW to sRGB",
    "cycle": "cycle", "cycle_same_setting": "same setting", "cycle_without_mosaic": "no mosaic", "psnr_d": "PSNR_d",
}  # fmt: skip
"""Headings of columns, by the key of a row."""
SHORTEST_SIDE = 128
"""Side in pixels of the frames and pictures that a dry run scores."""


def print_methods(title: str, rows: Mapping[str, Mapping[str, Any]], ceiling: float) -> None:
    """Print the rows of a comparison.

    Args:
        title: title of the table.
        rows: the rows by name, as in ``table.json``.
        ceiling: PSNR in dB that the mosaic alone leaves of a cycle.
    """
    columns = {}
    for key, heading in COLUMNS.items():
        if any(row.get(key) is not None for row in rows.values()):
            columns[key] = heading

    table = [[name, *format_cells(row, list(columns))] for name, row in rows.items()]
    print_rows(title, ["method", *columns.values(), "M par.", "s to fit", "Mpix/s"], table)

    threads = torch.get_num_threads()
    print(f"mosaic and bilinear interpolation alone: {ceiling:.2f} dB (ceiling of the cycle); threads: {threads}")
    for name, row in rows.items():
        if row.get("known"):
            print(f"note: {name} was fitted before to {row['known']} of the frames that it is scored on")


def format_cells(row: Mapping[str, Any], columns: Sequence[str]) -> list[str]:
    """Write a row of the table as text: the figures of ``columns``, parameters, seconds and speed."""
    cells = []
    for key in columns:
        value = row.get(key)
        if value is None:
            cells.append("")
        else:
            figures = value if isinstance(value, list) else [value]
            cells.append(mean_and_spread(figures, 2))

    cells += [f"{row['parameters'] / 1e6:.3f}", f"{row['seconds']:.1f}"]
    if row["mpix_s"] is None:
        return [*cells, ""]
    return [*cells, f"{row['mpix_s']:.3g}"]


@dataclass
class Comparison:
    """The settings of a table of methods.

    Args:
        name: of the output folder within ``out``.
        data: the pairs, of one CFA; methods that train on crops need them registered. A dataset's split is ``train``.
        test: score on these pairs, of the split ``test``, instead of on frames left out of ``data``; frames of any
            pattern are brought to that of the first training frame.
        count: number of pairs of ``data`` to use; null for all.
        select: which of them to use, as ``data.select`` of recipes that train.
        test_count: number of test pairs; null for all.
        noise: preset of the noise that is added once to every frame; the dictionary ISP is then fitted to these noisy
            frames and never sees a clean one, and the scores are against the clean frames. Null adds no noise.
        methods: families to fit: dictionary, dictionary-encoders and the baselines; or ISPs to take as they are, by
            a shipped one's name or a file.
        sizes: by baseline, settings in place of its published size, such as ``{unet: {width: 16}}``.
        seconds: training budget of methods trained by gradient descent, without file reading; null for none.
        steps: largest number of their steps; null for no limit. With steps alone, the same seed gives the same weights.
        crop: side of the crops that these methods train on: small ones give more steps to a short budget.
        batch: crops in a step of these methods.
        patches: random patches of each left-out frame that are scored; null scores all.
        test_crop: score only the middle of this side of each test frame; null for all of it. A lens shading is then
            measured as if the middle were the frame, so this is only for trying a recipe.
        balanced: whether there is a column with InvISP's figure, on whole frames: PSNR of demosaiced, white-balanced
            and gamma-compressed RAW.
        pictures: sRGB pictures for the cycle and for PSNR_d.
        picture_count: number of pictures to use; null for all, which are kept in memory.
        cycle_crop: side of the middle of each picture on which the cycle is measured; null for all of it.
        fit: of the dictionary ISP.
        downstream: how PSNR_d is measured; null skips it.
        seed: of the first run.
        seeds: number of runs.
        out: folder of all runs.
    """

    name: str = "reconstruction"
    data: str = "demo:train"
    test: str | None = None
    count: int | None = None
    select: str | list[str] = "first"
    test_count: int | None = None
    noise: str | None = None
    methods: list[str] = field(default_factory=lambda: ["dictionary", "curve-matrix", "upi", "upi-tuned"])
    sizes: dict[str, dict[str, Any]] = field(default_factory=dict)
    seconds: float | None = 20.0
    steps: int | None = None
    crop: int = 64
    batch: int = 2
    patches: int | None = 8
    test_crop: int | None = None
    balanced: bool = False
    pictures: str = "demo:"
    picture_count: int | None = None
    cycle_crop: int | None = None
    fit: FitConfig = field(default_factory=FitConfig)
    downstream: DownstreamConfig | None = None
    seed: int = 0
    seeds: int = 3
    out: str = "runs"

    def __post_init__(self) -> None:
        unknown = [method for method in self.methods or [] if not is_method(method)]
        if unknown or not self.methods:
            listed = ", ".join(FAMILIES)
            raise ValueError(f"methods: {unknown or 'none'}; choose from {listed}, or name an ISP or its file")
        if self.seeds < 1:
            raise ValueError(f"seeds must be at least 1, got {self.seeds}")
        if self.patches is not None and self.patches < 1:
            raise ValueError(f"patches must be at least 1, or null for all, got {self.patches}")
        if self.noise and any(not method.startswith("dictionary") for method in self.methods):
            raise ValueError("noise: only the dictionary ISP can be fitted to noisy frames; remove the other methods")
        if self.trains_networks:
            Training(self.seconds, self.steps).require_budget()

        for family, size in self.sizes.items():
            if family not in BASELINES:
                raise ValueError(f"sizes: {family} is no baseline; use {', '.join(BASELINES)}")
            check_settings(f"sizes: {family}", BASELINES[family], size)

    @property
    def trains_networks(self) -> bool:
        """Whether a method learns on crops by gradient descent."""
        return any(learns_by_descent(method) for method in self.methods)

    def shortest(self) -> Comparison:
        """Shorten the comparison to one step of every method, on the middles of the first frames."""
        few: dict[str, Any] = {"count": 2, "test_count": 1, "patches": 1, "seeds": 1, "seconds": 0.1, "steps": 1}
        few |= {"picture_count": 2, "test_crop": SHORTEST_SIDE, "cycle_crop": SHORTEST_SIDE}
        downstream = self.downstream and self.downstream.shortest()
        return replace(self, **few, select="first", fit=self.fit.shortest(), downstream=downstream)


@EXPERIMENTS.register("reconstruction")
def compare(comparison: Comparison, overwrite: bool = False) -> dict[str, dict[str, Any]]:
    """Run a comparison and return its rows as in ``table.json``; ``overwrite`` replaces another run of its name."""
    require_free(comparison, overwrite)
    run = ComparisonRun(comparison)
    claim(comparison, overwrite)
    return run.all_rows()


class ComparisonRun:
    """A comparison whose data are open and checked."""

    def __init__(self, settings: Comparison) -> None:
        if settings.downstream is not None:
            require_trainable("cpu", 1, settings.downstream.train.precision)
        self.settings = settings
        self.folder = run_folder(settings)
        self.seeds = range(settings.seed, settings.seed + settings.seeds)
        self.fit = replace(settings.fit, noisy=settings.fit.noisy or bool(settings.noise))
        self._whole_fits: dict[int, Fitted] = {}

        every = open_pairs(settings.data, split="train")
        self.pairs = _training_frames(settings, every)
        self.scored: Sequence[Pair] = self.pairs
        if settings.test:
            self.scored = _test_frames(settings, every)

        side = 2
        if settings.downstream is not None:
            side = settings.downstream.train.crop
        pictures = open_pictures(settings.pictures, min_side=side)
        used = range(len(pictures))[: settings.picture_count]
        self.pictures = []
        self.cycle_pictures = []
        for index in used:
            picture = trim_to_even(pictures[index])
            self.pictures.append(picture)
            if settings.cycle_crop is not None:
                picture = centre(picture, settings.cycle_crop, settings.cycle_crop)
            self.cycle_pictures.append(picture)

    def all_rows(self) -> dict[str, dict[str, Any]]:
        """Measure all rows by name, print them, and write them with every single figure."""
        settings = self.settings
        rows: dict[str, dict[str, Any]] = {}
        for family in settings.methods:
            rows |= self._rows(family)

        ceiling = mosaic_only_psnr(self.cycle_pictures, CFA(self.pairs[0].cfa))
        write_json({"settings": asdict(settings), "rows": rows, "mosaic_only_psnr": ceiling}, self._path("table"))

        tested_on = f"one of {len(self.scored)} frames left out"
        if settings.test is not None:
            tested_on = f"{count_of(len(self.scored), 'frame')} of {settings.test}"
        print_methods(f"{settings.name}: {tested_on}, seeds: {settings.seeds}, {settings.data}", rows, ceiling)
        return rows

    def _rows(self, family: str) -> dict[str, dict[str, Any]]:
        self._whole_fits = {}
        folds = []
        fits = list(product(self.seeds, range(len(self.scored))))
        for seed, frame in progress(fits, label=family, unit="fit"):
            folds.append(self._fold(family, seed, frame))

        on_all_frames = self._all_frames(family)
        forward = [fold.get("forward") for fold in folds]
        if None not in forward:
            on_all_frames["forward"] = mean_by_seed(self._by_seed(forward))

        rows = {}
        for row in folds[0]["rows"]:
            if row == "blind":
                rows[family] = {**self._row(folds, row), **on_all_frames}
            else:
                rows[f"{family}, {ROWS[row]}"] = self._row(folds, row)
        return rows

    def _row(self, folds: Sequence[dict[str, Any]], row: str) -> dict[str, Any]:
        """Compute the figures of one row of a family."""
        names = as_frames(self.scored).names
        values = self._by_seed([fold["rows"][row] for fold in folds])
        worst, best = [], []
        for of_seed in values:
            low, high = worst_and_best_quarter(of_seed)
            worst.append(low)
            best.append(high)

        frames = {}
        for k, name in enumerate(names):
            frames[name] = [of_seed[k] for of_seed in values]

        figures: dict[str, Any] = {
            "psnr_r": mean_by_seed(values),
            "frames": frames,
            "worst25": worst,
            "best25": best,
            "seconds": fmean(fold["seconds"] for fold in folds),
            "mpix_s": None,
            "parameters": folds[0]["parameters"],
        }
        speeds = [fold["mpix_s"] for fold in folds if fold["mpix_s"] is not None]
        if speeds:
            figures["mpix_s"] = median(speeds)
        if row in folds[0].get("balanced", {}):
            balanced = [fold["balanced"][row] for fold in folds]
            figures["balanced"] = mean_by_seed(self._by_seed(balanced))

        seen_before = [fold for fold in folds[: len(names)] if fold.get("known")]
        if seen_before:
            figures["known"] = len(seen_before)
        for key in ("steps", "curve"):
            if key in folds[0]:
                figures[key] = folds[0][key]
        return figures

    def _by_seed(self, values: Sequence[Any]) -> list[list[Any]]:
        """Group the figures of all fits: a list of frames for each seed."""
        frames = len(self.scored)
        by_seed = []
        for first in range(0, len(values), frames):
            by_seed.append(list(values[first : first + frames]))
        return by_seed

    def _fold(self, family: str, seed: int, frame: int) -> dict[str, Any]:
        """Measure a fit without one frame, scored on it; or a fit to all frames, scored on a test frame."""
        settings = self.settings
        facts = [*self._fit_key(family, seed), settings.patches]
        if settings.test_crop is not None:
            facts.append(("middle", settings.test_crop))
        if settings.balanced:
            facts.append("balanced")

        relation = "on" if settings.test else "without"
        name = as_frames(self.scored).names[frame]
        path = self._path(f"{family}-{relation}-{name}-seed{seed}")

        def measure() -> dict[str, Any]:
            pair = self.scored[frame]
            if settings.test:
                method = self._fit_to_all(family, seed)
                pair = pair.in_pattern(self.pairs[0].cfa)
                if settings.test_crop is not None:
                    pair = pair.middle(settings.test_crop)
            else:
                training_pairs = [kept for kept in self.pairs if kept is not pair]
                method = self._fit(family, training_pairs, seed)

            if frame == 0 and seed == settings.seed and pair.registered:
                draw_frame(family.replace("/", "_"), method.model, pair, self.folder / "shown")

            figures = score_rows(method, pair, settings.patches, settings.balanced)
            figures |= {"seconds": method.seconds, "parameters": method.parameters}
            return {**method.model.info, **end_to_end(method.model.info), **figures}

        return cached(path, facts, measure)

    def _all_frames(self, family: str) -> dict[str, Any]:
        """Measure a fit to all pairs on other data: its cycle and its PSNR_d."""
        settings = self.settings
        downstream = None
        if settings.downstream and family in settings.downstream.methods:
            downstream = settings.downstream
        samples = (*self._fit_key(family, settings.seed), settings.pictures, settings.picture_count)
        if settings.cycle_crop is not None:
            samples = (*samples, "middle", settings.cycle_crop)

        def measure() -> dict[str, Any]:
            method = self._fit_to_all(family, settings.seed)
            result: dict[str, Any] = cycle_psnr(method, self.cycle_pictures)
            if downstream is None:
                return result

            draws = (*samples, downstream.noise, downstream.exposure, downstream.sampling)
            network = {key: value for key, value in asdict(downstream.denoiser).items() if value is not None}
            loop = downstream.train.weights_settings(validated=True)
            weights = fingerprint("weights", network, loop, draws, "watched")
            folder = self.folder / f"{family.replace('/', '_')}-denoisers"
            result["psnr_d"] = []
            for seed in self.seeds:
                result["psnr_d"].append(psnr_d(method.model, self.pictures, downstream, folder, seed, weights))
            return result

        facts = (*samples, list(self.seeds), downstream and asdict(downstream))
        return cached(self._path(f"{family}-all-frames"), facts, measure)

    def _fit_to_all(self, family: str, seed: int) -> Fitted:
        """Fit to all pairs, for the test frames, the cycle and PSNR_d."""
        if seed not in self._whole_fits:
            self._whole_fits[seed] = self._fit(family, self.pairs, seed)
        return self._whole_fits[seed]

    def _fit(self, family: str, pairs: Sequence[Pair], seed: int) -> Fitted:
        return fit_family(family, pairs, self.fit, self._training(seed), self.settings.sizes.get(family))

    def _training(self, seed: int) -> Training:
        settings = self.settings
        return Training(settings.seconds, settings.steps, settings.crop, settings.batch, seed)

    def _fit_key(self, family: str, seed: int) -> tuple[Any, ...]:
        """List the settings and frames that a fit depends on."""
        settings = self.settings
        size = settings.sizes.get(family)
        frames = (settings.noise, settings.data, as_frames(self.pairs).names, settings.test)
        return (family, size, asdict(self._training(seed)), asdict(self.fit), *frames)

    def _path(self, stem: str) -> Path:
        return self.folder / f"{stem.replace('/', '_')}.json"


def mean_by_seed(by_seed: Sequence[Sequence[float]]) -> list[float]:
    """Average over the frames of each seed."""
    return [fmean(values) for values in by_seed]


def _training_frames(settings: Comparison, every: Sequence[Pair]) -> list[Pair]:
    """Select the frames, all of one pattern, and registered if a method needs that."""
    selection = as_frames(every).some(select_pairs(every, len(every), settings.count, settings.select))
    names = as_frames(selection).names
    for name in names:
        if names.count(name) > 1:
            raise ValueError(f"data: several frames are named {name}; rename the files")

    pairs = list(skip_broken(selection, "data"))
    if settings.test:
        pairs = [pair.in_pattern(pairs[0].cfa) for pair in pairs]
    elif len(pairs) < 2:
        raise ValueError(f"data: {settings.data} has {len(pairs)} frame; leave-one-out needs two or more")

    for pair in pairs:
        reason = ""
        if pair.cfa != pairs[0].cfa:
            reason = "has a different CFA"
        elif settings.trains_networks and not pair.registered:
            reason = "is not registered pixel by pixel"
        if reason:
            raise ValueError(f"data: {pair.name} {reason}; {', '.join(settings.methods)} cannot share a table on it")

    if settings.noise is None:
        return pairs
    noise = noise_model(settings.noise)  # frozen, keyed by the frame's name, as a noisy capture is
    captured = []
    for pair in pairs:
        mosaic = bayer.unpack(make_trial(pair, noise).noisy, pair.cfa)[0]
        captured.append(replace(pair, noisy=replace(pair.clean, mosaic=mosaic, noise_profile=None)))
    return captured


def _test_frames(settings: Comparison, every: Sequence[Pair]) -> Sequence[Pair]:
    """Find the frames of ``test`` that can be read, none of which is in the data."""
    test = open_pairs(str(settings.test), split="test")
    readable = Readable(as_frames(test).some(range(len(test))[: settings.test_count]))
    for _ in skip_broken(readable, "test"):
        pass  # each frame is read once, so a damaged one is found before anything is fitted

    scored = readable.readable()
    shared = shared_frame(scored, every)
    if shared is not None:
        raise ValueError(f"test: {shared} is also in data; score on unseen frames")
    return scored
