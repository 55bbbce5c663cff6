"""A sweep of denoisers, rehearsed on its own data in seconds, for ``--dry-run``."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rawaug.experiment import rehearsal
from rawaug.experiment.denoiser_sweep import DenoiserSweep, clean_middle, prepared_sweep, scored
from rawaug.experiment.plan import used
from rawaug.experiment.run_folder import run_folder


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


def _say(what: Mapping[str, str]) -> None:
    print("\n".join(f"{name:<10}{value}" for name, value in what.items()))


def _nothing_written(settings: Any) -> None:
    print(f"dry run: nothing wrong found, nothing written to {run_folder(settings)}")
