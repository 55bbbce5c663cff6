"""A folder of noisy/clean RAW pairs, yours or written by ``rawaug synth``: ``pairs:PATH``.

The clean frame of ``NAME_noisy.EXT`` is ``NAME_clean.EXT`` beside it; NPZ and MATLAB files with other names hold both.
Patterns match files with other names: ``*`` and ``?`` stand for the same text in the patterns of noisy and clean files.
:mod:`rawaug.data.formats` lists the formats.
"""

from __future__ import annotations

import os
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

from rawaug.bayer import CFA
from rawaug.data.development import UNKNOWN_COLOUR, develop_pair
from rawaug.data.folders import RawFolder
from rawaug.data.formats import READABLE, TWO_IN_ONE, read_mosaic
from rawaug.data.frames import Frames
from rawaug.data.mosaic_metadata import parse_metadata
from rawaug.data.pairs import DATASETS, Pair
from rawaug.files import files_below
from rawaug.io import RawFrame

NOISY, CLEAN = "*_noisy.*", "*_clean.*"
"""The file names of ``rawaug synth``."""

_WILD = re.compile(r"[*?]")


@dataclass
class MosaicSettings:
    """How the mosaics of ``pairs:PATH`` are read if their files do not state it.

    Args:
        cfa: CFA of files in pairs:PATH that do not state it: RGGB, BGGR, GRBG or GBRG.
        black: black level of files in pairs:PATH that do not state it; one value, or four for R, Gr, Gb, B.
        white: white level of files in pairs:PATH that do not state it.
    """

    cfa: str | None = None
    black: float | tuple[float, float, float, float] | None = None
    white: float | None = None


@dataclass
class PairSettings(MosaicSettings):
    """How noisy/clean pairs are found and read if ``pairs:PATH`` alone does not determine it.

    Args:
        noisy: pattern of the noisy files' names in pairs:PATH, such as ``*_noisy.*``, as rawaug synth names them.
        clean: pattern of the clean files' names in pairs:PATH; by default ``noisy`` with clean in place of noisy.
    """

    noisy: str | None = None
    clean: str | None = None


class PairFiles(NamedTuple):
    name: str
    noisy: Path
    clean: Path


@DATASETS.register("pairs")
class PairFolder(Frames[Pair]):
    """The noisy/clean pairs of a folder and its subfolders, sorted by path; or those of one noisy (or two-in-one) file.

    The sRGB picture of a pair is the clean frame, developed without a tone curve. Where no file states white balance
    and colour matrix, they are 1 and the identity, and ``color_known`` is false. A folder has no splits.

    Args:
        path: where the pairs are.
        noisy: a pattern with a slash matches paths; files of other names are left out. Without a pattern all readable
            files must belong to a pair by the naming of ``rawaug synth``.
        clean, cfa, black, white: as in :class:`PairSettings`.
    """

    def __init__(
        self,
        path: str | Path,
        split: str = "train",
        noisy: str | None = None,
        clean: str | None = None,
        cfa: str | None = None,
        black: float | Sequence[float] | None = None,
        white: float | None = None,
    ) -> None:
        self.given = parse_metadata({"cfa": cfa, "black": black, "white": white}, f"pairs:{path}")
        self.pairs = _pairs_below(Path(path), noisy, clean)
        super().__init__([pair.name for pair in self.pairs])

    def frame_files(self, index: int) -> Sequence[Path]:
        _, noisy, clean = self.pairs[index]
        if noisy == clean:
            return (noisy,)
        return (noisy, clean)

    def stamp(self, index: int) -> str:
        stamp = super().stamp(index)
        metadata = (self.given.get("cfa"), self.given.get("black"), self.given.get("white"))
        if any(metadata):
            stamp += f" {metadata}"
        return stamp

    def read(self, index: int) -> Pair:
        name, noisy_file, clean_file = self.pairs[index]
        alone = noisy_file == clean_file
        noisy = read_mosaic(noisy_file, "noisy", self.given, alone, self.max_pixels)
        clean = read_mosaic(clean_file, "clean", self.given, alone, self.max_pixels)

        difference = ""
        if noisy.cfa != clean.cfa:
            difference = f"CFA, {clean.cfa} and {noisy.cfa}"
        if noisy.mosaic.shape != clean.mosaic.shape:
            difference = f"size, {tuple(clean.mosaic.shape[1:])} and {tuple(noisy.mosaic.shape[1:])}"
        if difference:
            raise ValueError(f"{noisy_file}: the clean and the noisy frame differ in {difference}")
        if noisy.cfa not in CFA.__members__:
            raise ValueError(
                f"{noisy_file}: has the pattern {noisy.cfa}, but pairs need a Bayer pattern; check it as a RAW file"
            )

        gains, matrix = UNKNOWN_COLOUR
        if clean.color_known:
            gains, matrix = clean.white_balance, clean.color_matrix
        elif noisy.color_known:
            gains, matrix = noisy.white_balance, noisy.color_matrix
        frame = RawFrame(
            clean.mosaic,
            clean.cfa,
            white_balance=gains,
            color_matrix=matrix,
            camera=noisy.camera,
            iso=noisy.iso,
            color_known=clean.color_known or noisy.color_known,
        )
        capture = replace(frame, mosaic=noisy.mosaic, noise_profile=noisy.noise_profile)
        return develop_pair(name, frame, capture)


