"""``rawaug synth``: RAW pairs on disk from a folder of sRGB pictures, in parallel.

What is drawn for a pair depends on (seed, picture's name, number) alone, and files are written whole: however often a
run is stopped and started again, and with however many workers, the same files come out, each made once.
"""

from __future__ import annotations

import json
import multiprocessing
import os
import signal
import threading
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, field
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import NamedTuple

import torch

from rawaug.commands.pair_files import (
    Format,
    Origin,
    augmentation,
    params_file,
    replay,
    write_pair,
)
from rawaug.data.picture_folder import EXTENSIONS
from rawaug.evaluation.tables import print_rows
from rawaug.files import digest, find_weights, sha256, write_json
from rawaug.io import read_picture
from rawaug.io.apart import apart, prepare
from rawaug.io.picture_files import MAX_PIXELS
from rawaug.plugin.augment import RawAugment, Sampling
from rawaug.plugin.pictures import even_sided
from rawaug.printable import printable
from rawaug.progress import progress
from rawaug.registry import COMMANDS
from rawaug.seeding import keyed_generator

LONGEST_STEM = 200
"""Bytes of a picture's name in those of its pairs, which have at most 255."""

__all__ = ["Synthesis", "print_synthesis", "replay", "synth"]


@COMMANDS.register("synth")
def run(
    pictures: str,
    out: str,
    *,
    format: Format = "dng",
    per_image: int = 1,
    isp: str = "universal",
    noise: tuple[float, float] | str = "cycleisp_sidd",
    sampling: Sampling = "convex",
    seed: int = 0,
    workers: int | None = None,
    max_pixels: int = MAX_PIXELS,
) -> None:
    """Write RAW pairs made from a folder of sRGB pictures; resumable.

    Args:
        pictures: folder of sRGB pictures.
        out: output folder.
        format: 16-bit DNG, packed float32 NPZ or float32 TIFF.
        per_image: pairs per picture.
        isp: ISP file, or the name of a shipped ISP.
        noise: a preset, a measured camera, camera (as measured by the fit), or [shot_var, read_var].
        sampling: how camera settings are drawn.
        seed: random seed.
        workers: number of processes; by default one per core.
        max_pixels: larger pictures are refused before they are decoded.
    """
    print_synthesis(synth(pictures, out, format, per_image, isp, noise, sampling, seed, workers, max_pixels))


@dataclass(frozen=True)
class _Settings:
    """The settings that the files depend on, besides the pictures; stored in ``synth.json`` beside them."""

    format: Format
    isp: str
    isp_sha256: str
    noise: str | list[float]
    sampling: Sampling
    seed: int


class _Task(NamedTuple):
    """A picture, its name as the key of its draws, where its pairs go, the numbers of those that are missing, and what is too large."""

    picture: Path
    key: str
    stem: Path
    numbers: tuple[int, ...]
    max_pixels: int


@dataclass
class Synthesis:
    """What a run did: pairs made, pairs that were there already, and the pictures that could not be read, with why."""

    out: Path
    pictures: int = 0
    made: int = 0
    existing: int = 0
    broken: dict[str, str] = field(default_factory=dict)
    seconds: float = 0.0


def synth(
    source: str | Path,
    out: str | Path,
    format: Format = "dng",
    per_image: int = 1,
    isp: str = "universal",
    noise: str | Sequence[float] = "cycleisp_sidd",
    sampling: Sampling = "convex",
    seed: int = 0,
    workers: int | None = None,
    max_pixels: int = MAX_PIXELS,
) -> Synthesis:
    """Make ``per_image`` pairs of every picture of a folder and its subfolders; existing pairs are kept.

    Args:
        source: the folder of sRGB pictures.
        out: the folder of pairs, ``SUBFOLDER/PICTURE_NUMBER...``; see :mod:`rawaug.commands.pair_files`.
        format: dng, npz or tiff.
        per_image: pairs per picture; may grow from run to run.
        isp: name of a shipped ISP, or an ISP's file.
        noise: name of a preset or a measured camera, (shot_var, read_var), or ``"camera"``.
        sampling: of camera settings, as in :class:`rawaug.RawAugment`.
        seed: random seed.
        workers: number of processes; by default one per core, 0 for this process only. They start by forkserver or
            spawn, so a script needs ``if __name__ == "__main__":`` around its main part.
        max_pixels: larger pictures are refused before they are decoded.

    Raises:
        FileNotFoundError: if there is no such folder or ISP.
        ValueError: if the folder contains no readable picture, or ``out`` contains pairs of other settings.
        OSError: if a worker dies.
    """
    start = time.perf_counter()
    weights = str(isp) if not Path(isp).suffix else str(Path(isp).resolve())
    levels = noise if isinstance(noise, str) else list(noise)
    settings = _Settings(format, weights, sha256(find_weights(weights)), levels, sampling, seed)
    source, out = Path(source).resolve(), Path(out)
    pictures = _pictures(source, out)
    if format not in ("dng", "npz", "tiff") or per_image < 1:
        raise ValueError(f"format must be dng, npz or tiff and per_image at least 1, got {format} and {per_image}")
    if workers is not None and workers < 0:
        raise ValueError(f"workers must be at least 0, got {workers}")
    augmentation(weights, levels, sampling)  # raises for a wrong name here, not in a worker
    require_same_settings(out / "synth.json", vars(settings))
    result = Synthesis(out, pictures=len(pictures))
    tasks = list(_tasks(pictures, source, out, per_image, max_pixels))
    result.existing = len(pictures) * per_image - sum(len(task.numbers) for task in tasks)
    todo = [task for task in tasks if task.numbers]
    bar = progress(_done(todo, settings, workers), label="synth", unit="picture", total=len(todo), leave=True)
    for task, error in bar:
        if error is None:
            result.made += len(task.numbers)
        else:
            result.broken[task.key] = error
    result.broken = dict(sorted(result.broken.items()))
    result.seconds = time.perf_counter() - start
    if len(result.broken) == len(pictures):
        raise ValueError(f"{source}: none of its {len(pictures)} pictures can be read; {min(result.broken.values())}")
    return result


