"""Denoising of files and folders, as far as it is the same for RAW and pictures.

A folder's results have the same names in another folder, and results that are already there are left. A file that
cannot be read, or whose decoder crashes or hangs, is named and counted, and the other files are still processed.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, Generic, TypeVar

from rawaug.denoising.levels import UnknownNoise
from rawaug.errors import count_of
from rawaug.files import one_at_a_time, require_file, require_folder, require_output, require_same_settings
from rawaug.io import RawFrame
from rawaug.io.content import Listing
from rawaug.progress import progress

PREVIEWS = (".jpg", ".jpeg", ".png")
"""The extensions of previews of RAW files."""

SETTINGS = "denoise.json"
"""The file in a folder of results that says how they were made."""


T = TypeVar("T")


class Files(ABC, Generic[T]):
    """One kind of files."""

    what: ClassVar[str]
    """The noun for a file of this kind."""

    formats: ClassVar[tuple[str, ...]]
    """The extensions of results."""

    format_advice: ClassVar[str]
    """The advice about another extension."""

    @property
    def settings(self) -> dict[str, Any] | None:
        """Return what the results depend on, as JSON; None if a folder's results may be of several settings."""
        return None

    @abstractmethod
    def listing(self, folder: Path) -> Listing:
        """List the files of a folder that are of this kind; raise ValueError if there is none."""

    def require_files(self, folder: Path, listing: Listing, extensions: Sequence[str]) -> Listing:
        """Return the listing of a folder; raise ValueError if it has no file of these extensions."""
        if not listing.files:
            contents = "; ".join(listing.lines()) or f"supported extensions are {', '.join(extensions)}"
            raise ValueError(f"{folder}: contains no {self.what} file; {contents}")
        return listing

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
    def denoise(
        self, source: Path | RawFrame, out: Path | None = None, preview: Path | None = None, isolate: bool = False
    ) -> tuple[Any, T]:
        """Read, denoise and write a file.

        Args:
            source: the file, or a frame in memory where this kind is of RAW.
            out: the result; None writes none.
            preview: a picture of the result to write as well.
            isolate: read the file in a helper process, which a damaged file may end.

        Returns:
            The image, and what was done.

        Raises:
            UnknownNoise: if other files may show the noise levels of this one.
            OSError, ValueError: if it cannot be read, denoised or written.
        """

    def informed_by(self, results: Sequence[T]) -> Files[T] | None:
        """Return this kind with what the results tell about files of unknown noise, or None if they tell nothing."""
        return None


@dataclass
class DenoisedFolder(Generic[T]):
    """What was done to a folder.

    Attributes:
        files: what was done to each file.
        existing: how many results were there already.
        broken: the reason for each file that failed, by its path.
        left_out: a line for each kind of file that was not denoised.
        remarks: other lines, such as on formats that are not written.
    """

    files: list[T] = field(default_factory=list)
    existing: int = 0
    broken: dict[str, str] = field(default_factory=dict)
    left_out: list[str] = field(default_factory=list)
    remarks: list[str] = field(default_factory=list)

    def __iadd__(self, other: DenoisedFolder[Any]) -> DenoisedFolder[Any]:
        """Add what was done to the files of another kind."""
        self.files += other.files
        self.existing += other.existing
        self.broken |= other.broken
        self.left_out += other.left_out
        self.remarks += other.remarks
        return self


def denoise_file(
    source: str | Path,
    out: str | Path | None,
    kind: Files[T],
    *,
    preview: str | Path | None = None,
    overwrite: bool = False,
) -> tuple[Any, T]:
    """Denoise one file.

    Args:
        source: the file.
        out: the result; its folder is created. None writes none.
        kind: how files of this kind are denoised.
        preview: a .jpg or .png of the result of a RAW file as LibRaw develops it.
        overwrite: replace ``out`` and ``preview`` if they exist.

    Returns:
        The denoised image, and what was done.

    Raises:
        FileNotFoundError, OSError: if a file is missing or cannot be read or written.
        ValueError: if the source cannot be denoised, or ``out`` has another extension, is the source itself, or already
            exists.
    """
    source = Path(source)
    require_file(source, f"{kind.what} file")
    if out is not None:
        out = require_output(out, overwrite, kind.formats, [source], kind.format_advice)
    if preview is not None:
        if out is None:
            raise ValueError("preview= shows a result that is written; give out=")
        preview = require_output(preview, overwrite, PREVIEWS, [source], "the preview is a .jpg or .png")
        kind.require_preview(preview)
    return kind.denoise(source, out, preview)


