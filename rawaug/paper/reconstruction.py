"""The reconstruction table: every method fitted on the same pairs, measured on frames left out.

PSNR_r is leave-one-frame-out: a method is fitted on all frames but one, and scored on that one. With ``test`` it is
that of a published split: a method is fitted once to all frames, and scored on every frame of another set. PSNR_d is
measured on frames of cameras that no method has seen. The figures of each fit go into a file of their own, so that a
stopped run can resume.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from itertools import product
from pathlib import Path
from statistics import fmean, median
from typing import Any

import torch

from rawaug import bayer
from rawaug.bayer import CFA
from rawaug.data import open_pairs, open_pictures
from rawaug.data.folders import Readable, skip_broken
from rawaug.data.pairs import Pair, SomePairs, names_of, select_pairs, shared_frame
from rawaug.evaluation.tables import mean_and_spread, print_rows
from rawaug.evaluation.trials import trial_of
from rawaug.experiment.plan import claim, require_free, run_folder
from rawaug.experiment.recipe import EXPERIMENTS
from rawaug.files import fingerprint, write_json
from rawaug.isp.fit import FitConfig
from rawaug.metrics import worst_and_best_quarter
from rawaug.noise import noise_model
from rawaug.paper.baselines import Training
from rawaug.paper.methods import (
    FAMILIES,
    ROWS,
    DownstreamConfig,
    Fitted,
    cycle_psnr,
    fit_family,
    is_method,
    learns_by_descent,
    mosaic_only_psnr,
    psnr_d,
    resume,
    score_rows,
)
from rawaug.plugin.pictures import trim_to_even
from rawaug.progress import progress
from rawaug.training.config import weights_key
from rawaug.training.loop import require_trainable

COLUMNS = {
    "psnr_r": "PSNR_r", "worst25": "worst 25%", "best25": "best 25%", "forward": "RAW to sRGB", "cycle": "cycle",
    "cycle_without_mosaic": "no mosaic", "psnr_d": "PSNR_d",
}  # fmt: skip


def print_methods(title: str, rows: Mapping[str, Mapping[str, Any]], ceiling: float) -> None:
    """Print the rows of a comparison.

    Args:
        title: of the table.
        rows: by name, as in ``table.json``.
        ceiling: PSNR in dB that the mosaic alone leaves of a cycle.
    """

    def cells(row: Mapping[str, Any]) -> Iterator[str]:
        for value in map(row.get, COLUMNS):
            yield "" if value is None else mean_and_spread(value if isinstance(value, list) else [value], 2)
        yield f"{row['parameters'] / 1e6:.3f}"
        yield f"{row['seconds']:.1f}"
        yield "" if row["mpix_s"] is None else f"{row['mpix_s']:.3g}"

    heads = ["method", *COLUMNS.values(), "M par.", "s to fit", "Mpix/s"]
    print_rows(title, heads, [[name, *cells(row)] for name, row in rows.items()])
    threads = torch.get_num_threads()
    print(f"mosaic and bilinear interpolation alone: {ceiling:.2f} dB (ceiling of the cycle); threads: {threads}")


@dataclass
class Comparison:
    """The settings of a table of methods.

    Args:
        name: of the output folder within ``out``.
        data: the pairs, of one CFA; methods that train on crops need them registered. A dataset's split is ``train``.
        test: score on these pairs, of the split ``test``, instead of on frames left out of ``data``; frames of any
            pattern are brought to that of the first training frame.
        count: number of pairs of ``data`` to use; null for all.
        select: which of them, as ``data.select`` of recipes that train.
        test_count: number of test pairs; null for all.
        noise: preset added once to every frame; the dictionary ISP is then fitted to these noisy
            frames and never sees a clean one, and the scores are against the clean frames. Null adds no noise.
        methods: families to fit: dictionary, dictionary-encoders and the baselines; or ISPs to take as they are, by
            a shipped one's name or a file.
        seconds: training budget of methods trained by gradient descent, without file reading.
        crop: side of the crops that these methods train on: small ones give more steps to a short budget.
        batch: crops in a step of them.
        patches: random patches of each left-out frame that are scored; null scores all.
        pictures: sRGB pictures for the cycle and for PSNR_d.
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
    methods: list[str] = field(default_factory=lambda: ["dictionary", "upi", "upi-tuned"])
    seconds: float = 20.0
    crop: int = 64
    batch: int = 2
    patches: int | None = 8
    pictures: str = "demo:"
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

    def shortest(self) -> Comparison:
        """The comparison with one step of every method, on the first frames."""
        few: dict[str, Any] = {"count": 2, "test_count": 1, "patches": 1, "seeds": 1, "seconds": 0.1}
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
        self.settings, self.folder = settings, run_folder(settings)
        self.seeds = range(settings.seed, settings.seed + settings.seeds)
        found = open_pairs(settings.data, split="train")
        self.pairs = _fitted_frames(settings, found)
        self.scored = _test_frames(settings, found) if settings.test else self.pairs
        self.fit = replace(settings.fit, noisy=settings.fit.noisy or bool(settings.noise))
        self._fitted: dict[str, Fitted] = {}
        side = settings.downstream.train.crop if settings.downstream else 2
        pictures = open_pictures(settings.pictures, min_side=side)
        self.pictures = [trim_to_even(pictures[k]) for k in range(len(pictures))]

    def all_rows(self) -> dict[str, dict[str, Any]]:
        """All rows by name, which are printed, and written with every single figure."""
        settings, rows = self.settings, dict[str, dict[str, Any]]()
        for family in settings.methods:
            rows |= self._rows(family)
        ceiling = mosaic_only_psnr(self.pictures, CFA(self.pairs[0].cfa))
        write_json({"settings": asdict(settings), "rows": rows, "mosaic_only_psnr": ceiling}, self._path("table"))
        frames = len(self.scored)
        on = f"one of {frames} frames left out" if settings.test is None else f"{frames} frames of {settings.test}"
        title = f"{settings.name}: {on}, seeds: {settings.seeds}, {settings.data}"
        print_methods(title, rows, ceiling)
        return rows

    def _rows(self, family: str) -> dict[str, dict[str, Any]]:
        names = names_of(self.scored)
        fits = list(product(self.seeds, range(len(names))))
        folds = [self._fold(family, seed, frame) for seed, frame in progress(fits, label=family, unit="fit")]
        speeds = [fold["mpix_s"] for fold in folds if fold["mpix_s"] is not None]
        whole = self._all_frames(family)

        def by_seed(values: list[float]) -> list[list[float]]:
            return [values[k : k + len(names)] for k in range(0, len(values), len(names))]

        back = [fold["forward"] for fold in folds if fold.get("forward") is not None]
        if len(back) == len(folds):
            whole["forward"] = [fmean(of_seed) for of_seed in by_seed(back)]

        rows = {}
        for row in folds[0]["rows"]:
            values = by_seed([fold["rows"][row] for fold in folds])
            worst, best = zip(*map(worst_and_best_quarter, values), strict=True)
            name = family if row == "blind" else f"{family}, {ROWS[row]}"
            rows[name] = {
                "psnr_r": [fmean(of_seed) for of_seed in values],
                "frames": {
                    name: list(of_frame) for name, of_frame in zip(names, zip(*values, strict=True), strict=True)
                },
                "worst25": list(worst),
                "best25": list(best),
                "seconds": fmean(fold["seconds"] for fold in folds),
                "mpix_s": median(speeds) if speeds else None,
                "parameters": folds[0]["parameters"],
                **(whole if row == "blind" else {}),
            }
        return rows

    def _fold(self, family: str, seed: int, frame: int) -> dict[str, Any]:
        """The figures of a fit without one frame, scored on it; or of a fit to all, scored on a test frame."""
        settings, training = self.settings, self._training(seed)
        key = fingerprint(family, asdict(training), settings.patches, *self._frames())
        name = names_of(self.scored)[frame]
        path = self._path(f"{family}-{'on' if settings.test else 'without'}-{name}-seed{seed}")

        def measure() -> dict[str, Any]:
            pair = self.scored[frame]
            if settings.test and key not in self._fitted:
                self._fitted = {key: fit_family(family, self.pairs, self.fit, training)}
            others = [other for other in self.pairs if other is not pair]
            fitted = self._fitted[key] if settings.test else fit_family(family, others, self.fit, training)
            pair = pair.in_pattern(self.pairs[0].cfa) if settings.test else pair
            result = score_rows(fitted, pair, settings.patches)
            return result | {**fitted.model.info, "seconds": fitted.seconds, "parameters": fitted.parameters}

        return resume(path, key, measure)

    def _all_frames(self, family: str) -> dict[str, Any]:
        """Measure a fit to all pairs on other data: its cycle and its PSNR_d."""
        settings = self.settings
        downstream = settings.downstream if settings.downstream and family in settings.downstream.methods else None
        training = self._training(settings.seed)
        samples = (family, asdict(training), settings.pictures, *self._frames())

        def measure() -> dict[str, Any]:
            fitted = fit_family(family, self.pairs, self.fit, training)
            result: dict[str, Any] = cycle_psnr(fitted, self.pictures)
            if downstream:
                drawn = (*samples, downstream.noise, downstream.exposure)
                trained = weights_key(downstream.denoiser, downstream.train, drawn, validation="watched")
                folder = self.folder / f"{family.replace('/', '_')}-denoisers-{trained}"
                seeds = self.seeds
                result["psnr_d"] = [psnr_d(fitted.model, self.pictures, downstream, folder, seed) for seed in seeds]
            return result

        key = fingerprint(*samples, list(self.seeds), downstream and asdict(downstream))
        return resume(self._path(f"{family}-all-frames"), key, measure)

    def _training(self, seed: int) -> Training:
        return Training(self.settings.seconds, crop=self.settings.crop, batch=self.settings.batch, seed=seed)

    def _frames(self) -> tuple[Any, ...]:
        """The settings and frames that a fit depends on besides its family, budget and seed."""
        settings = self.settings
        return asdict(self.fit), settings.noise, settings.data, names_of(self.pairs), settings.test

    def _path(self, stem: str) -> Path:
        return self.folder / f"{stem.replace('/', '_')}.json"


