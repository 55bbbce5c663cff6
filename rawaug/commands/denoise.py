r"""``rawaug denoise``: RAW files to denoised DNGs.

    x = f(y, shot_var max(y, 0) + read_var),    d = round(clip(x, 0 <= d, x <= 1) (white - black) + black)

on the mosaic as the sensor gave it, before any gain map, in tiles. The result has the source's levels, colour, lens
corrections, orientation and EXIF and differs from it by noise alone; its NoiseProfile tag is gone with the noise, so
that a RAW developer does not smooth once more. With ``--linear`` the network demosaics as well, and the result is
camera RGB in a linear DNG. With a strength s below 1 the result is y + s (d - y): (1 - s)^2 of the noise's variance is
left, and NoiseProfile says so. A mosaic of another pattern than the network's is continued by a mirrored line on the
sides where the patterns differ, and cropped after.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from statistics import fmean
from typing import Annotated

from torch import Tensor

from denoisers.files import DEFAULT, JOINT
from rawaug import bayer
from rawaug.commands import YAML
from rawaug.commands.frame_denoisers import (
    FrameDenoiser,
    Noise,
    Shots,
    UnknownNoise,
    as_json,
    frame_denoiser,
    levels_of,
    network_denoiser,
    stored_noise,
)
from rawaug.commands.pair_maker import require_same_settings
from rawaug.data.folders import RAW_EXTENSIONS, files_in
from rawaug.errors import escape
from rawaug.files import one_at_a_time, require_writable
from rawaug.io import RawFrame, read_raw, write_dng, write_picture
from rawaug.io.dng import LINEAR_WHITE
from rawaug.io.isolated import isolated
from rawaug.io.raw import develop
from rawaug.progress import progress
from rawaug.registry import Spec

UNREADABLE = (".braw", ".crm", ".gpr", ".r3d", ".x3f")
"""Extensions of RAW that the decoder does not read."""


def run(
    source: str,
    out: str,
    /,
    *,
    denoiser: str | None = None,
    classical: Annotated[Spec | None, YAML] = None,
    noise: Annotated[tuple[float, float] | str, YAML] = "auto",
    strength: float = 1.0,
    linear: bool = False,
    self_ensemble: bool = False,
    device: str = "auto",
    preview: str | None = None,
    overwrite: bool = False,
) -> None:
    """Denoise a RAW file, or a folder of them, to DNG.

    Args:
        source: a RAW file, or a folder of them.
        out: output DNG, or output folder.
        denoiser: .safetensors file written by rawaug run, .onnx file written by rawaug export (faster on a CPU), or
            the name of a shipped denoiser; by default rawaug-small.
        classical: a filter in place of a network: NonLocalMeans, Wavelet, TotalVariation, BM3D, or {name, settings}.
        noise: auto (the NoiseProfile tag where the frame bears it out, else an estimate, else the camera's published
            law, else the levels of the folder's files of the same camera and ISO), profile, estimate, camera (the law
            that the denoiser was trained for), an ISP file (uses its stored noise law), the name of a camera, or
            [shot_var, read_var].
        strength: 1 removes the noise, 0.7 leaves 30% of it in the result, 0 changes nothing.
        linear: demosaic too, to a linear DNG of full colour; by default with rawaug-joint.
        self_ensemble: average eight views of a network, at eight times the cost.
        device: where a network runs: auto, cpu, cuda, cuda:1, mps.
        preview: also write the result, developed by LibRaw, as this .jpg or .png.
        overwrite: replace existing results.
    """
    method = frame_denoiser(denoiser, classical, self_ensemble, device, linear)
    law = stored_noise(noise, denoiser or (JOINT if linear else DEFAULT))
    if not Path(source).is_dir():
        done = denoise_file(source, out, method, law, strength=strength, preview=preview, overwrite=overwrite)
        print_denoised(DenoisedFolder([done]))
        return
    if preview is not None:
        raise ValueError(f"--preview {preview}: is for one file, and {source} is a folder")
    if Path(out).suffix.lower() == ".dng" and not Path(out).is_dir():
        raise ValueError(f"{out}: {source} is a folder, and so is its output; give a name without .dng")
    result = denoise_folder(source, out, method, law, strength=strength, overwrite=overwrite)
    print_denoised(result)
    if result.broken:
        raise ValueError(f"{source}: {len(result.broken)} of its files could not be denoised, listed above")


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


@dataclass
class DenoisedFolder:
    """What a run over a folder did: files done, done before, failed with the reason, and RAW of unknown kinds."""

    files: list[Denoised] = field(default_factory=list)
    existing: int = 0
    broken: dict[str, str] = field(default_factory=dict)
    unread: list[str] = field(default_factory=list)


def denoise_file(
    source: str | Path,
    out: str | Path,
    method: FrameDenoiser | str | Path = DEFAULT,
    noise: Noise = "auto",
    *,
    strength: float = 1.0,
    preview: str | Path | None = None,
    overwrite: bool = False,
) -> Denoised:
    """Denoise one RAW file of any kind that :func:`rawaug.io.read_raw` reads, to a DNG.

    Args:
        source: the RAW file.
        out: the DNG to write; its folder is made.
        method: what denoises, as :func:`frame_denoiser` makes it; or a network's file, or the name of a shipped one.
        noise: see :data:`Noise`; ignored by networks without a noise map.
        strength, preview, overwrite: as in :func:`run`.

    Raises:
        FileNotFoundError, OSError: if a file is missing or cannot be read or written.
        ValueError: if the source is no Bayer RAW, its noise is unknown, ``strength`` is not in [0, 1], or ``out`` is
            no DNG, the source itself, or there already.
    """
    source, out = Path(source), Path(out)
    if out.suffix.lower() != ".dng":
        raise ValueError(f"{out}: the output is a DNG; give a name ending in .dng")
    if out.resolve() == source.resolve():
        raise ValueError(f"{out}: is the input file; give another name")
    for path in (out, *([] if preview is None else [Path(preview)])):
        if path.exists() and not overwrite:
            raise ValueError(f"{path}: exists; give another name, or --overwrite to replace it")
        require_writable(path)
    if preview is not None and Path(preview).suffix.lower() not in (".jpg", ".jpeg", ".png"):
        raise ValueError(f"{preview}: the preview is a .jpg or .png")
    method = _checked(method, strength)
    if preview is not None and method.linear:
        raise ValueError(f"--preview {preview}: is of mosaics; open a linear DNG in a RAW developer")
    done = _denoise_file(source, out, method, noise, strength)
    if preview is not None:
        frame = read_raw(out)
        Path(preview).parent.mkdir(parents=True, exist_ok=True)
        write_picture(preview, bayer.turn(develop(out), frame.upright_view))
    return done


def _checked(method: FrameDenoiser | str | Path, strength: float) -> FrameDenoiser:
    made = network_denoiser(method) if isinstance(method, (str, Path)) else method
    if made.linear and strength != 1.0:
        raise ValueError(f"--strength {strength}: of a linear DNG it is 1; there is no noisy full colour to mix in")
    if not 0.0 <= strength <= 1.0:
        raise ValueError(f"strength must be between 0 and 1, got {strength}; --noise takes higher levels")
    return made


def _denoise_file(
    source: Path,
    out: Path,
    method: FrameDenoiser,
    noise: Noise,
    strength: float,
    read: Callable[[Path], RawFrame] = read_raw,
) -> Denoised:
    start = time.perf_counter()
    frame = read(source)
    shot_var, read_var, noise_source = levels_of(frame, noise) if method.reads_levels else (0.0, 0.0, "not needed")
    image = method(frame, (shot_var, read_var))
    out.parent.mkdir(parents=True, exist_ok=True)
    if method.linear:
        below = (image < -0.5 / LINEAR_WHITE).float().mean().item()
        write_dng(out, frame, source, rgb=image)
    else:
        mosaic = frame.mosaic.lerp(image, strength)
        below = _clip_below_zero(mosaic, frame)
        known = (shot_var, read_var) if method.reads_levels else frame.noise_profile
        rest = (1 - strength) ** 2
        left = None if rest == 0 or known is None else (rest * known[0], rest * known[1])
        write_dng(out, replace(frame, mosaic=mosaic, noise_profile=left), source)
    seconds = time.perf_counter() - start
    return Denoised(source, out, shot_var, read_var, noise_source, below, seconds, frame.camera, frame.iso)


def _clip_below_zero(mosaic: Tensor, frame: RawFrame) -> float:
    """Clip, in place, what a digital number cannot hold; its share of the sites."""
    below = 0
    for (i, j), black in zip(frame.cfa.sites, frame.black, strict=True):
        plane = mosaic[0, i::2, j::2]
        lowest = -black / (frame.white - black)
        below += int((plane < lowest - 0.5 / (frame.white - black)).sum())
        plane.clamp_(min=lowest)
    return below / mosaic.numel()


@one_at_a_time(lambda source, out, *_, **__: Path(out))
def denoise_folder(
    source: str | Path,
    out: str | Path,
    method: FrameDenoiser | str | Path = DEFAULT,
    noise: Noise = "auto",
    *,
    strength: float = 1.0,
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
    made = _checked(method, strength)
    settings = {**made.settings, "noise": as_json(noise)}
    settings |= {} if strength == 1.0 else {"strength": strength}
    require_same_settings(out / "denoise.json", settings, overwrite)
    unread = [file.name for file in sorted(source.rglob("*")) if file.suffix.lower() in UNREADABLE]
    result = DenoisedFolder(unread=unread)
    read, unknown = partial(isolated, read_raw), []
    for file, target in progress(targets.items(), label="denoise", unit="file", leave=True):
        if target.exists() and not overwrite:
            result.existing += 1
            continue
        try:
            result.files.append(_denoise_file(file, target, made, noise, strength, read))
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
            result.files.append(_denoise_file(file, targets[file], made, known, strength, read))
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


def print_denoised(result: DenoisedFolder) -> None:
    for done in result.files:
        levels = f"shot_var {done.shot_var:.3g}, read_var {done.read_var:.3g} ({done.noise_source})"
        clipped = f"; {done.below_zero:.2%} below digital number 0, written as 0" if done.below_zero else ""
        print(f"{escape(done.out)}: {levels}, {done.seconds:.1f} s{clipped}")
    if result.existing or result.broken:
        print(f"{len(result.files)} denoised, {result.existing} already existed, {len(result.broken)} failed")
    for reason in result.broken.values():
        print(escape(reason))
    if result.unread:
        print(escape(f"not read, no decoder for these kinds of RAW: {', '.join(result.unread)}"))