@one_at_a_time(lambda source, out, *_, **__: Path(out))
def denoise_folder(
    source: str | Path,
    out: str | Path,
    kind: Files[T],
    *,
    previews: str | Path | None = None,
    overwrite: bool = False,
    elsewhere: Collection[str] = (),
) -> DenoisedFolder[T]:
    """Denoise the files of a folder and its subfolders; existing results are left.

    Args:
        source: the folder.
        out: the folder of the results.
        kind: how files of this kind are denoised.
        previews: a folder for a JPEG of each result of a RAW file as LibRaw develops it.
        overwrite: replace existing results.
        elsewhere: kinds of files, as :class:`rawaug.io.content.Listing` calls them, that another call denoises.

    Returns:
        What was done, and what was not.

    Raises:
        OSError: if a result cannot be written.
        ValueError: if the folder holds no file of this kind, two of them would have the same result, none can be
            denoised, or ``out`` holds results of other settings.
    """
    source, out = Path(source), Path(out)
    listing = kind.listing(source)
    _require_outside(out, source)
    targets = _name_targets(source, out, kind, listing.files)
    previews_of = {}
    if previews is not None:
        previews_of = _name_previews(source, out, Path(previews), kind, targets, overwrite)

    require_folder(out)
    if kind.settings is not None:
        advice = "choose another folder, or replace all results by overwrite=True"
        require_same_settings(out / SETTINGS, kind.settings, overwrite, advice)

    result: DenoisedFolder[T] = DenoisedFolder(left_out=listing.lines(elsewhere))
    unknown = []
    denoised: list[Path] = []
    for file in progress(listing.files, label="denoise", unit="file", leave=True):
        target, preview = targets[file], previews_of.get(file)
        if target.exists() and not overwrite:
            result.existing += 1
            if preview is not None and not preview.exists():  # a run was stopped between the two
                kind.write_preview(target, preview)
            continue

        try:
            _, done = kind.denoise(file, target, preview, isolate=True)
            result.files.append(done)
            denoised.append(file)
        except UnknownNoise as error:
            unknown.append(file)
            result.broken[str(file)] = f"noise unknown: {_with_name(error, file)}"
        except (OSError, ValueError) as error:
            _raise_if_unwritable(error, target, preview)
            result.broken[str(file)] = f"broken: {_with_name(error, file)}"

    informed = kind.informed_by(result.files)
    if informed is not None:
        for file in unknown:
            try:
                _, done = informed.denoise(file, targets[file], previews_of.get(file), isolate=True)
            except UnknownNoise:
                continue
            result.files.append(done)
            denoised.append(file)
            del result.broken[str(file)]

    if len(result.broken) == len(targets):
        raise ValueError(
            f"{source}: none of its {count_of(len(targets), 'file')} can be denoised; {min(result.broken.values())}"
        )

    result.remarks = kind.remarks(denoised)
    return result


def _name_targets(source: Path, out: Path, kind: Files[T], files: Sequence[Path]) -> dict[Path, Path]:
    """Name the result of each file; raise ValueError if two files would have the same."""
    targets: dict[Path, Path] = {}
    taken: set[Path] = set()
    for file in files:
        target = out / kind.target(file.relative_to(source))
        if target in taken:
            raise ValueError(f"{file}: another file of {file.parent} has this stem, and both would become {target}")
        targets[file] = target
        taken.add(target)
    return targets


def _name_previews(
    source: Path, out: Path, folder: Path, kind: Files[T], targets: dict[Path, Path], overwrite: bool
) -> dict[Path, Path]:
    """Name the preview of each file, in the subfolders of ``folder``.

    Previews never lie among the sources, where a JPEG of the same name is the camera's own. A JPEG without a result
    beside it is not a preview of ours, and is not replaced.
    """
    kind.require_preview(folder)
    if folder.suffix.lower() in PREVIEWS and not folder.is_dir():
        raise ValueError(f"preview={folder}: the source is a folder, and so are its previews; give a folder")
    _require_outside(folder, source)
    require_folder(folder)

    previews = {}
    for file, target in targets.items():
        preview = folder / target.relative_to(out).with_suffix(".jpg")
        if not target.exists():
            require_output(preview, overwrite)
        previews[file] = preview
    return previews


def _require_outside(folder: Path, source: Path) -> None:
    """Raise ValueError if an output folder is the source folder or lies inside it."""
    if folder.resolve().is_relative_to(source.resolve()):
        raise ValueError(f"{folder}: is inside the source folder {source}; choose an output folder outside it")


def _raise_if_unwritable(error: Exception, *files: Path | None) -> None:
    """Raise a write error, such as one of a full disk, which is no fault of the source."""
    if not isinstance(error, OSError):
        return

    for file in files:
        if file is not None and error.filename in (str(file), str(file.parent)):
            raise error


def _with_name(error: Exception, file: Path) -> str:
    text = str(error)
    if file.stem in text:
        return text
    return f"{file}: {text}"