def _pictures(source: Path, out: Path) -> list[Path]:
    if not source.is_dir():
        raise FileNotFoundError(f"{source}: no such folder of pictures")
    if out.resolve().is_relative_to(source):
        raise ValueError(f"{out}: is inside the picture folder {source}; choose an output folder outside it")
    pictures = sorted(file for file in source.rglob("*") if file.suffix.lower() in EXTENSIONS)
    if not pictures:
        raise ValueError(f"{source}: contains no picture; supported extensions are {', '.join(EXTENSIONS)}")
    return pictures


def _tasks(pictures: list[Path], source: Path, out: Path, per_image: int, max_pixels: int) -> Iterator[_Task]:
    """Pictures that differ in their extension alone keep it in the names of their pairs."""
    stems = Counter(picture.with_suffix("") for picture in pictures)
    taken: dict[Path, Path] = {}
    for picture in pictures:
        bare = picture.with_suffix("")
        own = bare if stems[bare] == 1 else bare.with_name(picture.name.replace(".", "_"))
        if taken.setdefault(own, picture) != picture:
            raise ValueError(
                f"{picture}: its pairs would have the same names as those of {taken[own].name}; rename one"
            )
        stem = out / own.relative_to(source).with_name(_short(own.name))
        missing = (k for k in range(per_image) if not params_file(_numbered(stem, k)).exists())
        yield _Task(picture, picture.relative_to(source).as_posix(), stem, tuple(missing), max_pixels)


def _short(name: str) -> str:
    """The name, or its beginning and a hash where it leaves no room for the endings of the pairs' files."""
    encoded = os.fsencode(name)
    if len(encoded) <= LONGEST_STEM:
        return name
    return encoded[: LONGEST_STEM - 20].decode("utf-8", "ignore") + f"-{digest(encoded)[:16]}"


def _numbered(stem: Path, number: int) -> Path:
    return stem.with_name(f"{stem.name}_{number}")


def require_same_settings(path: Path, settings: dict[str, object], overwrite: bool = False) -> None:
    """Write the settings of a folder's files to ``path``, or compare them with those in it, unless ``overwrite``.

    Raises:
        ValueError: if the existing files were made with other settings.
    """
    if path.is_file() and not overwrite:
        try:
            known = json.loads(path.read_text())
        except json.JSONDecodeError as error:
            raise ValueError(f"{path}: not valid JSON ({error.msg}); choose another folder") from None
        for key in known | settings:
            value, asked = known.get(key), settings.get(key)
            if asked != value:
                raise ValueError(f"{path}: made with {key} {value}, not {asked}; choose another folder")
        return
    write_json(settings, path)


# -- processes --------------------------------------------------------------------------------------------------------

_augment: RawAugment
_settings: _Settings


def _done(tasks: list[_Task], settings: _Settings, workers: int | None) -> Iterator[tuple[_Task, str | None]]:
    """Each task as it finishes, with the reason if it failed."""
    workers = min(len(tasks), os.cpu_count() or 1 if workers is None else workers)
    prepare()
    if workers < 1:
        _prepare(settings)
        yield from ((task, _make(task)) for task in tasks)
        return
    method = "forkserver" if "forkserver" in multiprocessing.get_all_start_methods() else "spawn"
    context = multiprocessing.get_context(method)
    pool = ProcessPoolExecutor(workers, context, initializer=_start_worker, initargs=(settings,))
    try:
        futures = {pool.submit(_make, task): task for task in tasks}
        for future in as_completed(futures):
            yield futures[future], future.result()
    except BrokenProcessPool:
        raise OSError("a worker died, perhaps out of memory; run it again to resume, with fewer --workers") from None
    finally:
        pool.shutdown(cancel_futures=True)


def _start_worker(settings: _Settings) -> None:
    """A worker has one thread, leaves the interrupt to the parent, and ends when the parent has died."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = multiprocessing.parent_process()
    if parent is not None:
        threading.Thread(target=_end_with, args=(parent,), daemon=True).start()
    torch.set_num_threads(1)
    _prepare(settings)


def _end_with(parent: BaseProcess) -> None:
    parent.join()
    os._exit(1)


def _prepare(settings: _Settings) -> None:
    global _augment, _settings
    _settings = settings
    _augment = augmentation(settings.isp, settings.noise, settings.sampling)


def _make(task: _Task) -> str | None:
    """Make the missing pairs of a picture; the reason if it cannot be read."""
    try:
        srgb = even_sided(apart(read_picture, task.picture, task.max_pixels))
    except (OSError, ValueError) as error:
        return str(error)
    s = _settings
    origin = Origin(str(task.picture), sha256(task.picture), s.isp, s.isp_sha256, s.noise)
    for number in task.numbers:
        params = _augment.sample(srgb, keyed_generator(s.seed, "synth", task.key, number))
        write_pair(_numbered(task.stem, number), _augment.apply(srgb, params), _augment, s.format, origin)
    return None


def print_synthesis(result: Synthesis) -> None:
    """A short table, and the unreadable pictures by name."""
    head = ("pictures", "pairs made", "existing", "unreadable", "time (s)")
    numbers = (result.pictures, result.made, result.existing, len(result.broken))
    print_rows(str(result.out), head, [[*map(str, numbers), f"{result.seconds:.1f}"]])
    for reason in result.broken.values():
        print(f"unreadable: {printable(reason)}")
