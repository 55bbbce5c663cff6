"""SIDD's full frames of five phones, noisy and clean, with their pictures.

A scene instance is a folder named ``INSTANCE_SCENE_PHONE_ISO_SHUTTER_KELVIN_BRIGHTNESS``. RAW frames are MATLAB files
of version 7.3 with the mosaic ``x``, white 1, black-subtracted and, by their makers, clipped at black; METADATA are of
version 5 and hold the DNG's tags. Pictures are PNGs turned upright, the mosaics are not.

The pattern goes by phone (the dataset's ``bayer_patterns.csv``). The S6's is GRBG; it looks like GBRG to those who read
the files of version 7.3 without exchanging the axes. Source: A. Abdelhamed, S. Lin, M. S. Brown, "A high-quality
denoising dataset for smartphone cameras", CVPR 2018, and the dataset's ``noise_level_functions.csv``.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from torch import Tensor

from rawaug.bayer import CFA, turn_back
from rawaug.data.development import color_matrix, develop_mosaic, white_balance
from rawaug.data.folders import files_below
from rawaug.data.mat import normalised, read_array, read_value
from rawaug.data.pairs import FrameLabel, LazyPairs, Pair, measured_levels
from rawaug.io import read_picture
from rawaug.io.pictures import view_of_orientation

PHONES = {
    "GP": ("Google Pixel", CFA.BGGR),
    "IP": ("Apple iPhone 7", CFA.RGGB),
    "S6": ("Samsung Galaxy S6 Edge", CFA.GRBG),
    "N6": ("Motorola Nexus 6", CFA.BGGR),
    "G4": ("LG G4", CFA.BGGR),
}
"""Code in the folder's name: the phone, and the pattern of its frames."""

_NAME = re.compile(r"(\d{4})_(\d{3})_([A-Z0-9]{2})_(\d{5})_(\d{5})_(\d{4})_([LNH])")


@dataclass(frozen=True)
class SiddScene:
    """A scene instance, parsed from its folder's name: number, physical scene, phone, ISO and illuminant (kelvin)."""

    name: str
    instance: int
    scene: int
    phone: str
    iso: int
    kelvin: int

    @classmethod
    def parse(cls, name: str) -> SiddScene:
        """From the folder's name."""
        found = _NAME.fullmatch(name)
        if found is None or found[3] not in PHONES:
            raise ValueError(f"{name}: is not a SIDD scene instance such as 0052_002_S6_01600_01000_5500_N")
        return cls(name, int(found[1]), int(found[2]), found[3], int(found[4]), int(found[6]))

    @property
    def cfa(self) -> CFA:
        return PHONES[self.phone][1]

    @property
    def camera(self) -> str:
        return PHONES[self.phone][0]


def is_scene(name: str) -> bool:
    """Whether a folder's name is that of a scene instance."""
    return _NAME.fullmatch(name) is not None


HELD_BACK = (
    "0009_001_S6_00800_00350_3200_L", "0021_001_GP_10000_05000_5500_N", "0024_001_N6_03200_01500_5500_N",
    "0026_001_G4_00400_00160_5500_L", "0031_001_IP_01600_02000_3200_N", "0037_002_GP_06400_03200_3200_L",
    "0041_002_IP_01600_04000_5500_L", "0046_002_G4_00400_00350_3200_L", "0049_002_N6_00800_00800_5500_L",
    "0053_002_S6_03200_02000_5500_N", "0056_003_N6_03200_04000_5500_N", "0058_003_G4_00400_00500_5500_L",
    "0061_003_S6_00800_00500_4400_L", "0067_003_GP_01600_01500_3200_L", "0071_003_IP_02000_04000_5500_L",
    "0074_004_N6_00400_00040_3200_L", "0079_004_G4_00800_00160_3200_N", "0082_004_S6_03200_00500_4400_L",
    "0085_004_GP_06400_02000_4400_N", "0093_004_IP_01250_00250_3200_L", "0095_005_N6_00400_00200_3200_L",
    "0100_005_G4_00800_00400_3200_N", "0103_005_S6_01600_00800_4400_L", "0109_005_GP_10000_08000_4400_N",
    "0112_005_IP_01000_07500_5500_L", "0119_006_N6_00400_00100_3200_L", "0124_006_G4_00800_00350_3200_N",
    "0128_006_S6_03200_01600_4400_L", "0131_006_GP_01600_01250_4400_N", "0141_006_IP_01600_01620_3200_L",
    "0143_007_N6_00800_00800_4400_N", "0148_007_G4_00400_00400_4400_L", "0153_007_S6_03200_03200_5500_L",
    "0158_007_GP_03200_03200_5500_N", "0162_007_IP_01600_01600_3200_L", "0171_008_N6_03200_01600_4400_L",
    "0174_008_G4_00800_00800_4400_N", "0176_008_S6_00400_00100_5500_L", "0183_008_GP_06400_06400_5500_N",
    "0187_008_IP_01600_01600_3200_L",
)  # fmt: skip
"""The scene instances of the blocks of validation and benchmark, in their order; none is among those for training."""


_FILE = re.compile(r"(?:\d{4}_)?(GT_RAW|NOISY_RAW|METADATA_RAW|GT_SRGB|NOISY_SRGB)_(\d{3})\.(?:mat|png)", re.IGNORECASE)


