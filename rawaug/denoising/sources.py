"""Kinds of files that are denoised: RAW to DNG, and pictures to pictures.

A kind says which files of a folder are its own, what their results are called, and how one file is read, denoised and
written. :mod:`rawaug.denoising.files` does the rest, and is the same for all.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean
from typing import Any, Protocol, TypeVar

from rawaug import bayer
from rawaug.denoising.corrections import Corrected
from rawaug.denoising.denoiser import Noisy
from rawaug.denoising.frames import DNG_ADVICE, FrameDenoiser
from rawaug.denoising.levels import Shots
from rawaug.denoising.pictures import PictureDenoiser
from rawaug.errors import escape
from rawaug.io import RawFrame, read_raw, write_dng, write_picture
from rawaug.io.content import RAW_EXTENSIONS, Listing, list_files
from rawaug.io.isolated import isolated
from rawaug.io.raw import develop
from rawaug.io.stored import PICTURE_FORMATS, read_stored, write_stored

PREVIEWS = (".jpg", ".jpeg", ".png")
"""Extensions of the previews of RAW files."""


@dataclass(frozen=True)
class Denoised:
    """What was done to a RAW file.

    Attributes:
        source, out: the files.
        shot_var, read_var: the noise levels that the denoiser was told.
        noise_source: where they come from.
        below_zero: the share of sites whose result was below the digital number 0.
        seconds: for reading, denoising and writing.
        camera, iso: of the source.
        corrected: errors of the sensor that were taken out.
    """

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

    def __str__(self) -> str:
        levels = f"shot_var {self.shot_var:.3g}, read_var {self.read_var:.3g} ({self.noise_source})"
        line = f"{escape(self.out)}: {levels}{self.corrected}, {self.seconds:.1f} s"
        if self.below_zero:
            line += f"; {self.below_zero:.2%} below digital number 0, written as 0"
        return line


@dataclass(frozen=True)
class DenoisedPicture:
    """What was done to a picture; ``removed`` is the deviation of what was taken away, in units of 1/255."""

    source: Path
    out: Path
    removed: float
    seconds: float

    def __str__(self) -> str:
        return f"{escape(self.out)}: noise of {self.removed:.1f} in 255 removed, {self.seconds:.1f} s"


T = TypeVar("T", bound=Denoised | DenoisedPicture)


class Files(Protocol[T]):
    """One kind of files.

    Attributes:
        what: what a file of this kind is called.
        formats: extensions of the results.
        format_advice: what is said of other extensions.
        settings: what the results depend on, as JSON; None if a folder's results may be of several settings.
    """

    what: str
    formats: tuple[str, ...]
    format_advice: str

    @property
    def settings(self) -> dict[str, Any] | None: ...

    def listing(self, folder: Path) -> Listing:
        """The files of a folder that are of this kind; ValueError if there is none."""

    def target(self, file: Path) -> Path:
        """The name of the result of a file, both below their folders."""

    def require_preview(self, preview: Path) -> None:
        """Raise ValueError if this kind writes no previews."""

    def denoise(self, source: Path, out: Path, preview: Path | None = None, isolate: bool = False) -> T:
        """Read, denoise and write a file, in a helper process if a file from a stranger is to be isolated.

        Raises:
            UnknownNoise: if other files may tell the noise levels of this one.
            OSError, ValueError: if it cannot be read, denoised or written.
        """

    def informed_by(self, results: Sequence[T]) -> Files[T] | None:
        """This kind with what the results tell of files whose noise is unknown; None if they tell nothing."""


class RawFiles(Files[Denoised]):
    """RAW files, denoised to DNGs.

    Args:
        denoiser: a :class:`FrameDenoiser`, or whatever it takes in its first place.
        options: the other arguments of :class:`FrameDenoiser`.

    Example:
        >>> denoise_file("in.dng", "out.dng", RawFiles("rawaug-base", noise="estimate"))  # doctest: +SKIP
    """

    what, formats = "RAW file", (".dng",)
    format_advice = DNG_ADVICE

    def __init__(self, denoiser: Any = None, *, levels: Shots | None = None, **options: Any) -> None:
        self.denoiser = denoiser if isinstance(denoiser, FrameDenoiser) else FrameDenoiser(denoiser, **options)
        self._levels = levels

    @property
    def settings(self) -> dict[str, Any]:
        return self.denoiser.settings

    def listing(self, folder: Path) -> Listing:
        listing = list_files(folder, RAW_EXTENSIONS, "neither RAW nor a picture that is known")
        if "RAW file" in listing.left_out:
            listing.left_out["RAW file"].advice = "there is no decoder for these kinds of RAW"
        if not listing.files:
            there = "; ".join(listing.lines()) or f"supported extensions are {', '.join(RAW_EXTENSIONS)}"
            raise ValueError(f"{folder}: contains no RAW file; {there}")
        return listing

    def target(self, file: Path) -> Path:
        return file.with_suffix(".dng")

    def require_preview(self, preview: Path) -> None:
        if self.denoiser.usual.demosaics:
            raise ValueError(
                f"--preview {preview}: --linear does not support it; open the linear DNG in a RAW developer"
            )

    def denoise(self, source: Path, out: Path, preview: Path | None = None, isolate: bool = False) -> Denoised:
        start = time.perf_counter()
        frame: RawFrame = isolated(read_raw, source, True) if isolate else read_raw(source, monochrome=True)
        denoised = self.denoiser(frame, self._levels)

        out.parent.mkdir(parents=True, exist_ok=True)
        write_dng(out, denoised.frame, source, rgb=denoised.rgb)
        seconds = time.perf_counter() - start
        if preview is not None:
            preview.parent.mkdir(parents=True, exist_ok=True)
            write_picture(preview, bayer.turn(develop(out), denoised.frame.upright_view))

        shot_var, read_var = denoised.levels or (0.0, 0.0)
        return Denoised(
            source=source,
            out=out,
            shot_var=shot_var,
            read_var=read_var,
            noise_source=denoised.noise_source,
            below_zero=denoised.below_zero,
            seconds=seconds,
            camera=frame.camera,
            iso=frame.iso,
            corrected=denoised.corrected,
        )

    def informed_by(self, results: Sequence[Denoised]) -> RawFiles | None:
        if self.denoiser.noise != "auto":
            return None
        by_shot: dict[tuple[str, float | None], list[Denoised]] = {}
        for done in results:
            if done.iso is not None:
                by_shot.setdefault((done.camera, done.iso), []).append(done)

        levels = {}
        for shot, files in by_shot.items():
            levels[shot] = fmean(done.shot_var for done in files), fmean(done.read_var for done in files)
        return RawFiles(self.denoiser, levels=levels)


class PictureFiles(Files[DenoisedPicture]):
    """Developed pictures, denoised to pictures with their EXIF, ICC profile and orientation."""

    what, formats = "picture", PICTURE_FORMATS
    format_advice = f"the source is a developed picture; its output is one of {', '.join(PICTURE_FORMATS)}"

    def __init__(self, denoiser: PictureDenoiser) -> None:
        self.denoiser = denoiser

    @property
    def settings(self) -> None:
        return None

    def listing(self, folder: Path) -> Listing:
        listing = list_files(folder, PICTURE_FORMATS, "not a picture that is known")
        for what in ("picture", "HEIC picture", "AVIF picture"):
            if what in listing.left_out:
                listing.left_out[what].advice = f"not written; denoise each to one of {', '.join(PICTURE_FORMATS)}"
        if not listing.files:
            there = "; ".join(listing.lines()) or f"supported extensions are {', '.join(PICTURE_FORMATS)}"
            raise ValueError(f"{folder}: contains no picture file; {there}")
        return listing

    def target(self, file: Path) -> Path:
        return file

    def require_preview(self, preview: Path) -> None:
        raise ValueError(f"--preview {preview}: is for RAW files")

    def denoise(self, source: Path, out: Path, preview: Path | None = None, isolate: bool = True) -> DenoisedPicture:
        start = time.perf_counter()
        stored = isolated(read_stored, source)
        height, width = stored.srgb.shape[-2:]
        if min(height, width) < 2:
            raise ValueError(f"{source}: is {width} x {height} pixels; at least 2 x 2 needed")

        denoised = self.denoiser(Noisy(stored.srgb[None]))[0]
        removed = 255.0 * (denoised - stored.srgb).square().mean().sqrt().item()
        out.parent.mkdir(parents=True, exist_ok=True)
        write_stored(out, denoised, stored)
        return DenoisedPicture(source, out, removed, time.perf_counter() - start)

    def informed_by(self, results: Sequence[DenoisedPicture]) -> None:
        return None