def _fitted_frames(settings: Comparison, found: Sequence[Pair]) -> list[Pair]:
    """The chosen frames, all of one pattern, and registered where a method needs that."""
    chosen = SomePairs(found, select_pairs(found, len(found), settings.count, settings.select))
    names = names_of(chosen)
    if twice := [name for name in names if names.count(name) > 1]:
        raise ValueError(f"data: several frames are named {twice[0]}; rename the files")
    pairs = list(skip_broken(chosen, "data"))
    if len(pairs) < 2 and not settings.test:
        raise ValueError(f"data: {settings.data} has {len(pairs)} frame; leave-one-out needs two or more")
    if settings.test:
        pairs = [pair.in_pattern(pairs[0].cfa) for pair in pairs]
    exact = any(learns_by_descent(method) for method in settings.methods)
    for pair in pairs:
        if pair.cfa != pairs[0].cfa or (exact and not pair.registered):
            what = "is not registered pixel by pixel" if pair.cfa == pairs[0].cfa else "has a different CFA"
            raise ValueError(f"data: {pair.name} {what}; {', '.join(settings.methods)} cannot share a table on it")
    if settings.noise is None:
        return pairs
    noise = noise_model(settings.noise)  # frozen: keyed by the frame's name, as a noisy capture
    drawn = [trial_of(pair, noise).noisy for pair in pairs]
    return [replace(pair, noisy=bayer.unpack(noisy, pair.cfa)[0]) for pair, noisy in zip(pairs, drawn, strict=True)]


def _test_frames(settings: Comparison, found: Sequence[Pair]) -> Sequence[Pair]:
    """The frames of ``test`` that can be read, none of which is in the data."""
    test = open_pairs(str(settings.test), split="test")
    tested = Readable(SomePairs(test, range(len(test))[: settings.test_count]))
    deque(skip_broken(tested, "test"), maxlen=0)
    scored = tested.kept()
    if (seen := shared_frame(scored, found)) is not None:
        raise ValueError(f"test: {seen} is also in data; score on unseen frames")
    return scored
