"""Kinds of files that are denoised: RAW to DNG, and pictures to pictures.

A kind says which files of a folder are its own, what their results are called, and how one file is read, denoised and
written. :mod:`rawaug.denoising.files` does the rest, which is the same for all kinds; :func:`kind_of` tells the kind of
a file or a folder.
"""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean
from typing import Any, ClassVar, Generic, TypeVar

from denoisers.files import JOINT
from rawaug import bayer
from rawaug.denoising.base import Noisy
from rawaug.denoising.corrections import Corrected, Correction, Corrections
from rawaug.denoising.frames import DNG_ADVICE, FrameDenoiser
from rawaug.denoising.levels import Noise, Shots
from rawaug.denoising.pictures import PictureDenoiser
from rawaug.errors import escape
from rawaug.files import files_below
from rawaug.io import RawFrame, read_raw, write_dng, write_picture
from rawaug.io.content import (
    ALL_PICTURE_EXTENSIONS,
    RAW_EXTENSIONS,
    Listing,
    content_of,
    list_files,
    picture_extensions,
)
from rawaug.io.isolated import isolated
from rawaug.io.raw import develop
from rawaug.io.stored import PICTURE_FORMATS, StoredPicture, read_stored, write_stored
from rawaug.registry import Spec

_LINEAR = (".exr",)
"""Pictures of linear light have these extensions."""
_SUBSTITUTE = ".png"
"""Pictures whose own format is read but not written have results in this format, which loses nothing."""
PREVIEWS = (".jpg", ".jpeg", ".png")
"""Previews of RAW files have these extensions."""


@dataclass(frozen=True)
class Denoised:
    """The record of what was done to a RAW file.

    Attributes:
        source, out: the files.
        shot_var, read_var: the noise levels that the denoiser was given.
        noise_source: where the levels come from.
        below_zero: the share of sites whose result was below the digital number 0.
        seconds: the time for reading, denoising and writing.
        camera, iso: the source's camera and ISO.
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
    """The record of what was done to a picture; ``deviation`` is the removed noise's, in units of 1/255."""

    source: Path
    out: Path
    deviation: float
    seconds: float

    def __str__(self) -> str:
        return f"{escape(self.out)}: noise of {self.deviation:.1f} in 255 removed, {self.seconds:.1f} s"


@dataclass(frozen=True)
class Options:
    """The settings by which files of any kind are denoised.

    Attributes:
        denoiser: a name or a file; None for the shipped denoiser of the kind of files.
        classical: a filter in place of a network.
        noise: where the noise levels of RAW come from, see :data:`rawaug.denoising.levels.Noise`.
        strength: 1 removes the noise.
        linear: whether RAW is demosaiced, too.
        self_ensemble: whether eight views are averaged.
        greens: whether greens of RAW that differ are balanced.
        device: where a network runs.

    Raises:
        ValueError: if they contradict one another.
    """

    denoiser: str | Path | None = None
    classical: Spec | None = None
    noise: Noise = "auto"
    strength: float = 1.0
    linear: bool = False
    self_ensemble: bool = False
    greens: Correction = "auto"
    device: str = "auto"

    def __post_init__(self) -> None:
        if self.classical is not None and (self.denoiser is not None or self.self_ensemble or self.linear):
            raise ValueError(
                "classical: a filter takes no --denoiser, --self-ensemble or --linear; give one or the other"
            )

    @property
    def spec(self) -> Any:
        """The filter or the denoiser that is used; None for the shipped one."""
        return self.denoiser if self.classical is None else self.classical

    @property
    def changes(self) -> dict[str, Any]:
        """The attributes of a denoiser that the options set."""
        changes: dict[str, Any] = {"strength": self.strength}
        if self.self_ensemble:
            changes["views"] = 8
        return changes


T = TypeVar("T", bound=Denoised | DenoisedPicture)
K = TypeVar("K", bound="Files[Any]")