def require_no_pairs(folder: RawFolder, spec: str, as_clean: bool) -> None:
    """Raise ValueError if a folder of RAW files holds noisy frames, by their names."""
    files = set(map(os.path.realpath, folder.files))
    for file in folder.files:
        match = re.fullmatch(r"(.*)_noisy", file.stem, re.IGNORECASE)
        if match is None:
            continue

        partner = file.with_name(f"{match[1]}_clean{file.suffix}")
        if os.path.realpath(partner) in files:
            raise ValueError(f"{file}: is the noisy frame of {partner.name}; read both as pairs:{spec}")
        if as_clean:
            advice = f"noisy/clean pairs are read as pairs:{spec}; rename it if it is clean"
            raise ValueError(f"{file}: is noisy by its name and would be taken for a clean frame; {advice}")


def looks_like_pairs(files: Sequence[Path]) -> bool:
    """Whether there are files as ``rawaug synth`` writes them: a noisy frame beside its clean one, or NPZ."""
    names = {str(file).casefold() for file in files if file.suffix.lower() in READABLE}
    for name in names:
        partner = re.sub(r"_noisy(\.\w+)$", r"_clean\1", name)
        if name.endswith(".npz") or (partner != name and partner in names):
            return True
    return False


def _pairs_below(path: Path, noisy: str | None, clean: str | None) -> list[PairFiles]:
    """The pairs of a folder, or those that a file belongs to, sorted by path."""
    if not path.exists():
        raise FileNotFoundError(f"{path}: no such folder of noisy/clean pairs")
    top = path if path.is_dir() else path.parent
    files = sorted(files_below(top, READABLE))

    pairs = pairs_by_pattern(top, files, noisy or NOISY, clean or clean_pattern(noisy or NOISY))
    if noisy is None:
        unpaired = set(files)
        for pair in pairs:
            unpaired -= {pair.noisy, pair.clean}
        pairs = pairs + _two_in_one(top, sorted(unpaired), is_strict=path.is_dir())
    if path.is_file():
        pairs = [pair for pair in pairs if path in (pair.noisy, pair.clean)]
    if not pairs:
        names = noisy or f"{NOISY}, {CLEAN}"
        raise ValueError(f"{path}: contains no noisy/clean pair named {names}{_unread_kinds(top)}")

    counts = Counter(pair.name for pair in pairs)
    unique = []
    for pair in sorted(pairs, key=lambda pair: pair.noisy):
        if counts[pair.name] > 1:
            pair = pair._replace(name=pair.noisy.relative_to(top).as_posix())
        unique.append(pair)
    return unique


