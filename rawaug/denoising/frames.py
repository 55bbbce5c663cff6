r"""RAW files to denoised DNGs, one or a folder of them, and frames in memory.

    x = f(y, shot_var max(y, 0) + read_var),    d = round(clip(x, 0 <= d, x <= 1) (white - black) + black)

on the mosaic as the sensor gave it, before any gain map. The result has the source's levels, colour, lens corrections,
orientation and EXIF; it differs by noise and by errors of the sensor (:mod:`rawaug.denoising.corrections`). Its
NoiseProfile tag is gone with the noise, so that a RAW developer does not smooth once more. A network that demosaics as
well gives camera RGB in a linear DNG. With a strength s below 1 the result is y + s (d - y): (1 - s)^2 of the noise's
variance is left, and NoiseProfile says so.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import product
from pathlib import Path
from statistics import fmean
from typing import Any

from torch import Tensor

from denoisers.files import DEFAULT
from rawaug import bayer
from rawaug.denoising.corrections import Corrected, Correction, Corrections
from rawaug.denoising.denoiser import RawDenoiser
from rawaug.denoising.levels import Noise, Shots, UnknownNoise, as_json, find_levels, load_noise
from rawaug.files import files_below, files_in, one_at_a_time, require_file, require_same_settings, require_writable
from rawaug.io import RawFrame, read_raw, write_dng, write_picture
from rawaug.io.dng import LINEAR_WHITE
from rawaug.io.isolated import isolated
from rawaug.io.raw import RAW_EXTENSIONS, develop
from rawaug.progress import progress

UNREADABLE = (".braw", ".crm", ".gpr", ".r3d", ".x3f")
"""Extensions of RAW that the decoder does not read."""
_ALL = Corrections()


@dataclass(frozen=True)
class Denoised:
    """What was done to a file; ``below_zero`` is the share of sites whose result was below the digital number 0."""

    source: Path
    out: Path
    shot_var: float
    read_var: float
    noise_source: str
    below_zero: float
    seconds: float
    camera: str
    iso: float | None
    corrected: Corrected


@dataclass
class DenoisedFolder:
    """What a run over a folder did: files done, done before, failed with the reason, and RAW of unknown kinds."""

    files: list[Denoised] = field(default_factory=list)
    existing: int = 0
    broken: dict[str, str] = field(default_factory=dict)
    unread: list[str] = field(default_factory=list)


def denoise(
    source: str | Path | RawFrame,
    out: str | Path | None = None,
    *,
    denoiser: Any = DEFAULT,
    noise: Noise = "auto",
    strength: float = 1.0,
    self_ensemble: bool = False,
    greens: Correction = "auto",
    device: str = "auto",
    overwrite: bool = False,
) -> RawFrame:
    """Denoise a RAW frame: what ``rawaug denoise`` does, in memory.

    Args:
        source: a RAW file of any kind that :func:`rawaug.io.read_raw` reads, or a frame.
        out: a DNG to write as well; None for none.
        denoiser: whatever :meth:`rawaug.RawDenoiser.of` takes: a shipped name, a file, a network, a function, ...
        noise: where the noise levels come from, see :data:`rawaug.denoising.levels.Noise`.
        strength: 1 removes the noise, 0.7 leaves 30% of it, 0 changes nothing.
        self_ensemble: average eight views, at eight times the cost.
        greens: ``"keep"`` leaves greens that differ; see :class:`rawaug.denoising.corrections.Corrections`.
        device: where a network runs: auto, cpu, cuda, cuda:1, mps.
        overwrite: replace ``out`` if it exists.

    Returns:
        The frame with a denoised mosaic, float32 ``(1, H, W)``, black 0 and white 1; its ``noise_profile`` says what
        noise is left.

    Raises:
        FileNotFoundError, OSError: if a file is missing or cannot be read or written.
        ValueError: if the source is no Bayer RAW, its noise is unknown, there is no such denoiser, or it demosaics
            too: its colours come from :meth:`rawaug.RawDenoiser.frame`.

    Example:
        >>> frame = rawaug.denoise("in.dng", "out.dng", denoiser="rawaug-base")  # doctest: +SKIP
    """
    views = 8 if self_ensemble else 1
    made = RawDenoiser.of(denoiser, device, "auto", strength=strength, views=views).require_mosaic()
    if out is not None:
        _require_new(Path(out), overwrite)
    frame = source if isinstance(source, RawFrame) else read_raw(source)
    denoised, _, _ = _denoised(frame, made, load_noise(noise, made), Corrections(greens))
    if out is not None:
        _write(Path(out), denoised, None if isinstance(source, RawFrame) else Path(source))
    return denoised


def denoise_file(
    source: str | Path,
    out: str | Path,
    denoiser: Any = DEFAULT,
    noise: Noise = "auto",
    *,
    corrections: Corrections = _ALL,
    preview: str | Path | None = None,
    overwrite: bool = False,
) -> Denoised:
    """Denoise one RAW file of any kind that :func:`rawaug.io.read_raw` reads, to a DNG.

    Args:
        source: the RAW file.
        out: the DNG to write; its folder is made.
        denoiser: whatever :meth:`RawDenoiser.of` takes; one that demosaics writes a linear DNG.
        noise: see :data:`Noise`; ignored by denoisers that read no levels.
        corrections: which errors of the sensor are taken out.
        preview: a .jpg or .png of the result as LibRaw develops it.
        overwrite: replace ``out`` and ``preview`` if they exist.

    Raises:
        FileNotFoundError, OSError: if a file is missing or cannot be read or written.
        ValueError: if the source is no Bayer RAW, its noise is unknown, or ``out`` is no DNG, the source itself, or
            there already.
    """
    source, out = Path(source), Path(out)
    require_file(source, "RAW file")
    if out.resolve() == source.resolve():
        raise ValueError(f"{out}: is the input file; give another name")
    _require_new(out, overwrite)
    made = _made(denoiser)
    if preview is not None:
        preview = Path(preview)
        _require_new(preview, overwrite, ".jpg", ".jpeg", ".png")
        if made.upscale > 1:
            raise ValueError(f"--preview {preview}: is of mosaics; open a linear DNG in a RAW developer")
    done = _file_denoised(source, out, made, load_noise(noise, made), corrections)
    if preview is not None:
        frame = read_raw(out)
        preview.parent.mkdir(parents=True, exist_ok=True)
        write_picture(preview, bayer.turn(develop(out), frame.upright_view))
    return done


def _made(denoiser: Any) -> RawDenoiser:
    return denoiser if isinstance(denoiser, RawDenoiser) else RawDenoiser.of(denoiser, "auto", "auto")


def _require_new(path: Path, overwrite: bool, *suffixes: str) -> None:
    if path.exists() and not overwrite:
        raise ValueError(f"{path}: exists; give another name, or --overwrite to replace it")
    if path.suffix.lower() not in (suffixes or (".dng",)):
        kind = "preview is a .jpg or .png" if suffixes else "output is a DNG; give a name ending in .dng"
        raise ValueError(f"{path}: the {kind}")
    require_writable(path)


def _denoised(
    frame: RawFrame, denoiser: RawDenoiser, noise: Noise, corrections: Corrections
) -> tuple[RawFrame, Tensor | None, dict[str, Any]]:
    """The frame with what is left of its noise, its full colour if the denoiser demosaics, and what was done."""
    corrected = Corrected()
    if denoiser.strength > 0:
        frame, corrected = corrections(frame)
    levels, noise_source = None, "not needed"
    if denoiser.reads_levels:
        *told, noise_source = find_levels(frame, noise)
        levels = (told[0], told[1])
    image, rgb = denoiser.frame(frame, levels), None
    if denoiser.upscale > 1:
        rgb, below = image, (image < -0.5 / LINEAR_WHITE).float().mean().item()
    else:
        below = _clip_below_zero(image, frame)
        known, rest = levels or frame.noise_profile, (1 - denoiser.strength) ** 2
        left = None if rest == 0 or known is None else (rest * known[0], rest * known[1])
        frame = replace(frame, mosaic=image, noise_profile=left)
    done: dict[str, Any] = dict(zip(("shot_var", "read_var"), levels or (0.0, 0.0), strict=True))
    done |= {"noise_source": noise_source, "below_zero": below, "corrected": corrected}
    return frame, rgb, done | {"camera": frame.camera, "iso": frame.iso}


def _write(out: Path, frame: RawFrame, source: Path | None, rgb: Tensor | None = None) -> None:
    out.parent.mkdir(parents=True, exist_ok=True)
    write_dng(out, frame, source, rgb=rgb)


def _file_denoised(
    source: Path,
    out: Path,
    denoiser: RawDenoiser,
    noise: Noise,
    corrections: Corrections,
    read: Callable[[Path], RawFrame] = read_raw,
) -> Denoised:
    start = time.perf_counter()
    frame, rgb, done = _denoised(read(source), denoiser, noise, corrections)
    _write(out, frame, source, rgb)
    return Denoised(source, out, seconds=time.perf_counter() - start, **done)


def _clip_below_zero(mosaic: Tensor, frame: RawFrame) -> float:
    """Clip, in place, what a digital number cannot hold; its share of the sites."""
    below = 0
    cell = bayer.plane_indices(frame.cfa)
    for i, j in product(range(len(cell)), repeat=2):
        plane, black = mosaic[0, i :: len(cell), j :: len(cell)], frame.black[cell[i, j]]
        lowest = -black / (frame.white - black)
        below += int((plane < lowest - 0.5 / (frame.white - black)).sum())
        plane.clamp_(min=lowest)
    return below / mosaic.numel()


@one_at_a_time(lambda source, out, *_, **__: Path(out))
def denoise_folder(
    source: str | Path,
    out: str | Path,
    denoiser: Any = DEFAULT,
    noise: Noise = "auto",
    *,
    corrections: Corrections = _ALL,
    overwrite: bool = False,
) -> DenoisedFolder:
    """Denoise the RAW files of a folder and its subfolders to ``out/SUBFOLDER/STEM.dng``; existing results are skipped.

    A file that cannot be read, or whose decoder crashes or hangs, is named and counted; arguments are those of
    :func:`denoise_file`. ValueError if the folder holds no RAW file or two of one stem, none can be denoised, or
    ``out`` holds results of other settings; OSError if a result cannot be written.
    """
    source, out = Path(source), Path(out)
    targets = _targets(source, out)
    require_writable(out, folder=True)
    made = _made(denoiser)
    noise = load_noise(noise, made)
    settings = {**made.settings, "noise": as_json(noise)}
    settings |= {name: value for name, value in vars(corrections).items() if value != "auto"}
    settings |= {} if made.strength == 1.0 else {"strength": made.strength}
    require_same_settings(out / "denoise.json", settings, overwrite)
    unread = [file.name for file in sorted(files_below(source, UNREADABLE))]
    result = DenoisedFolder(unread=unread)
    read, unknown = partial(isolated, read_raw), []
    for file, target in progress(targets.items(), label="denoise", unit="file", leave=True):
        if target.exists() and not overwrite:
            result.existing += 1
            continue
        try:
            result.files.append(_file_denoised(file, target, made, noise, corrections, read))
        except UnknownNoise as error:
            unknown.append(file)
            result.broken[str(file)] = f"noise unknown: {_named(error, file)}"
        except (OSError, ValueError) as error:
            if isinstance(error, OSError) and error.filename in (str(target), str(target.parent)):
                raise  # what cannot be written, such as to a full disk, is no fault of the file
            result.broken[str(file)] = f"broken: {_named(error, file)}"
    known = _levels_by_shot(result.files) if noise == "auto" else {}
    for file in unknown:
        with suppress(UnknownNoise):
            result.files.append(_file_denoised(file, targets[file], made, known, corrections, read))
            del result.broken[str(file)]
    if len(result.broken) == len(targets):
        raise ValueError(f"{source}: none of its {len(targets)} files can be denoised; {min(result.broken.values())}")
    return result


def _named(error: Exception, file: Path) -> str:
    return str(error) if file.stem in str(error) else f"{file}: {error}"


def _levels_by_shot(files: Sequence[Denoised]) -> Shots:
    found: dict[tuple[str, float | None], list[tuple[float, float]]] = {}
    for done in files:
        if done.iso is not None:
            found.setdefault((done.camera, done.iso), []).append((done.shot_var, done.read_var))
    return {shot: (fmean(s for s, _ in levels), fmean(r for _, r in levels)) for shot, levels in found.items()}


def _targets(source: Path, out: Path) -> dict[Path, Path]:
    if out.resolve().is_relative_to(source.resolve()):
        raise ValueError(f"{out}: is inside the source folder {source}; choose an output folder outside it")
    targets: dict[Path, Path] = {}
    for file in files_in(source, "RAW", RAW_EXTENSIONS):
        target = (out / file.relative_to(source)).with_suffix(".dng")
        if target in targets.values():
            raise ValueError(f"{file}: another file of {file.parent} has this stem, and both would become {target}")
        targets[file] = target
    return targets