class SiddFrames(LazyPairs):
    """The full frames below a folder: SIDD Small or Medium, RAW, and the sRGB set if present.

    Noise levels are those of a ``noise_level_functions.csv`` where there is one, else measured against the clean frame,
    which the pair says (``levels_from_clean``). Where a frame's ``GT_SRGB`` picture is not there, the clean frame is
    developed as the dataset's makers did; its ``NOISY_SRGB`` picture is read where there is one.

    Args:
        path: contains the folders of the scene instances, at any depth.
        left_out: scene instances that are not taken, by default those of validation and benchmark.
    """

    def __init__(self, path: str | Path, left_out: Sequence[str] = HELD_BACK) -> None:
        self.path = Path(path)
        self.shots = [
            (SiddScene.parse(scene), number, files)
            for (scene, number), files in sorted(indexed(self.path).items())
            if "NOISY_RAW" in files and scene not in left_out
        ]
        for scene, number, files in self.shots:
            missing = {"GT_RAW", "METADATA_RAW"} - set(files)
            if missing:
                raise ValueError(
                    f"{files['NOISY_RAW']}: {min(missing)}_{number} of {scene.name} is missing; download it too"
                )
        if not self.shots:
            raise ValueError(f"{path}: contains no NOISY_RAW training frames of SIDD")
        self.levels = noise_level_functions(self.path)
        super().__init__([f"{scene.name}_{number}" for scene, number, _ in self.shots])

    @property
    def labels(self) -> list[FrameLabel]:
        """Scene, phone and ISO of every frame."""
        return [FrameLabel(f"{scene.scene:03d}", scene.phone, scene.iso) for scene, *_ in self.shots]

    def read(self, index: int) -> Pair:
        scene, _, files = self.shots[index]
        clean, noisy = (mosaic_of(files[kind]) for kind in ("GT_RAW", "NOISY_RAW"))
        if clean.shape != noisy.shape:
            sizes = f"{tuple(clean.shape[1:])} and {tuple(noisy.shape[1:])}"
            raise ValueError(f"{files['NOISY_RAW']}: the clean and the noisy frame differ in size, {sizes}")
        gains, matrix, view = colour_of(files["METADATA_RAW"])
        pictures = {
            kind: _turned_back(files[kind], view, self.max_pixels)
            for kind in ("GT_SRGB", "NOISY_SRGB")
            if kind in files
        }
        known = self.levels.get(scene.name)
        shot_var, read_var = known or measured_levels(clean, noisy)
        return Pair(
            name=self.names[index],
            srgb=pictures["GT_SRGB"] if "GT_SRGB" in pictures else develop_mosaic(clean, scene.cfa, gains, matrix),
            raw=clean,
            cfa=scene.cfa,
            white_balance=gains,
            color_matrix=matrix,
            noisy=noisy,
            shot_var=shot_var,
            read_var=read_var,
            camera=scene.camera,
            noisy_srgb=pictures.get("NOISY_SRGB"),
            levels_from_clean=known is None,
        )


def mosaic_of(file: Path) -> Tensor:
    """The mosaic ``x`` of a frame, float32 ``(1, H, W)``; of an odd side the last line is left out."""
    return _even(normalised(read_array(file, "x"), 2, file))


def noise_level_functions(path: Path) -> dict[str, tuple[float, float]]:
    """(shot_var, read_var) by scene instance, the mean over a mosaic's sites, from the CSV below ``path``, if any."""
    file = min(files_below(path, ("noise_level_functions.csv",)), default=None)
    if file is None:
        return {}
    with file.open(encoding="utf-8-sig", newline="") as stream:
        rows = list(csv.DictReader(stream, skipinitialspace=True))
    levels = {}
    for row in rows:
        try:
            shot, read = (sum(float(row[f"beta{k}_{colour}"]) for colour in "rggb") / 4 for k in (1, 2))
            levels[row["scene_instance_id"]] = max(shot, 0.0), max(read, 0.0)
        except (KeyError, TypeError, ValueError) as error:
            columns = "scene_instance_id, beta1_r, beta2_r, beta1_g, beta2_g, beta1_b, beta2_b"
            raise ValueError(f"{file}: each row has the columns {columns}; {error!r} is wrong") from error
    return levels


def indexed(path: Path) -> dict[tuple[str, str], dict[str, Path]]:
    """Files below ``path`` by (scene instance, number), and by kind: GT_RAW, NOISY_RAW, METADATA_RAW, GT_SRGB,
    NOISY_SRGB."""
    if not path.is_dir():
        raise FileNotFoundError(f"{path}: no such folder of SIDD")
    index: dict[tuple[str, str], dict[str, Path]] = {}
    for file in files_below(path):
        scene = file.parent.name
        if is_scene(scene) and (found := _FILE.fullmatch(file.name)):
            index.setdefault((scene, found[2]), {})[found[1].upper()] = file
    return index


class Colour(NamedTuple):
    """Gains, colour matrix and upright view from a METADATA file."""

    white_balance: tuple[float, float, float]
    matrix: Tensor
    upright_view: int


def colour_of(file: Path) -> Colour:
    """The colour of a frame from its METADATA file."""
    tags: dict[str, Any] = read_value(file, "metadata")
    try:
        gains, matrix = white_balance(tags["AsShotNeutral"]), color_matrix(tags["ColorMatrix2"])
        return Colour(gains, matrix, view_of_orientation(int(tags.get("Orientation", 1))))
    except (LookupError, TypeError, ValueError, AttributeError, OverflowError) as error:
        raise ValueError(f"{file}: has no valid AsShotNeutral and ColorMatrix2 ({error}); download it again") from error


def _turned_back(file: Path, view: int, max_pixels: int) -> Tensor:
    """The upright picture in ``file`` as the sensor saw it."""
    return _even(turn_back(read_picture(file, max_pixels), view)).contiguous()


def _even(image: Tensor) -> Tensor:
    height, width = (side // 2 * 2 for side in image.shape[-2:])
    return image[..., :height, :width]
