"""The content of a file by its first bytes: camera RAW, a picture, or neither.

Names can be misleading: iPhones write HEIC that is renamed to .jpg; DNG, NEF and CR2 are TIFF files whose first picture
is a thumbnail; and downloads may have no extension at all. Every command asks :func:`identify_content`. If the bytes
say nothing (RAW without a header, an empty file), the extension decides, so that the reader can say what is wrong.

A TIFF is RAW if it has a DNG's version, or a directory whose pixels are a mosaic (photometric interpretation 32803) or
linear RAW (34892). Source: TIFF 6.0; DNG 1.7.1; ISO/IEC 14496-12 (brands of HEIF); the signatures of each format.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path
from typing import BinaryIO, Literal, NamedTuple

from rawaug.errors import count_of, escape, how_to_install
from rawaug.files import files_below, require_file
from rawaug.io.directories import PHOTOMETRIC, DamagedTags, TiffFile

RAW_EXTENSIONS = (
    *(".3fr", ".arw", ".cr2", ".cr3", ".crw", ".dcr", ".dng", ".erf", ".fff", ".iiq", ".kdc", ".mef", ".mos", ".mrw"),
    *(".nef", ".nrw", ".orf", ".pef", ".raf", ".raw", ".rw2", ".rwl", ".sr2", ".srf", ".srw"),
)
PICTURE_KINDS = ("picture", "HEIC picture", "AVIF picture")
"""What :class:`Listing` calls files of developed pictures."""

PICTURE_EXTENSIONS = (".bmp", ".exr", ".gif", ".jpeg", ".jpg", ".jxl", ".png", ".ppm", ".tif", ".tiff", ".webp")
"""Pictures with these extensions are read without an extra."""
HEIF_EXTENSIONS, AVIF_EXTENSIONS = (".heic", ".heif", ".hif"), (".avif",)
ALL_PICTURE_EXTENSIONS = (*PICTURE_EXTENSIONS, *HEIF_EXTENSIONS, *AVIF_EXTENSIONS)
_UNKNOWN_RAW = (".x3f", ".cap", ".eip", ".braw", ".r3d", ".ari", ".gpr")
"""RAW files with these extensions cannot be read; they are counted as RAW."""

Kind = Literal["raw", "picture", "other"]


class Content(NamedTuple):
    """The content of a file, and the name of its format, such as ``"JPEG"`` or ``"DNG"``."""

    kind: Kind
    format: str


_OTHER = Content("other", "unknown")
_SIGNATURES: tuple[tuple[int, bytes, Content], ...] = (
    (0, b"\xff\xd8\xff", Content("picture", "JPEG")),
    (0, b"\x89PNG\r\n\x1a\n", Content("picture", "PNG")),
    (0, b"GIF8", Content("picture", "GIF")),
    (8, b"WEBP", Content("picture", "WebP")),
    (0, b"\xff\x0a", Content("picture", "JPEG XL")),
    (0, b"\0\0\0\x0cJXL ", Content("picture", "JPEG XL")),
    (0, b"\0\0\0\x0cjP  ", Content("picture", "JPEG 2000")),
    (0, b"\xff\x4f\xff\x51", Content("picture", "JPEG 2000")),
    (0, b"BM", Content("picture", "BMP")),
    (0, b"\x76\x2f\x31\x01", Content("picture", "OpenEXR")),
    (0, b"#?RADIANCE", Content("picture", "Radiance")),
    (0, b"#?RGBE", Content("picture", "Radiance")),
    (0, b"8BPS", Content("picture", "PSD")),
    (0, b"FUJIFILMCCD-RAW", Content("raw", "RAF")),
    (6, b"HEAPCCDR", Content("raw", "CRW")),
    (0, b"\0MRM", Content("raw", "MRW")),
    (0, b"FOVb", Content("raw", "X3F")),
    (0, b"IIU\0", Content("raw", "RW2")),
    (0, b"IIRO", Content("raw", "ORF")),
    (0, b"IIRS", Content("raw", "ORF")),
    (0, b"MMOR", Content("raw", "ORF")),
    (8, b"CR\x02", Content("raw", "CR2")),
    (8, b"IIII", Content("raw", "IIQ")),
    (8, b"MMMM", Content("raw", "IIQ")),
)
_TIFF = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
_HEIC = (b"heic", b"heix", b"heim", b"heis", b"hevc", b"hevx", b"mif1", b"msf1")
_AVIF = (b"avif", b"avis")
_PORTABLE = tuple(b"P%d" % number for number in range(1, 8))
_DNG_VERSION, _LEAF = 50706, 34310
_RAW_PHOTOMETRICS = (32803, 34892)


def identify_content(path: str | Path) -> Content:
    """Identify a file by its first bytes, or by its extension if they say nothing.

    Raises:
        FileNotFoundError: if there is no such file.
        OSError: if it is not a regular file, or cannot be read.

    Example:
        >>> identify_content("IMG_0001.jpg").format  # doctest: +SKIP
        'HEIC'
    """
    path = Path(path)
    require_file(path)
    with path.open("rb") as file:
        return identify_opened(file, path)


def identify_opened(file: BinaryIO, path: Path) -> Content:
    """Identify a file that is open at its beginning, as :func:`identify_content` does."""
    head = file.read(64)
    content = _OTHER
    for offset, signature, of_signature in _SIGNATURES:
        if head.startswith(signature, offset):
            return of_signature

    if head.startswith(_TIFF):
        content = _of_tiff(file)
    elif head[4:8] == b"ftyp":
        content = _of_boxes(head)
    elif head.startswith(_PORTABLE) and head[2:3].isspace():
        content = Content("picture", "PNM")
    if content.kind != "other" and content.format != "TIFF":
        return content

    # The extension decides if the bytes say nothing; those of a TIFF can be either.
    extension = path.suffix.lower()
    if extension in (*RAW_EXTENSIONS, *_UNKNOWN_RAW):
        return Content("raw", extension[1:].upper())
    if extension in ALL_PICTURE_EXTENSIONS and content.kind == "other":
        return Content("picture", "unknown")
    return content


def is_raw(path: str | Path) -> bool:
    """Tell whether a file is camera RAW; see :func:`identify_content`."""
    return identify_content(path).kind == "raw"


def _of_boxes(head: bytes) -> Content:
    """Identify a file of boxes by its brands: its own comes first, then those that it is compatible with."""
    size = int.from_bytes(head[:4], "big")
    brands = [head[8:12]] + [head[offset : offset + 4] for offset in range(16, min(size, len(head)), 4)]
    if b"crx " in brands:
        return Content("raw", "CR3")

    for brand in brands:
        if brand in _AVIF:
            return Content("picture", "AVIF")
    for brand in brands:
        if brand in _HEIC:
            return Content("picture", "HEIC")
    return _OTHER


def _of_tiff(file: BinaryIO) -> Content:
    """Tell RAW from a picture; with damaged directories it is a picture, and its reader will report them."""
    try:
        tiff = TiffFile(file)
        for directory in tiff.directories():
            if _DNG_VERSION in directory.entries:
                return Content("raw", "DNG")
            photometric = tiff.number(directory, PHOTOMETRIC, -1)
            if photometric in _RAW_PHOTOMETRICS or _LEAF in directory.entries:
                return Content("raw", "RAW based on TIFF")
    except DamagedTags:
        pass
    return Content("picture", "TIFF")


# -- folders of files of many kinds ------------------------------------------------------------------------------------


_MAX_EXTENSIONS = 6
"""A line lists at most this many extensions."""


@dataclass
class Listing:
    """The files of a folder and its subfolders.

    Attributes:
        files: those that are read, sorted by path.
        left_out: how many others there are of each extension, by kind.
        advice: what to do with the others, by kind.
    """

    files: list[Path] = field(default_factory=list)
    left_out: dict[str, Counter[str]] = field(default_factory=dict)
    advice: dict[str, str] = field(default_factory=dict)

    def lines(self, elsewhere: Collection[str] = ()) -> list[str]:
        """Write a line for each kind that is left out, but for kinds that are taken care of ``elsewhere``."""
        lines = []
        for kind, extensions in self.left_out.items():
            if kind in elsewhere:
                continue
            counts = []
            for extension, count in extensions.most_common(_MAX_EXTENSIONS):
                counts.append(f"{escape(extension) or 'no extension'} {count}")
            names = ", ".join(counts)
            if len(extensions) > _MAX_EXTENSIONS:
                names += f", {len(extensions) - _MAX_EXTENSIONS} other extensions"
            lines.append(f"{count_of(extensions.total(), kind)} left out ({names}): {self.advice[kind]}")
        return lines

    def leave_out(self, kind: str, advice: str, extension: str) -> None:
        """Count a file that is not read."""
        self.advice.setdefault(kind, advice)
        self.left_out.setdefault(kind, Counter())[extension] += 1


def picture_extensions() -> tuple[str, ...]:
    """List the extensions of the pictures that can be read here; HEIC and AVIF need their decoders."""
    extensions: tuple[str, ...] = PICTURE_EXTENSIONS
    if reads_heic():
        extensions += HEIF_EXTENSIONS
    if reads_avif():
        extensions += AVIF_EXTENSIONS
    return extensions


def reads_heic() -> bool:
    """Tell whether the decoder of HEIC is installed."""
    return find_spec("pillow_heif") is not None


def reads_avif() -> bool:
    """Tell whether Pillow is installed in a version that reads AVIF."""
    return find_spec("PIL") is not None and find_spec("PIL.AvifImagePlugin") is not None


def list_pictures(path: str | Path) -> Listing:
    """List the pictures of a folder and its subfolders by their extensions, and count other files by kind.

    No file is opened, so a folder of a million files is listed in seconds. The path of a file stands for that file.

    Raises:
        FileNotFoundError: if there is no such file or folder.
        ValueError: if there is no picture that can be read; the message says what there is.
    """
    path = Path(path)
    if not path.is_dir():
        require_file(path, "picture file or folder")
        return Listing([path])

    listing = list_files(path, picture_extensions(), "not a picture that is known")
    if not listing.files:
        contents = "; ".join(listing.lines())
        if not contents:
            contents = f"supported extensions are {', '.join(picture_extensions())}"
        raise ValueError(f"{path}: contains no picture file; {contents}")
    return listing


def list_files(folder: Path, taken: Sequence[str], other: str) -> Listing:
    """List the files of a folder whose extensions are ``taken``, and count others by kind, ``other`` last."""
    advice = _advice_by_extension(other)
    listing = Listing()
    for file in files_below(folder):
        extension = file.suffix.lower()
        if extension in taken:
            listing.files.append(file)
        else:
            what, why = advice.get(extension, ("other file", other))
            listing.leave_out(what, why, extension)

    listing.files.sort()
    order = (*PICTURE_KINDS, "RAW file", "other file")
    listing.left_out = {what: listing.left_out[what] for what in order if what in listing.left_out}
    return listing


def _advice_by_extension(other: str) -> dict[str, tuple[str, str]]:
    """Say what files of an extension are called and what to do with them."""
    advice: dict[str, tuple[str, str]] = {}
    for extension in PICTURE_EXTENSIONS:
        advice[extension] = ("picture", "call the command on a folder of them alone")
    for extension in (*RAW_EXTENSIONS, *_UNKNOWN_RAW):
        advice[extension] = ("RAW file", "not developed pictures; develop them first, or use commands for RAW")
    for extension in HEIF_EXTENSIONS:
        advice[extension] = ("HEIC picture", f"pillow_heif is not installed; {how_to_install('heif')}")
    for extension in AVIF_EXTENSIONS:
        advice[extension] = ("AVIF picture", f"this Pillow does not read them; {how_to_install('heif')}")
    return advice