def _two_in_one(top: Path, files: Sequence[Path], is_strict: bool) -> list[PairFiles]:
    """The files that hold both mosaics of a pair; others raise a ValueError if ``is_strict``."""
    pairs = []
    others = []
    for file in files:
        if file.suffix.lower() in TWO_IN_ONE:
            pairs.append(PairFiles(_stem(top, file), file, file))
        else:
            others.append(file)

    if others and is_strict:
        more = ""
        if len(others) > 1:
            more = f" (and {len(others) - 1} others)"
        raise ValueError(f"{others[0]}{more}: is neither {NOISY} nor {CLEAN}; give a pattern of the noisy files")
    return pairs


def _unread_kinds(top: Path) -> str:
    """A clause that lists the extensions of files with noisy or clean in their names that cannot be read."""
    extensions = set()
    for file in files_below(top):
        is_of_pair = re.search("noisy|clean", file.stem, re.IGNORECASE)
        if is_of_pair and file.suffix.lower() not in READABLE:
            extensions.add(file.suffix.lower())
    if not extensions:
        return ""
    return f"; {', '.join(sorted(extensions))} is not read, use .npz, .npy, .tiff, .png or .mat"


def pairs_by_pattern(top: Path, files: Sequence[Path], noisy: str, clean: str) -> list[PairFiles]:
    """Match every noisy file with its clean one."""
    if len(_WILD.findall(noisy)) != len(_WILD.findall(clean)):
        raise ValueError(f"the patterns {noisy} and {clean} must have the same number of * and ?")
    of_noisy = _by_wild_parts(top, files, noisy)
    of_clean = _by_wild_parts(top, files, clean)
    for parts in sorted(of_noisy.keys() ^ of_clean.keys()):
        if parts in of_noisy:
            raise FileNotFoundError(f"{of_noisy[parts]}: has no clean frame named {clean}; add it, or set that pattern")
        raise FileNotFoundError(f"{of_clean[parts]}: has no noisy frame named {noisy}; add it, or remove this one")
    same = of_noisy.items() & of_clean.items()
    if same:
        raise ValueError(f"{min(same)[1]}: would be its own clean frame by the pattern {clean}")

    pairs = []
    for parts, file in of_noisy.items():
        name = re.sub(r"_noisy$", "", _stem(top, file), flags=re.IGNORECASE)
        pairs.append(PairFiles(name, file, of_clean[parts]))
    return pairs


def _by_wild_parts(top: Path, files: Sequence[Path], pattern: str) -> dict[tuple[str, ...], Path]:
    """The files that match a pattern, by their folder and the text that its ``*`` and ``?`` stand for."""
    wild = {"*": "([^/]*)", "?": "([^/])"}
    expression = "((?:.*/)?)"
    for part in re.split(r"([*?])", pattern):
        expression += wild.get(part, re.escape(part))
    regex = re.compile(expression, re.IGNORECASE)

    by_parts: dict[tuple[str, ...], Path] = {}
    for file in files:
        match = regex.fullmatch(file.relative_to(top).as_posix())
        if match:
            by_parts[tuple(map(str.casefold, match.groups()))] = file
    return by_parts


def clean_pattern(noisy: str) -> str:
    """Replace the word noisy by clean, keeping its case."""
    words = {"noisy": "clean", "Noisy": "Clean", "NOISY": "CLEAN"}
    clean, count = re.subn("|".join(words), lambda match: words[match[0]], noisy)
    if not count:
        raise ValueError(f"the pattern {noisy} does not contain the word noisy; give that of the clean files too")
    return clean


def _stem(top: Path, file: Path) -> str:
    return file.relative_to(top).with_suffix("").as_posix()
