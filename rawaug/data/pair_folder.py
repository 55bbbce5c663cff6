"""A folder of noisy/clean RAW pairs, yours or written by ``rawaug synth``: ``pairs:PATH``.

The clean frame of ``NAME_noisy.EXT`` is ``NAME_clean.EXT`` beside it; NPZ and MATLAB files of other names hold both.
Other names go by a pattern: the parts of ``noisy`` under ``*`` and ``?`` stand at the same places in ``clean``.
:mod:`rawaug.data.formats` lists the formats.
"""

from __future__ import annotations

import os
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from rawaug.bayer import CFA
from rawaug.data.development import UNKNOWN_COLOUR, develop_pair
from rawaug.data.folders import RawFolder
from rawaug.data.formats import READABLE, TWO_IN_ONE, parse_metadata, read_mosaic
from rawaug.data.pairs import DATASETS, LazyPairs, Pair
from rawaug.files import files_below

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
class PairFolder(LazyPairs):
    """The noisy/clean pairs of a folder and its subfolders, sorted by path; or those of one noisy (or two-in-one) file.

    The sRGB picture of a pair is the clean frame, developed without a tone curve. Where no file states white balance
    and colour matrix, they are 1 and the identity, and ``color_known`` is false. A folder has no splits.

    Args:
        path: where the pairs are.
        noisy: a pattern with a slash is one of paths; files of other names are left out. Without a pattern all readable
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

    def files_of(self, index: int) -> Sequence[Path]:
        _, noisy, clean = self.pairs[index]
        return tuple(dict.fromkeys((noisy, clean)))

    def stamp(self, index: int) -> str:
        given = tuple(self.given.get(key) for key in ("cfa", "black", "white"))
        return super().stamp(index) + (f" {given}" if any(given) else "")

    def read(self, index: int) -> Pair:
        name, *files = self.pairs[index]
        alone = files[0] == files[1]
        noisy = read_mosaic(files[0], "noisy", self.given, alone, self.max_pixels)
        clean = read_mosaic(files[1], "clean", self.given, alone, self.max_pixels)
        for what, one, other in (
            ("size", tuple(noisy.mosaic.shape[1:]), tuple(clean.mosaic.shape[1:])),
            ("CFA", noisy.cfa, clean.cfa),
        ):
            if one != other:
                raise ValueError(f"{files[0]}: the clean and the noisy frame differ in {what}, {other} and {one}")
        if noisy.cfa not in CFA.__members__:
            raise ValueError(
                f"{files[0]}: is a mosaic of {noisy.cfa}, and pairs are of Bayer's; check it as a RAW file"
            )
        stated = [(frame.white_balance, frame.color_matrix) for frame in (clean, noisy) if frame.color_known]
        colour = stated[0] if stated else UNKNOWN_COLOUR
        shot_var, read_var = noisy.noise_profile or (None, None)
        known: dict[str, Any] = {"noisy": noisy.mosaic, "shot_var": shot_var, "read_var": read_var}
        known |= {"color_known": bool(stated), "camera": noisy.camera, "iso": noisy.iso}
        return develop_pair(name, clean.mosaic, CFA(clean.cfa), *colour, **known)


def require_no_pairs(folder: RawFolder, spec: str, as_clean: bool) -> None:
    """Raise ValueError if a folder of RAW files holds noisy frames, by their names."""
    files = set(map(os.path.realpath, folder.files))
    for file in folder.files:
        found = re.fullmatch(r"(.*)_noisy", file.stem, re.IGNORECASE)
        partner = found and file.with_name(f"{found[1]}_clean{file.suffix}")
        if partner and os.path.realpath(partner) in files:
            raise ValueError(f"{file}: is the noisy frame of {partner.name}; read both as pairs:{spec}")
        if found and as_clean:
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
    if not path.exists():
        raise FileNotFoundError(f"{path}: no such folder of noisy/clean pairs")
    top = path if path.is_dir() else path.parent
    readable = sorted(files_below(top, READABLE))
    by_pattern = pairs_by_pattern(top, readable, noisy or NOISY, clean or clean_pattern(noisy or NOISY))
    found = list(by_pattern)
    if noisy is None:
        known = {file for pair in found for file in pair[1:]}
        others = [file for file in readable if file not in known]
        found += [PairFiles(_stem(top, file), file, file) for file in others if file.suffix.lower() in TWO_IN_ONE]
        strange = [file for file in others if file.suffix.lower() not in TWO_IN_ONE]
        if strange and path.is_dir():
            more = f" (and {len(strange) - 1} others)" if len(strange) > 1 else ""
            raise ValueError(f"{strange[0]}{more}: is neither {NOISY} nor {CLEAN}; give a pattern of the noisy files")
    if path.is_file():
        found = [pair for pair in found if path in pair[1:]]
    if not found:
        wanted = noisy or f"{NOISY}, {CLEAN}"
        raise ValueError(f"{path}: contains no noisy/clean pair named {wanted}{_unread_kinds(top)}")
    repeated = Counter(pair.name for pair in found)
    named = (p if repeated[p.name] == 1 else p._replace(name=p.noisy.relative_to(top).as_posix()) for p in found)
    return sorted(named, key=lambda pair: pair.noisy)


def _unread_kinds(top: Path) -> str:
    """Say which files are noisy or clean by their names, but of a kind that is not read."""
    extensions = set()
    for file in files_below(top):
        named = re.search("noisy|clean", file.stem, re.IGNORECASE)
        if named and file.suffix.lower() not in READABLE:
            extensions.add(file.suffix.lower())
    if not extensions:
        return ""
    return f"; {', '.join(sorted(extensions))} is not read, use .npz, .npy, .tiff, .png or .mat"


def pairs_by_pattern(top: Path, files: Sequence[Path], noisy: str, clean: str) -> list[PairFiles]:
    """Match every noisy file with its clean one."""
    if len(_WILD.findall(noisy)) != len(_WILD.findall(clean)):
        raise ValueError(f"the patterns {noisy} and {clean} must have the same number of * and ?")
    of_noisy, of_clean = (_by_wild_parts(top, files, pattern) for pattern in (noisy, clean))
    for parts in sorted(of_noisy.keys() ^ of_clean.keys()):
        if parts in of_noisy:
            raise FileNotFoundError(f"{of_noisy[parts]}: has no clean frame named {clean}; add it, or set that pattern")
        raise FileNotFoundError(f"{of_clean[parts]}: has no noisy frame named {noisy}; add it, or remove this one")
    if same := of_noisy.items() & of_clean.items():
        raise ValueError(f"{min(same)[1]}: would be its own clean frame by the pattern {clean}")
    return [
        PairFiles(re.sub(r"_noisy$", "", _stem(top, file), flags=re.IGNORECASE), file, of_clean[parts])
        for parts, file in of_noisy.items()
    ]


def _by_wild_parts(top: Path, files: Sequence[Path], pattern: str) -> dict[tuple[str, ...], Path]:
    """The files that match a pattern, by their folder and what its ``*`` and ``?`` stand for there."""
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
