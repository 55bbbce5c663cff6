"""SIDD's scene instances: their phones, patterns and files, and the contents of METADATA and published noise levels.

docs/datasets.md shows the files. METADATA files hold the tags of the DNG. The phone determines the pattern (the
dataset's ``bayer_patterns.csv``); :data:`HELD_BACK` lists the scene instance of each block, which names its phone.
Source: A. Abdelhamed, S. Lin, M. S. Brown, "A high-quality denoising dataset for smartphone cameras", CVPR 2018, and
the dataset's ``noise_level_functions.csv``.
"""

from __future__ import annotations

import csv
import re
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

from torch import Tensor

from rawaug.bayer import CFA
from rawaug.data.development import gains_from_neutral, srgb_from_camera
from rawaug.data.frames import FrameLabel
from rawaug.data.mat import read_array, read_value, to_raw
from rawaug.files import files_below, require_file
from rawaug.io.pictures import view_of_orientation

PHONES = {
    "GP": ("Google Pixel", CFA.BGGR),
    "IP": ("Apple iPhone 7", CFA.RGGB),
    "S6": ("Samsung Galaxy S6 Edge", CFA.GRBG),
    "N6": ("Motorola Nexus 6", CFA.BGGR),
    "G4": ("LG G4", CFA.BGGR),
}
"""Name of each phone and the pattern of its frames, by the code in the names of folders."""

_NAME = re.compile(r"\d{4}_(\d{3})_([A-Z0-9]{2})_(\d{5})_\d{5}_\d{4}_[LNH]")


def parse_label(name: str) -> FrameLabel:
    """Parse scene, phone and ISO from the name of a scene instance, which is the name of its folder."""
    match = _NAME.fullmatch(name)
    if match is None or match[2] not in PHONES:
        raise ValueError(f"{name}: is not a SIDD scene instance such as 0052_002_S6_01600_01000_5500_N")

    scene, phone, iso = match.groups()
    return FrameLabel(scene, phone, int(iso))


def find_phone(name: str) -> tuple[str, CFA]:
    """The phone of a scene instance, and the pattern of its frames."""
    return PHONES[parse_label(name).phone]


def is_scene(name: str) -> bool:
    """Whether a name is that of a scene instance."""
    return _NAME.fullmatch(name) is not None


HELD_BACK = tuple(Path(__file__).with_name("sidd.txt").read_text(encoding="ascii").split())
"""The scene instances of the validation and benchmark blocks, in their order; training frames have others."""

_FILE = re.compile(r"(?:\d{4}_)?(GT_RAW|NOISY_RAW|METADATA_RAW|GT_SRGB|NOISY_SRGB)_(\d{3})\.(?:mat|png)", re.IGNORECASE)


def read_sidd_mosaic(file: Path) -> Tensor:
    """Read the mosaic ``x`` of a frame, float32 ``(1, H, W)``; an odd side loses its last line."""
    return even(to_raw(read_array(file, "x"), 2, file))


def noise_level_functions(path: Path) -> dict[str, tuple[float, float]]:
    """Read (shot_var, read_var) by scene instance, the mean over a mosaic's sites; empty if ``path`` has no CSV."""
    file = min(files_below(path, ("noise_level_functions.csv",)), default=None)
    if file is None:
        return {}

    require_file(file)
    with file.open(encoding="utf-8-sig", newline="") as stream:
        rows = list(csv.DictReader(stream, skipinitialspace=True))

    levels = {}
    for row in rows:
        try:
            shot_var = _mean_over_sites(row, "beta1")
            read_var = _mean_over_sites(row, "beta2")
            levels[row["scene_instance_id"]] = (max(shot_var, 0.0), max(read_var, 0.0))
        except (KeyError, TypeError, ValueError) as error:
            columns = "scene_instance_id, beta1_r, beta2_r, beta1_g, beta2_g, beta1_b, beta2_b"
            raise ValueError(f"{file}: each row has the columns {columns}; {error!r} is wrong") from error
    return levels


def _mean_over_sites(row: dict[str, str], parameter: str) -> float:
    """Average a noise parameter over the sites R, G, G, B."""
    return sum(float(row[f"{parameter}_{colour}"]) for colour in "rggb") / 4


def index_files(path: Path) -> dict[tuple[str, str], dict[str, Path]]:
    """Index the files below ``path`` by (scene instance, number) and kind.

    The kinds are GT_RAW, NOISY_RAW, METADATA_RAW, GT_SRGB and NOISY_SRGB.
    """
    if not path.is_dir():
        raise FileNotFoundError(f"{path}: no such folder of SIDD")

    index: dict[tuple[str, str], dict[str, Path]] = {}
    for file in files_below(path):
        scene = file.parent.name
        match = _FILE.fullmatch(file.name)
        if match is not None and is_scene(scene):
            kind, number = match[1].upper(), match[2]
            index.setdefault((scene, number), {})[kind] = file
    return index


def read_sidd_colour(file: Path) -> tuple[tuple[float, float, float], Tensor, int]:
    """Read white balance, colour matrix ``(3, 3)`` and upright view of a METADATA file."""
    tags: dict[str, Any] = read_value(file, "metadata")
    try:
        gains = gains_from_neutral(tags["AsShotNeutral"])
        matrix = srgb_from_camera(tags["ColorMatrix2"])
        view = view_of_orientation(int(tags.get("Orientation", 1)))
        return gains, matrix, view
    except (LookupError, TypeError, ValueError, AttributeError, OverflowError) as error:
        raise ValueError(f"{file}: has no valid AsShotNeutral and ColorMatrix2 ({error}); download it again") from error


def even(image: Tensor) -> Tensor:
    """Drop the last line of an odd side of an image."""
    height = image.shape[-2] // 2 * 2
    width = image.shape[-1] // 2 * 2
    return image[..., :height, :width]


def find_file(path: Path, pattern: str) -> Path:
    """Find the one file of this name below ``path``, or return ``path`` itself."""
    if path.is_file() and path.match(pattern):
        return path

    matches = matching_files(path, pattern)
    if not matches:
        raise FileNotFoundError(f"{path}: contains no {pattern}; docs/datasets.md says where to get it")
    if len(matches) > 1:
        example = f"such as {matches[0]}"
        raise ValueError(f"{path}: contains {len(matches)} files {pattern}, {example}; give a folder with one")
    return matches[0]


def matching_files(folder: Path, pattern: str) -> list[Path]:
    """List the files below a folder whose names match a pattern, sorted."""
    return sorted(file for file in files_below(folder) if fnmatchcase(file.name, pattern))
