"""The reconstruction table: every method fitted on the same pairs, measured on frames left out.

PSNR_r is leave-one-frame-out: a method is fitted on all frames but one, and scored on that one. With ``test`` it is
that of a published split: a method is fitted once to all frames, and scored on every frame of another set.
PSNR_d is that of a denoiser trained on the RAW that a method makes of sRGB pictures, on frames of cameras that no
method has seen. Each fit's figures go into a file of their own, so that a stopped run can resume.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from itertools import product
from pathlib import Path
from statistics import fmean, median
from typing import Any

import torch
from torch import Tensor

from rawaug import bayer
from rawaug.bayer import CFA
from rawaug.data import open_pairs, open_pictures
from rawaug.data.folders import Readable, skip_broken
from rawaug.data.pairs import Pair, SomePairs, names_of, selected, shared_frame
from rawaug.evaluation.tables import mean_and_spread, print_rows
from rawaug.evaluation.trials import trial_of
from rawaug.experiment.run_folder import claim, require_free, run_folder
from rawaug.files import fingerprint, write_json
from rawaug.io import decode_srgb, encode_srgb
from rawaug.isp.fit import FitConfig
from rawaug.metrics import worst_and_best_quarter
from rawaug.noise import noise_model
from rawaug.paper.baselines import Training
from rawaug.paper.downstream import DownstreamConfig, psnr_d
from rawaug.paper.methods import (
    FAMILIES,
    ROWS,
    Fitted,
    balanced_rows,
    cycle_psnr,
    fit_family,
    is_method,
    learns_by_descent,
    mosaic_only_psnr,
    resumed,
    score_rows,
)
from rawaug.plugin.pictures import trim_to_even
from rawaug.progress import progress
from rawaug.registry import EXPERIMENTS
from rawaug.training.config import weights_key
from rawaug.training.loop import require_trainable

COLUMNS = {
    "psnr_r": "PSNR_r", "worst25": "worst 25%", "best25": "best 25%", "balanced": "balanced", "cycle": "cycle",
    "cycle_without_mosaic": "no mosaic", "psnr_d": "PSNR_d",
}  # fmt: skip


def _cells(row: dict[str, Any], columns: Sequence[str]) -> list[str]:
    values = (row.get(name) or [] for name in columns)
    listed = [value if isinstance(value, list) else [value] for value in values]
    figures = [mean_and_spread(value, 2) if value else "" for value in listed]
    speed = "" if row["mpix_s"] is None else f"{row['mpix_s']:.3g}"
    return [*figures, f"{row['parameters'] / 1e6:.3f}", f"{row['seconds']:.1f}", speed]


def print_methods(title: str, rows: dict[str, dict[str, Any]], balanced: bool, ceiling: float) -> None:
    """Print the rows of a comparison; ``ceiling`` is the PSNR that the mosaic alone leaves of a cycle."""
    columns = [name for name in COLUMNS if name != "balanced" or balanced]
    heads = [COLUMNS[name] for name in columns] + ["M par.", "s to fit", "Mpix/s"]
    print_rows(title, ["method", *heads], [[name, *_cells(row, columns)] for name, row in rows.items()])
    threads = torch.get_num_threads()
    print(f"mosaic and bilinear interpolation alone: {ceiling:.2f} dB (ceiling of the cycle); threads: {threads}")


def row_name(family: str, row: str) -> str:
    """Of a row of a fold: "as-shot, overexposed" and the like."""
    setting, _, kind = row.partition(", ")
    return ", ".join([family, *([] if setting == "blind" else [ROWS[setting]]), *([kind] if kind else [])])


STOPS, CONTRAST, SATURATION = 1.0, 0.5, 1.3
LUMA = (0.2126, 0.7152, 0.0722)
"""Of ITU-R BT.709."""


def overexposed(pair: Pair) -> Pair:
    """The shot with more light, RAW and picture clipped at white."""
    factor = 2.0**STOPS
    picture = encode_srgb((factor * decode_srgb(pair.srgb.float() / 255.0)).clamp(max=1.0))
    return replace(pair, srgb=_as_8_bits(picture), raw=(factor * pair.raw).clamp(max=1.0))


def retouched(pair: Pair) -> Pair:
    """The RAW stays, the picture is given an S curve and more saturated colour."""
    x = pair.srgb.float() / 255.0
    x = x + CONTRAST * (3.0 * x**2 - 2.0 * x**3 - x)
    luma = (torch.tensor(LUMA).reshape(3, 1, 1) * x).sum(0, keepdim=True)
    return replace(pair, srgb=_as_8_bits((luma + SATURATION * (x - luma)).clamp(0.0, 1.0)))


PERTURBED: dict[str, Callable[[Pair], Pair]] = {"overexposed": overexposed, "retouched": retouched}


def _as_8_bits(picture: Tensor) -> Tensor:
    return (255.0 * picture).round().to(torch.uint8)


@dataclass
class Comparison:
    """A table of methods.

    Args:
        experiment: "reconstruction".
        name: of the output folder within ``out``.
        data: the pairs, of one CFA; methods that train on crops need them registered. A dataset's split is ``train``.
        test: score on these pairs, of the split ``test``, instead of on frames left out of ``data``; frames of any
            pattern are brought to that of the first training frame.
        count: number of pairs of ``data`` to use; null for all.
        select: which, as ``data.select`` of recipes that train.
        test_count: number of test pairs; null for all.
        noise: preset added once to every frame; the dictionary ISP is then fitted to these noisy
            frames and never sees a clean one, and the scores are against the clean frames. Null: no noise.
        methods: families to fit: dictionary, dictionary-encoders and the baselines; or ISPs to take as they are, by
            a shipped one's name or a file.
        seconds: training budget of methods trained by gradient descent, without file reading.
        crop: side of the crops that these methods train on: small ones give more steps to a short budget.
        batch: crops in a step of them.
        patches: random patches of each left-out frame that are scored; null scores all.
        balanced: a column with InvISP's figure as well, on whole frames: PSNR of demosaiced, white-balanced and
            gamma-compressed RAW.
        perturbed: more rows, of frames that are "overexposed" by a stop, or whose picture was "retouched", see
            below; methods are fitted to frames as they are.
        pictures: sRGB pictures for the cycle and for PSNR_d.
        fit: of the dictionary ISP.
        downstream: PSNR_d; null skips it.
        seed: of the first run.
        seeds: number of runs.
        out: folder of all runs.
    """

    experiment: str = "reconstruction"
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
    balanced: bool = False
    perturbed: list[str] = field(default_factory=list)
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
        if unknown := [kind for kind in self.perturbed if kind not in PERTURBED]:
            raise ValueError(f"perturbed: {unknown}; choose from {', '.join(PERTURBED)}")
        if self.noise and any(not method.startswith("dictionary") for method in self.methods):
            raise ValueError("noise: only the dictionary ISP can be fitted to noisy frames; remove the other methods")

    def shortest(self) -> Comparison:
        """One step of every method, on the first frames."""
        few: dict[str, Any] = {"count": 2, "test_count": 1, "patches": 1, "seeds": 1, "seconds": 0.1}
        downstream = self.downstream and self.downstream.shortest()
        return replace(self, **few, select="first", fit=self.fit.shortest(), downstream=downstream)


@EXPERIMENTS.register("reconstruction")
def compare(comparison: Comparison, overwrite: bool = False) -> dict[str, dict[str, Any]]:
    """Run a comparison; the rows as in ``table.json``; ``overwrite`` replaces another of its name."""
    require_free(comparison, overwrite)
    table = Table(comparison)
    claim(comparison, overwrite)
    return table.filled()


class Table:
    """A comparison whose data are open and checked."""

    def __init__(self, settings: Comparison) -> None:
        if settings.downstream is not None:
            require_trainable("cpu", 1, settings.downstream.train.precision)
        self.settings, self.folder = settings, run_folder(settings)
        found = open_pairs(settings.data, split="train")
        self.pairs = _fitted_frames(settings, found)
        self.scored = _test_frames(settings, found) if settings.test else self.pairs
        self.fit = replace(settings.fit, noisy=settings.fit.noisy or bool(settings.noise))
        self._fitted: dict[str, Fitted] = {}
        side = settings.downstream.train.crop if settings.downstream else 2
        pictures = open_pictures(settings.pictures, min_side=side)
        self.pictures = [trim_to_even(pictures[k]) for k in range(len(pictures))]

    def filled(self) -> dict[str, dict[str, Any]]:
        """All rows; printed, and written with every single figure."""
        settings, rows = self.settings, dict[str, dict[str, Any]]()
        for family in settings.methods:
            rows |= self._rows(family)
        ceiling = mosaic_only_psnr(self.pictures, CFA(self.pairs[0].cfa))
        write_json({"settings": asdict(settings), "rows": rows, "mosaic_only_psnr": ceiling}, self._path("table"))
        frames = len(next(iter(rows.values()))["frames"])
        on = f"one of {frames} frames left out" if settings.test is None else f"{frames} frames of {settings.test}"
        title = f"{settings.name}: {on}, seeds: {settings.seeds}, {settings.data}"
        print_methods(title, rows, settings.balanced, ceiling)
        return rows

    def _rows(self, family: str) -> dict[str, dict[str, Any]]:
        names = names_of(self.scored)
        drawn = progress(list(product(self._seeds(), range(len(names)))), label=family, unit="fit")
        every = [self._fold(family, seed, frame) for seed, frame in drawn]
        folds = [every[k : k + len(names)] for k in range(0, len(every), len(names))]
        speeds = [fold["mpix_s"] for fold in every if fold["mpix_s"] is not None]
        whole = self._whole(family)

        def by_seed(kind: str, row: str) -> list[list[float]]:
            return [[fold[kind][row] for fold in of_seed] for of_seed in folds]

        rows = {}
        for row in every[0]["rows"]:
            values = by_seed("rows", row)
            name = row_name(family, row)
            rows[name] = {
                "psnr_r": [fmean(of_seed) for of_seed in values],
                "frames": {name: [of_seed[k] for of_seed in values] for k, name in enumerate(names)},
                "worst25": [worst_and_best_quarter(of_seed)[0] for of_seed in values],
                "best25": [worst_and_best_quarter(of_seed)[1] for of_seed in values],
                "seconds": fmean(fold["seconds"] for fold in every),
                "mpix_s": median(speeds) if speeds else None,
                "parameters": every[0]["parameters"],
                **(whole if row == "blind" else {}),
            }
            if row in every[0].get("balanced", {}):
                rows[name]["balanced"] = [fmean(of_seed) for of_seed in by_seed("balanced", row)]
        return rows

    def _fold(self, family: str, seed: int, frame: int) -> dict[str, Any]:
        """Fitted without one frame, scored on it; or fitted to all, scored on a test frame."""
        settings, name = self.settings, names_of(self.scored)[frame]
        training = self._training(seed)
        measured = settings.patches, settings.balanced, settings.perturbed
        key = fingerprint(family, asdict(training), *measured, *self._frames())
        path = self._path(f"{family}-{'on' if settings.test else 'without'}-{name}-seed{seed}")
        return resumed(path, key, lambda: self._scored(family, training, frame, key))

    def _scored(self, family: str, training: Training, frame: int, key: str) -> dict[str, Any]:
        """The figures of one fold."""
        settings, pair = self.settings, self.scored[frame]
        if settings.test:
            pair = pair.in_pattern(self.pairs[0].cfa)
            if key not in self._fitted:
                self._fitted = {key: fit_family(family, self.pairs, self.fit, training)}
            fitted = self._fitted[key]
        else:
            fitted = fit_family(family, [p for p in self.pairs if p is not pair], self.fit, training)
        result = score_rows(fitted, pair, settings.patches)
        for kind in settings.perturbed:
            found = score_rows(fitted, PERTURBED[kind](pair), settings.patches)["rows"]
            result["rows"] |= {f"{row}, {kind}": value for row, value in found.items()}
        if settings.balanced:
            result["balanced"] = balanced_rows(fitted, pair)
        return result | {**fitted.model.info, "seconds": fitted.seconds, "parameters": fitted.parameters}

    def _whole(self, family: str) -> dict[str, Any]:
        """What is measured elsewhere than on the pairs, by a fit on all of them: cycle and PSNR_d."""
        settings = self.settings
        downstream = settings.downstream if settings.downstream and family in settings.downstream.methods else None
        training, seeds = self._training(settings.seed), self._seeds()
        samples = (family, asdict(training), settings.pictures, *self._frames())
        key = fingerprint(*samples, list(seeds), downstream and asdict(downstream))

        def measured() -> dict[str, Any]:
            fitted = fit_family(family, self.pairs, self.fit, training)
            result: dict[str, Any] = cycle_psnr(fitted, self.pictures)
            if downstream:
                drawn = (*samples, downstream.noise, downstream.exposure)
                trained = weights_key(downstream.denoiser, downstream.train, drawn, validation="watched")
                place = self.folder / f"{family.replace('/', '_')}-denoisers-{trained}"
                result["psnr_d"] = [psnr_d(fitted.model, self.pictures, downstream, place, seed) for seed in seeds]
            return result

        return resumed(self._path(f"{family}-all-frames"), key, measured)

    def _seeds(self) -> range:
        return range(self.settings.seed, self.settings.seed + self.settings.seeds)

    def _training(self, seed: int) -> Training:
        return Training(self.settings.seconds, crop=self.settings.crop, batch=self.settings.batch, seed=seed)

    def _frames(self) -> tuple[Any, ...]:
        """What a fit depends on besides its family, budget and seed."""
        settings = self.settings
        return asdict(self.fit), settings.noise, settings.data, [pair.name for pair in self.pairs], settings.test

    def _path(self, stem: str) -> Path:
        return self.folder / f"{stem.replace('/', '_')}.json"


def _fitted_frames(settings: Comparison, found: Sequence[Pair]) -> list[Pair]:
    """The chosen frames, all of one pattern, and registered where a method needs that."""
    chosen = SomePairs(found, selected(found, len(found), settings.count, settings.select))
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
