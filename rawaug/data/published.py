"""Published sets of RAW files or crops: MIT-Adobe FiveK, RAWIR, RGB2RAW, Zurich, RawBench, and the package's own.

docs/datasets.md describes them, with their sources and licences. What is assumed besides:

- *FiveK*: ``fivek.json`` beside this file lists the numbers of the splits, those of InvISP.
- *RAWIR*, AIM 2022 and *RGB2RAW*: planes are R, G of the red row, G of the blue row, B, taken to be black-subtracted.
  White is 2^10 where the picture is a JPEG (AIM 2022), 2^12 - 1 where it is a PNG, ``max_val`` of an ``.npz``. White
  balance and colour matrix come as pickles, which are not opened: gains are 1 and the matrix is the identity.
- *Zurich*: its loader divides by 1020 and leaves black in; the black level is that of Z. Zhang et al., "Learning
  RAW-to-sRGB mappings with inaccurately aligned supervision", ICCV 2021.
- ``real:``: ``real_frames/LICENCE.md`` names source and licence (CC0).
"""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from rawaug.bayer import CFA, unpack
from rawaug.data.development import develop_mosaic, develop_pair
from rawaug.data.folders import RawFolder
from rawaug.data.formats import read_npz
from rawaug.data.pairs import DATASETS, LazyPairs, Pair, require_split
from rawaug.files import files_below, files_in, require_file
from rawaug.io import read_picture, read_raw
from rawaug.io.isolated import damage_as_os_error
from rawaug.io.pictures import read_plane
from rawaug.io.raw import RAW_EXTENSIONS

_SPLITS: dict[str, Any] = json.loads(Path(__file__).with_name("fivek.json").read_text(encoding="utf-8"))
CAMERAS = ("canon", "nikon")
FIVEK_DNG = re.compile(r"a(\d{4})-.*\.dng", re.IGNORECASE)


@DATASETS.register("fivek")
def fivek_pairs(
    path: str | Path,
    split: str,
    cameras: Sequence[str] = CAMERAS,
    adjust_maximum_thr: float = 0.0,
    jpeg_quality: int | None = None,
) -> RawFolder:
    """The pairs of a split below a folder, Canon before Nikon, each sorted by number.

    ``adjust_maximum_thr`` and ``jpeg_quality`` are those of :class:`rawaug.data.RawFolder`.
    """
    wanted = [number for camera in cameras for number in fivek_numbers(camera, split)]
    files = {found[1]: file for file in files_in(path, "FiveK", (".dng",)) if (found := FIVEK_DNG.fullmatch(file.name))}
    missing = [number for number in wanted if number not in files]
    if missing:
        raise FileNotFoundError(
            f"{path}: {len(missing)} of the {len(wanted)} DNGs of fivek {'+'.join(cameras)}, {split}, are missing, "
            f"first a{missing[0]}-*.dng"
        )
    chosen = [files[number] for number in wanted]
    return RawFolder(chosen, camera_jpeg=False, adjust_maximum_thr=adjust_maximum_thr, jpeg_quality=jpeg_quality)


for _camera in CAMERAS:
    _of_camera = partial(fivek_pairs, cameras=[_camera])
    DATASETS.register(f"fivek_{_camera}")(_of_camera)
    # InvISP's pictures as its published script makes them
    DATASETS.register(f"invisp_{_camera}")(partial(_of_camera, adjust_maximum_thr=0.75, jpeg_quality=90))


def fivek_numbers(camera: str, split: str) -> list[str]:
    if camera not in CAMERAS:
        raise ValueError(f"fivek: no camera {camera}; use one of {', '.join(CAMERAS)}")
    require_split("fivek", split, _SPLITS[camera])
    numbers: list[str] = _SPLITS[camera][split].split()
    return numbers


WHITE = {".jpg": 2**10, ".png": 2**12 - 1}
"""White level by the picture's extension."""

RAWIR_FOLDERS = {"train": "train", "validation": "val", "test": "test"}