class Files(ABC, Generic[T]):
    """One kind of files."""

    what: ClassVar[str]
    """A file of this kind is called this."""

    formats: ClassVar[tuple[str, ...]]
    """Results have these extensions."""

    format_advice: ClassVar[str]
    """This is said of other extensions."""

    others: ClassVar[str]
    """This is said of files in a folder that are of no kind."""

    @classmethod
    @abstractmethod
    def of(cls: type[K], source: str | Path, options: Options) -> K:
        """Make this kind with the options; raise ValueError if one of them does not apply to ``source``."""

    @property
    def settings(self) -> dict[str, Any] | None:
        """Return what the results depend on, as JSON; None if a folder's results may be of several settings."""
        return None

    @abstractmethod
    def extensions(self) -> tuple[str, ...]:
        """Return the extensions of the files of a folder that are of this kind."""

    def listing(self, folder: Path) -> Listing:
        """List the files of a folder that are of this kind; raise ValueError if there is none."""
        extensions = self.extensions()
        listing = list_files(folder, extensions, self.others)
        self._advise(listing)
        if not listing.files:
            contents = "; ".join(listing.lines()) or f"supported extensions are {', '.join(extensions)}"
            raise ValueError(f"{folder}: contains no {self.what} file; {contents}")
        return listing

    @abstractmethod
    def _advise(self, listing: Listing) -> None:
        """Say what to do with files that are left out, if this kind knows better."""

    def remarks(self, files: Sequence[Path]) -> list[str]:
        """Write lines on the results of these files of a folder."""
        return []

    @abstractmethod
    def target(self, file: Path) -> Path:
        """Name the result of a file; both paths are relative to their folders."""

    @abstractmethod
    def require_preview(self, preview: Path) -> None:
        """Raise ValueError if this kind writes no previews."""

    def write_preview(self, result: Path, preview: Path) -> None:
        """Write a picture of a result that is there already."""
        raise NotImplementedError(f"{self.what}: has no previews")

    @abstractmethod
    def denoise(self, source: Path, out: Path, preview: Path | None = None, isolate: bool = False) -> T:
        """Read, denoise and write a file, in a helper process if a file from a stranger is to be isolated.

        Raises:
            UnknownNoise: if other files may show the noise levels of this one.
            OSError, ValueError: if it cannot be read, denoised or written.
        """

    def informed_by(self, results: Sequence[T]) -> Files[T] | None:
        """Return this kind with what the results tell about files of unknown noise, or None if they tell nothing."""
        return None


class RawFiles(Files[Denoised]):
    """RAW files, which are denoised to DNGs.

    Args:
        denoiser: a :class:`FrameDenoiser`, or whatever it takes in its first place.
        options: the other arguments of :class:`FrameDenoiser`.

    Example:
        >>> denoise_file("in.dng", "out.dng", RawFiles("rawaug-base", noise="estimate"))  # doctest: +SKIP
    """

    what = "RAW"
    formats = (".dng",)
    format_advice = DNG_ADVICE
    others = "neither RAW nor a picture that is known"

    def __init__(self, denoiser: Any = None, *, levels: Shots | None = None, **options: Any) -> None:
        if not isinstance(denoiser, FrameDenoiser):
            denoiser = FrameDenoiser(denoiser, **options)
        self.denoiser = denoiser
        self._levels = levels

    @classmethod
    def of(cls, source: str | Path, options: Options) -> RawFiles:
        spec = options.spec
        if spec is None and options.linear:
            spec = JOINT

        corrections = Corrections(options.greens)
        denoiser = FrameDenoiser(spec, options.noise, corrections, options.device, **options.changes)
        denoiser.usual.require_linear(options.linear)
        return cls(denoiser)

    @property
    def settings(self) -> dict[str, Any]:
        return self.denoiser.settings

    def extensions(self) -> tuple[str, ...]:
        return RAW_EXTENSIONS

    def _advise(self, listing: Listing) -> None:
        if "RAW file" in listing.left_out:
            listing.left_out["RAW file"].advice = "there is no decoder for these kinds of RAW"

    def target(self, file: Path) -> Path:
        return file.with_suffix(".dng")

    def require_preview(self, preview: Path) -> None:
        self.denoiser.usual.require_preview(preview)

    def write_preview(self, result: Path, preview: Path) -> None:
        upright = read_raw(result, monochrome=True).upright_view
        write_picture(preview, bayer.turn(develop(result), upright))

    def denoise(self, source: Path, out: Path, preview: Path | None = None, isolate: bool = False) -> Denoised:
        start = time.perf_counter()
        frame: RawFrame
        if isolate:
            frame = isolated(read_raw, source, True)
        else:
            frame = read_raw(source, monochrome=True)

        denoised = self.denoiser(frame, self._levels)

        write_dng(out, denoised.frame, source, rgb=denoised.rgb)
        seconds = time.perf_counter() - start

        if preview is not None:
            self.write_preview(out, preview)

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
            shot_var = fmean(done.shot_var for done in files)
            read_var = fmean(done.read_var for done in files)
            levels[shot] = shot_var, read_var
        return RawFiles(self.denoiser, levels=levels)


