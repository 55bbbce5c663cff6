"""Experiments that end in a table, rehearsed on their own data in seconds, for ``--dry-run``.

Frames are read as long as :data:`rawaug.experiment.rehearsal.READ_SECONDS` allow; every method is fitted in its
shortest form to the middle of the first ones, and scored. Nothing is written to the run's folder.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from torch import Tensor

from rawaug.data import open_pairs, open_pictures
from rawaug.data.demo.pairs import FRAME
from rawaug.data.folders import each_readable
from rawaug.data.pairs import Pair
from rawaug.experiment import rehearsal
from rawaug.experiment.denoiser_sweep import DenoiserSweep, clean_middle, prepared_sweep, scored
from rawaug.experiment.plan import used
from rawaug.experiment.run_folder import require_free, run_folder
from rawaug.paper.ablation import Ablation, measure
from rawaug.paper.component_ablation import LearnedParts, photographs, variant_scores
from rawaug.paper.downstream import DownstreamConfig, psnr_d
from rawaug.paper.methods import Fitted, cycle_psnr, fit_family, score_rows
from rawaug.paper.reconstruction import Comparison, PreparedComparison
from rawaug.paper.synthetic_frames import varied_frames

FITTED = 2
"""Frames that the methods are fitted to."""
BUDGET_SECONDS = 0.1
"""Of methods that train on crops: a step or two."""


def rehearse_comparison(comparison: Comparison, overwrite: bool = False) -> None:
    """Try every method of a comparison on its data, and print what is used of them.

    Raises:
        OSError, ValueError: for the first thing that would fail.
    """
    prepared = PreparedComparison(comparison, overwrite, rehearsal.READ_SECONDS)
    settings = prepared.settings
    test = used(prepared.scored, len(prepared.scored), settings.test) if settings.test else "each frame, left out"
    _say(
        {
            "data": used(prepared.chosen, prepared.available, settings.data),
            "test": test,
            "pictures": f"{len(prepared.pictures)} of {settings.pictures}",
            "methods": ", ".join(settings.methods),
        }
    )
    left_out = prepared.scored[0].in_pattern(prepared.pairs[0].cfa)
    others = prepared.pairs if settings.test else prepared.pairs[1:]
    fitted_to = [_small(pair) for pair in others[:FITTED]]
    budget = (BUDGET_SECONDS, settings.crop, settings.batch)
    for family in settings.methods:
        fitted = fit_family(family, fitted_to, prepared.fit.smoke(), budget, settings.seed)
        score_rows(fitted, _small(left_out), patches=1)
        cycle_psnr(fitted, prepared.pictures[:1])
        if settings.downstream and family in settings.downstream.methods:
            _try_psnr_d(fitted, prepared.pictures, settings.downstream, settings.seed)
    print(f"tried: every method once; frames read: {len(prepared.pairs)} of {len(prepared.chosen)}")
    _nothing_written(settings)


def _try_psnr_d(fitted: Fitted, pictures: Sequence[Tensor], config: DownstreamConfig, seed: int) -> None:
    one_step = replace(config.train, steps=1, batch=2, validate_every=1, checkpoint_every=1)
    quick = replace(config, train=one_step, test_crop=rehearsal.SIDE, test_count=1)
    with TemporaryDirectory() as folder:
        psnr_d(fitted.model, pictures, quick, Path(folder), seed)


def rehearse_ablation(ablation: Ablation, overwrite: bool = False) -> None:
    """Try an ablation on one frame that is left out of a few.

    Raises:
        OSError, ValueError: for the first thing that would fail.
    """
    require_free(ablation, overwrite)
    frames = open_pairs(ablation.data, split="train")
    _say({"data": used(frames, len(frames), ablation.data)})
    if len(frames) < 2:
        raise ValueError(f"data: {ablation.data} has {len(frames)} frame; leave-one-out needs two or more")
    pairs = list(each_readable(frames, "data", rehearsal.READ_SECONDS, least=2))
    left_out, *others = (_small(pair) for pair in pairs[: 1 + FITTED])
    measure(others, left_out, replace(ablation.fit.smoke(), seed=ablation.seed))
    print(f"tried: every stage left out once; frames read: {len(pairs)} of {len(frames)}")
    _nothing_written(ablation)


def rehearse_learned(learned: LearnedParts, overwrite: bool = False) -> None:
    """Try every variant on a few frames of the first seed; all its photographs are read.

    Raises:
        OSError, ValueError: for the first thing that would fail.
    """
    require_free(learned, overwrite)
    pictures = open_pictures(learned.pictures, min_side=min(FRAME))
    chosen = photographs(pictures, learned, learned.seed)
    used_now = f"{len(chosen)} of {len(pictures)} of {learned.pictures}, for each of {learned.seeds} seeds"
    _say({"pictures": used_now, "cameras": ", ".join(learned.cameras), "variants": ", ".join(learned.variants)})
    frames = varied_frames(chosen[:FITTED], learned.cameras, learned.seed, "train")
    left_out = varied_frames(chosen[learned.frames :][:1], learned.cameras, learned.seed, "left-out")
    with TemporaryDirectory() as folder:
        for k, changes in enumerate(learned.variants.values()):
            config = replace(replace(learned.fit, **changes).smoke(), joint_steps=0, seed=learned.seed)
            variant_scores(Path(folder) / f"{k}.json", config, frames, left_out)
    print(f"tried: every variant on {len(frames)} frames")
    _nothing_written(learned)


def rehearse_sweep(settings: DenoiserSweep, overwrite: bool = False) -> None:
    """Try every denoiser of a sweep on the middle of the first frame of each dataset, at the first ISO.

    Raises:
        OSError, ValueError: for the first thing that would fail.
    """
    noises, makers, data = prepared_sweep(settings, overwrite)
    isos = ", ".join(map(str, settings.isos))
    found = {"data": "; ".join(used(frames, len(frames), spec) for spec, frames in data.items())}
    _say({**found, "noise": f"{settings.camera} at ISO {isos}", "methods": ", ".join(makers)})
    noise = noises[settings.isos[0]]
    for frames in data.values():
        middle = clean_middle(frames[0], min(rehearsal.SIDE, settings.crop or rehearsal.SIDE))
        for name, make in makers.items():
            scored(make, middle, noise, settings.seed, name, seconds=[])
    print(f"tried: every method on one frame of each of {len(data)} set{'s' * (len(data) != 1)}")
    _nothing_written(settings)


def _small(pair: Pair) -> Pair:
    """The middle of a frame; an unregistered one whole, for its shift must be found."""
    return pair.middle(rehearsal.SIDE) if pair.registered else pair


def _say(what: Mapping[str, str]) -> None:
    print("\n".join(f"{name:<10}{value}" for name, value in what.items()))


def _nothing_written(settings: Any) -> None:
    print(f"dry run: nothing wrong found, nothing written to {run_folder(settings)}")