@DATASETS.register("rawir")
class Rawir(LazyPairs):
    """The pairs below a folder, in RGGB; of subfolders ``train``, ``val`` or ``test`` only the one of the split.

    ``white`` is in digital numbers, by default as :data:`WHITE` says.
    """

    def __init__(self, path: str | Path, split: str = "train", white: float | None = None) -> None:
        require_split("rawir", split, RAWIR_FOLDERS)
        folder, self.white = Path(path), white
        if any((folder / name).is_dir() for name in RAWIR_FOLDERS.values()):
            folder = folder / RAWIR_FOLDERS[split]
        self.files = self.of_split(files_in(folder, "RAWIR", (".npy", ".npz")), split)
        if not self.files:
            raise ValueError(f"{path}: has no pair for {split}; it needs files of {TENTH} RAWs")
        self.pictures = [picture_beside(file) for file in self.files]
        super().__init__([str(file.relative_to(folder).with_suffix("")) for file in self.files])

    def of_split(self, files: list[Path], split: str) -> list[Path]:
        """Choose the files of a split: here all, since every split is a folder."""
        return files

    def camera_of(self, file: Path) -> str:
        return "unknown"

    def read(self, index: int) -> Pair:
        file, picture = self.files[index], self.pictures[index]
        return Pair(
            name=self.names[index],
            srgb=read_picture(picture, self.max_pixels),
            raw=unpack(read_packed(file, picture, self.white), CFA.RGGB),
            cfa=CFA.RGGB,
            camera=self.camera_of(file),
            registered=not any("p20" in part.lower() for part in file.parts),
        )


def read_packed(file: Path, picture: Path, white: float | None) -> Tensor:
    """Packed RAW ``(4, h, w)`` of a file, white at 1; an ``.npz`` or the picture beside it says which white level."""
    with damage_as_os_error(file, "cannot be read as packed RAW"):
        if file.suffix == ".npz":
            arrays = read_npz(file, lambda names: ["raw", "max_val"])
            numbers, stated = arrays["raw"], float(arrays["max_val"])
        else:
            require_file(file)
            # mapped: one that claims more than the file holds takes no memory
            numbers, stated = np.lib.format.open_memmap(file, mode="r"), None
    if numbers.ndim != 3 or numbers.shape[2] != 4 or numbers.dtype.kind != "u" or not numbers.size:
        raise ValueError(f"{file}: packed RAW must be unsigned (h, w, 4), got {numbers.dtype} {numbers.shape}")
    white = white or stated or WHITE[picture.suffix.lower()]
    if numbers.max() > white:
        raise ValueError(f"{file}: has value {numbers.max()}, above the white level {white:g}; pass white=")
    return torch.from_numpy(numbers.astype(np.float32)).permute(2, 0, 1) / white


def picture_beside(file: Path) -> Path:
    for suffix in WHITE:
        if file.with_suffix(suffix).is_file():
            return file.with_suffix(suffix)
    raise FileNotFoundError(f"{file}: has no {' or '.join(WHITE)} of the same stem beside it; download it too")


TENTH = 10
_TURN = {"test": (0,), "validation": (1,), "train": tuple(range(2, TENTH))}


@DATASETS.register("rgb2raw")
class Rgb2Raw(Rawir):
    """The pairs of a split below a folder; a pair's camera is the name of its folder."""

    def of_split(self, files: list[Path], split: str) -> list[Path]:
        """Choose the files of a split by the place of their RAW among those of the folder."""
        places: dict[Path, dict[str, int]] = {}
        for file in files:
            shots = places.setdefault(file.parent, {})
            shots.setdefault(_raw_id(file), len(shots))
        return [file for file in files if places[file.parent][_raw_id(file)] % TENTH in _TURN[split]]

    def camera_of(self, file: Path) -> str:
        return file.parent.name


def _raw_id(file: Path) -> str:
    """``12_3`` is crop 3 of RAW 12."""
    return file.stem.rpartition("_")[0] or file.stem


BLACK, ZURICH_WHITE = 63, 1020
_BITS = 10


@DATASETS.register("zurich")
class Zurich(LazyPairs):
    """The pairs of a split, sorted by number; PNGs of 8 bits hold a quarter of the digital numbers."""

    def __init__(self, path: str | Path, split: str = "train") -> None:
        require_split("zurich", split, ("train", "test"))
        self.folder = Path(path) / split
        files = files_in(self.folder / "huawei_raw", "Zurich RAW to RGB", (".png",))
        self.files = sorted(files, key=lambda file: (len(file.stem), file.stem))  # 2 comes before 10
        existing = {file.stem for file in (self.folder / "canon").glob("*.jpg")}
        if missing := [file.stem for file in self.files if file.stem not in existing]:
            first = self.folder / "canon" / f"{missing[0]}.jpg"
            raise FileNotFoundError(f"{first}: is missing, and {len(missing) - 1} others")
        super().__init__([f"{split}_{file.stem}" for file in self.files])

    def read(self, index: int) -> Pair:
        file = self.files[index]
        numbers = read_plane(file, self.max_pixels)
        scale = 1.0 if numbers.dtype == np.uint16 else 0.25
        if numbers.max() >= scale * 2**_BITS:
            raise ValueError(f"{file}: has value {numbers.max()}, more than {_BITS} bits; give a file of this dataset")
        light = (numbers.astype(np.float32) - scale * BLACK) / (scale * (ZURICH_WHITE - BLACK))
        return Pair(
            name=self.names[index],
            srgb=read_picture(self.folder / "canon" / f"{file.stem}.jpg", self.max_pixels),
            raw=torch.from_numpy(np.minimum(light, 1))[None],
            cfa=CFA.RGGB,
            camera="Huawei P20 (picture: Canon 5D Mark IV)",
            registered=False,
        )