class PictureFiles(Files[DenoisedPicture]):
    """Developed pictures, which are denoised to pictures with their EXIF, ICC profile and orientation."""

    what = "picture"
    formats = PICTURE_FORMATS
    format_advice = f"the source is a developed picture; its output is one of {', '.join(PICTURE_FORMATS)}"
    others = "not a picture that is known"

    def __init__(self, denoiser: PictureDenoiser) -> None:
        self.denoiser = denoiser

    @classmethod
    def of(cls, source: str | Path, options: Options) -> PictureFiles:
        of_raw = {"--linear": options.linear, "--greens": options.greens != "auto", "--noise": options.noise != "auto"}
        for option, is_set in of_raw.items():
            if is_set:
                raise ValueError(f"{source}: is a developed picture; {option} is for RAW")

        spec = PictureDenoiser.default if options.spec is None else options.spec
        return cls(PictureDenoiser.of(spec, options.device, "auto", **options.changes))

    def extensions(self) -> tuple[str, ...]:
        return tuple(extension for extension in picture_extensions() if extension not in _LINEAR)

    def _advise(self, listing: Listing) -> None:
        if "picture" in listing.left_out:
            listing.left_out["picture"].advice = "linear light; save it as a developed picture"

    def target(self, file: Path) -> Path:
        """Keep the name of the file, with ``.png`` appended if its format is read but not written."""
        if file.suffix.lower() in PICTURE_FORMATS:
            return file
        return file.with_name(file.name + _SUBSTITUTE)

    def remarks(self, files: Sequence[Path]) -> list[str]:
        counts = Counter(file.suffix.lower() for file in files if self.target(file) != file)
        if not counts:
            return []

        listed = ", ".join(f"{extension} {count}" for extension, count in counts.most_common())
        plural = "s have" if counts.total() > 1 else " has"
        return [f"{counts.total()} result{plural} another format than the source, {_SUBSTITUTE}: {listed}"]

    def require_preview(self, preview: Path) -> None:
        raise ValueError(f"--preview {preview}: is for RAW files")

    def denoise(self, source: Path, out: Path, preview: Path | None = None, isolate: bool = True) -> DenoisedPicture:
        start = time.perf_counter()
        picture: StoredPicture = isolated(read_stored, source)
        srgb = picture.srgb
        height, width = srgb.shape[-2:]
        if min(height, width) < 2:
            raise ValueError(f"{source}: is {width} x {height} pixels; at least 2 x 2 needed")

        denoised = self.denoiser(Noisy(srgb[None]))[0]
        deviation = 255.0 * (denoised - srgb).square().mean().sqrt().item()

        write_stored(out, denoised, picture)
        return DenoisedPicture(source, out, deviation, time.perf_counter() - start)


KINDS: dict[str, type[Files[Any]]] = {"raw": RawFiles, "picture": PictureFiles}
"""This maps the content of a file to its kind."""


def kind_of(source: str | Path) -> type[Files[Any]]:
    """Find the kind of a file by its content; a folder is of pictures if it has some and no RAW file.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is a file of no kind.
    """
    path = Path(source)
    if path.is_dir():
        extensions = {file.suffix.lower() for file in files_below(path)}
        has_pictures = not extensions.isdisjoint(ALL_PICTURE_EXTENSIONS)
        if has_pictures and extensions.isdisjoint(RAW_EXTENSIONS):
            return PictureFiles
        return RawFiles

    content = content_of(path)
    if content.kind not in KINDS:
        raise ValueError(f"{path}: is neither camera RAW nor a picture of a known format; check that it is complete")
    return KINDS[content.kind]
