"""Make RAW pairs on disk from a folder of sRGB pictures, in parallel, on one machine or on many.

The draws of a pair depend on (seed, picture's name, number) alone, and files are written whole. So a run may be stopped
and restarted, and may have any number of workers on any number of machines: the same files come out, and each is made
once.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, field, replace
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any, get_args

import torch

from rawaug.errors import count_of
from rawaug.files import LOCK, find_weights, locked, require_same_settings, sha256
from rawaug.io.content import list_pictures
from rawaug.io.pictures import MAX_PIXELS
from rawaug.plugin.config import AugmentConfig
from rawaug.progress import progress
from rawaug.synthesis import shards
from rawaug.synthesis.files import TARGETS, Format, PictureJob, Settings, Synthesiser, picture_jobs
from rawaug.synthesis.shards import PER_SHARD, ShardJob

Job = PictureJob | ShardJob
_Outcome = tuple[int, int, dict[str, str]]
"""The numbers of pairs that a job made and that were there, and the reason for each picture that it cannot read."""


@dataclass
class Synthesis:
    """The result of a run: the pairs that it made or found, and the reason for each picture that cannot be read.

    ``left_out`` has a line for each kind of file in the folder that is not a picture.
    """

    out: Path
    pictures: int = 0
    made: int = 0
    existing: int = 0
    broken: dict[str, str] = field(default_factory=dict)
    seconds: float = 0.0
    left_out: list[str] = field(default_factory=list)


def synth(
    source: str | Path,
    out: str | Path,
    format: Format = "dng",
    per_image: int = 1,
    *,
    seed: int = 0,
    workers: int | None = None,
    max_pixels: int = MAX_PIXELS,
    shard: str = "1/1",
    per_shard: int = PER_SHARD,
    **settings: Any,
) -> Synthesis:
    """Make ``per_image`` pairs of every picture of a folder and its subfolders, or of one; existing pairs are kept.

    :mod:`rawaug.synthesis.files` and :mod:`rawaug.synthesis.shards` describe the output.

    Args:
        source: a folder of sRGB pictures, or one picture.
        out: the output folder.
        format: ``"dng"`` (16 bits, target raw only), ``"npz"``, ``"tiff"``, ``"png"`` (target srgb only) or
            ``"webdataset"``, tar shards.
        per_image: number of pairs of each picture; may grow from run to run, but not in shards.
        seed: decides the draws, together with a picture's name and a pair's number.
        workers: 0 for this process only. Other workers start by forkserver or spawn, so a script needs
            ``if __name__ == "__main__":`` around its main part.
        max_pixels: larger pictures are refused before they are decoded.
        shard: ``"K/N"`` makes part K of N, for job arrays; all N write to the same folder.
        per_shard: number of pictures in a tar file.
        settings: ``isp``, ``camera``, ``noise``, ``iso``, ``draw``, ``target``, ``burst`` and ``cfa``, as in
            :meth:`rawaug.RawAugment.from_pretrained`.

    Raises:
        FileNotFoundError: if there is no such folder, picture or ISP.
        ValueError: if the folder contains no readable picture, or ``out`` contains pairs of other settings
            or is in use by another run.
        OSError: if a worker dies, or the output folder is removed meanwhile.
    """
    start = time.perf_counter()
    source, out = Path(source), Path(out)
    if source.is_dir():
        source = source.resolve()
        if out.resolve().is_relative_to(source):
            raise ValueError(f"{out}: is inside the picture folder {source}; choose an output folder outside it")
    listing = list_pictures(source)
    pictures = listing.files
    if source.is_file():
        source = source.parent

    if workers is not None and workers < 0:
        raise ValueError(f"workers must be at least 0, got {workers}")
    part, parts = parse_shard(shard)
    run_settings = _settings(format, per_image, seed, AugmentConfig(**settings))
    Synthesiser(run_settings, max_pixels)  # raises an error for a wrong name here, not in a worker

    lock = LOCK
    if parts != 1:
        lock = f"rawaug-{part}-of-{parts}.lock"

    content = run_settings.to_json()
    jobs: list[Job] = []
    with locked(out / lock):
        if format == "webdataset":
            jobs += shards.shard_jobs(pictures, source, out, per_image, per_shard)
            content["isp"] = Path(run_settings.config.isp).name  # its path differs between machines
            content |= shards.shard_settings(pictures, source, per_image, per_shard, max_pixels)
        else:
            jobs += picture_jobs(pictures, source, out, per_image)
        require_same_settings(out / "synth.json", content)

        result = _run(out, jobs[part - 1 :: parts], run_settings, max_pixels, workers)
        if format == "webdataset":
            shards.write_index(out, len(jobs), run_settings)

    result.left_out = listing.lines()
    result.seconds = time.perf_counter() - start
    if result.pictures and len(result.broken) == result.pictures:
        reason = min(result.broken.values())
        raise ValueError(f"{source}: none of its {count_of(result.pictures, 'picture')} can be read; {reason}")
    return result


def parse_shard(shard: str) -> tuple[int, int]:
    """Split ``"K/N"`` into K and N; ValueError unless K is from 1 to N."""
    first, _, second = shard.partition("/")
    if not (first.isdecimal() and second.isdecimal() and 1 <= int(first) <= int(second)):
        raise ValueError(f"shard must be K/N with K from 1 to N, as 3/32, got {shard!r}")
    return int(first), int(second)


def _settings(format: Format, per_image: int, seed: int, config: AugmentConfig) -> Settings:
    formats = get_args(Format)
    if format not in formats or per_image < 1:
        rule = f"format must be one of {', '.join(formats)} and per_image at least 1"
        raise ValueError(f"{rule}, got {format} and {per_image}")

    target = config.target_name
    if target not in TARGETS.get(format, (target,)):
        suitable = [name for name in formats if target in TARGETS.get(name, (target,))]
        raise ValueError(f"format {format} cannot hold target {target!r}; use {', '.join(suitable)}")

    isp = Path(config.isp)
    if isp.suffix:
        isp = isp.resolve()
    return Settings(format, replace(config, isp=str(isp)), sha256(find_weights(isp)), seed)


def _run(out: Path, jobs: Sequence[Job], settings: Settings, max_pixels: int, workers: int | None) -> Synthesis:
    result = Synthesis(out, pictures=sum(job.pictures for job in jobs))
    outcomes = _run_jobs(jobs, settings, max_pixels, workers)
    for made, existing, broken in progress(outcomes, label="synth", unit="file", total=len(jobs), leave=True):
        result.made += made
        result.existing += existing
        result.broken |= broken

    result.broken = dict(sorted(result.broken.items()))
    return result


# -- processes --------------------------------------------------------------------------------------------------------

_maker: Synthesiser


def _run_jobs(jobs: Sequence[Job], settings: Settings, max_pixels: int, workers: int | None) -> Iterator[_Outcome]:
    if workers is None:
        workers = os.cpu_count() or 1
    workers = min(len(jobs), workers)
    if workers < 1:
        _prepare(settings, max_pixels)
        for job in jobs:
            yield _make(job)
        return

    method = "spawn"
    if "forkserver" in multiprocessing.get_all_start_methods():
        method = "forkserver"
    context = multiprocessing.get_context(method)
    pool = ProcessPoolExecutor(workers, context, initializer=_start_worker, initargs=(settings, max_pixels))
    try:
        for future in as_completed([pool.submit(_make, job) for job in jobs]):
            yield future.result()
    except BrokenProcessPool:
        raise OSError(
            "a worker died, perhaps out of memory or of a damaged picture; run it again with fewer workers=, "
            "or look for the picture with rawaug data check"
        ) from None
    finally:
        pool.shutdown(cancel_futures=True)


def _start_worker(settings: Settings, max_pixels: int) -> None:
    """Prepare a worker: it has one thread, leaves Ctrl-C to the parent, and exits when the parent dies."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = multiprocessing.parent_process()
    if parent is not None:
        threading.Thread(target=_end_with, args=(parent,), daemon=True).start()
    torch.set_num_threads(1)
    _prepare(settings, max_pixels)


def _end_with(parent: BaseProcess) -> None:
    parent.join()
    os._exit(1)


def _prepare(settings: Settings, max_pixels: int) -> None:
    global _maker
    _maker = Synthesiser(settings, max_pixels)


def _make(job: Job) -> _Outcome:
    return job.make(_maker)