_NOISY_SHOT = re.compile(r"(Scene_\d+)_ISO\d+(?:_\d+)?", re.IGNORECASE)
_UNCLIPPED = 0.9


@DATASETS.register("rawbench")
class RawBench(LazyPairs):
    """Shots of a Sony A7C II, ``Scene_0001/Scene_0001_ISO3200_1.ARW``, and their mean at ISO 100 in ``gt`` beside them.

    Settings were held but for the ISO, so the clean frame is brought to the noisy one's exposure: it is multiplied by
    the ratio of their means, where neither is clipped, and has noise of its own that this ratio amplifies. The picture
    is a plain development of it. There are no splits.
    """

    def __init__(self, path: str | Path, split: str = "test") -> None:
        files = files_in(path, "RawBench", RAW_EXTENSIONS)
        self.files = [file for file in files if file.parent.name != "gt" and _NOISY_SHOT.fullmatch(file.stem)]
        if not self.files:
            raise ValueError(f"{path}: contains no RAW file named as Scene_0001_ISO3200_1.ARW")
        self.clean = {file.parent: sorted(files_below(file.parent / "gt", RAW_EXTENSIONS)) for file in self.files}
        missing = next((folder for folder, clean in self.clean.items() if not clean), None)
        if missing is not None:
            raise FileNotFoundError(f"{missing / 'gt'}: has no RAW file at ISO 100; download it too")
        super().__init__([file.stem for file in self.files])

    def files_of(self, index: int) -> Sequence[Path]:
        return (self.files[index], *self.clean[self.files[index].parent])

    def read(self, index: int) -> Pair:
        noisy, *clean = (read_raw(file) for file in self.files_of(index))
        if any(frame.mosaic.shape != noisy.mosaic.shape or frame.cfa != noisy.cfa for frame in clean):
            raise ValueError(f"{self.files[index]}: differs in size or pattern from its gt")
        dark = torch.stack([frame.mosaic for frame in clean]).mean(0)
        whole = (noisy.mosaic < _UNCLIPPED) & (dark < _UNCLIPPED)
        ratio = noisy.mosaic[whole].mean() / dark[whole].mean().clamp_min(1e-6)
        raw = (dark * ratio).clamp(max=1.0)
        srgb = develop_mosaic(raw, CFA(noisy.cfa), noisy.white_balance, noisy.color_matrix)
        clean_frame = replace(noisy, mosaic=raw)
        known = {"noisy": noisy.mosaic, "color_known": noisy.color_known}
        return Pair.of_frame(self.names[index], clean_frame, srgb, **known)


REAL_FRAMES = Path(__file__).with_name("real_frames")
REAL_BLACK, REAL_WHITE = 512, 16383
"""Black and white level of the PNGs, with room for noise below black."""


@DATASETS.register("real")
class RealFrames(LazyPairs):
    """The frames of a split, ``real:train``; ``own_noise`` of each pair is what is left of its reference's noise."""

    def __init__(self, path: str = "", split: str = "test") -> None:
        split = path or split
        require_split("real", split, ("train", "validation", "test"))
        super().__init__([name for name, frame in _real_frames().items() if frame["split"] == split])

    def read(self, index: int) -> Pair:
        name = self.names[index]
        known = _real_frames()[name]
        cfa, gains, matrix = CFA(known["cfa"]), tuple(known["white_balance"]), torch.tensor(known["color_matrix"])
        numbers = read_plane(REAL_FRAMES / f"{name}.png").astype(np.float32)
        planes = torch.from_numpy((numbers - REAL_BLACK) / (REAL_WHITE - REAL_BLACK)).reshape(4, -1, numbers.shape[-1])
        shot = {"camera": known["camera"], "iso": known["iso"], "own_noise": tuple(known["own_noise"])}
        return develop_pair(name, unpack(planes, cfa), cfa, gains, matrix, **shot)


@cache
def _real_frames() -> dict[str, dict[str, Any]]:
    frames: dict[str, dict[str, Any]] = json.loads((REAL_FRAMES / "frames.json").read_text(encoding="utf-8"))
    return frames
