"""Published sets of RAW files or crops: MIT-Adobe FiveK, RAWIR, RGB2RAW, Zurich, RawBench, and the package's own.

docs/datasets.md describes them, with their sources and licences. The readers make these assumptions:

- *FiveK*: ``fivek.json`` beside this file lists the numbers of InvISP's splits.
- *RAWIR*, AIM 2022 and *RGB2RAW*: planes are R, G of the red row, G of the blue row and B, black-subtracted. White is
  2^10 if the picture is a JPEG (AIM 2022), 2^12 - 1 if it is a PNG, and ``max_val`` in an ``.npz``. White balance and
  colour matrix are pickles, which are never opened, so gains are 1 and the matrix is the identity.
- *Zurich*: the dataset's loader divides by 1020 without subtracting black. The black level is that of Z. Zhang et al.,
  "Learning RAW-to-sRGB mappings with inaccurately aligned supervision", ICCV 2021.
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
from rawaug.data.development import develop_pair
from rawaug.data.folders import RawFolder
from rawaug.data.formats import read_npz
from rawaug.data.frames import Frames
from rawaug.data.pairs import DATASETS, Pair, require_split
from rawaug.files import files_below, files_in, require_file
from rawaug.io import RawFrame, read_picture, read_raw
from rawaug.io.isolated import damage_as_os_error
from rawaug.io.pictures import read_plane
from rawaug.io.raw import RAW_EXTENSIONS

_SPLITS: dict[str, Any] = json.loads(Path(__file__).with_name("fivek.json").read_text(encoding="utf-8"))
CAMERAS = ("canon", "nikon")
_FIVEK_DNG = re.compile(r"a(\d{4})-.*\.dng", re.IGNORECASE)


@DATASETS.register("fivek")
def fivek_pairs(
    path: str | Path,
    split: str,
    cameras: Sequence[str] = CAMERAS,
    adjust_maximum_thr: float = 0.0,
    jpeg_quality: int | None = None,
) -> RawFolder:
    """Open the pairs of a split below a folder, Canon before Nikon, each sorted by number.

    :class:`rawaug.data.RawFolder` explains ``adjust_maximum_thr`` and ``jpeg_quality``.
    """
    numbers = []
    for camera in cameras:
        numbers += fivek_numbers(camera, split)

    file_of: dict[str, Path] = {}
    for file in files_in(path, "FiveK", (".dng",)):
        match = _FIVEK_DNG.fullmatch(file.name)
        if match is not None:
            file_of[match[1]] = file

    missing = [number for number in numbers if number not in file_of]
    if missing:
        raise FileNotFoundError(
            f"{path}: {len(missing)} of the {len(numbers)} DNGs of fivek {'+'.join(cameras)}, {split}, are missing, "
            f"first a{missing[0]}-*.dng"
        )
    files = [file_of[number] for number in numbers]
    return RawFolder(files, camera_jpeg=False, adjust_maximum_thr=adjust_maximum_thr, jpeg_quality=jpeg_quality)


for _camera in CAMERAS:
    _of_camera = partial(fivek_pairs, cameras=[_camera])
    DATASETS.register(f"fivek_{_camera}")(_of_camera)
    # the settings of InvISP's published script
    DATASETS.register(f"invisp_{_camera}")(partial(_of_camera, adjust_maximum_thr=0.75, jpeg_quality=90))


def fivek_numbers(camera: str, split: str) -> list[str]:
    """The numbers of a split's DNGs, such as ``"0001"``."""
    if camera not in CAMERAS:
        raise ValueError(f"fivek: no camera {camera}; use one of {', '.join(CAMERAS)}")
    require_split("fivek", split, _SPLITS[camera])
    numbers: list[str] = _SPLITS[camera][split].split()
    return numbers


WHITE = {".jpg": 2**10, ".png": 2**12 - 1}
"""White level by the extension of the picture."""

RAWIR_FOLDERS = {"train": "train", "validation": "val", "test": "test"}


@DATASETS.register("rawir")
class Rawir(Frames[Pair]):
    """The pairs below a folder, in RGGB.

    A folder with subfolders ``train``, ``val`` or ``test`` has the pairs of a split in its subfolder. ``white`` is in
    digital numbers; :data:`WHITE` has the defaults.
    """

    def __init__(self, path: str | Path, split: str = "train", white: float | None = None) -> None:
        require_split("rawir", split, RAWIR_FOLDERS)
        self.white = white

        folder = Path(path)
        has_splits = any((folder / name).is_dir() for name in RAWIR_FOLDERS.values())
        if has_splits:
            folder = folder / RAWIR_FOLDERS[split]

        self.files = self.of_split(files_in(folder, "RAWIR", (".npy", ".npz")), split)
        if not self.files:
            raise ValueError(f"{path}: has no pair for {split}; it needs files of {_TENTH} RAWs")
        self.pictures = [_picture_beside(file) for file in self.files]
        super().__init__([str(file.relative_to(folder).with_suffix("")) for file in self.files])

    def of_split(self, files: list[Path], split: str) -> list[Path]:
        """Choose the files of a split; here all of them, since every split has a folder."""
        return files

    def camera_name(self, file: Path) -> str:
        return "unknown"

    def read(self, index: int) -> Pair:
        file = self.files[index]
        picture = self.pictures[index]
        is_phone = any("p20" in part.lower() for part in file.parts)  # its JPEGs are not registered
        srgb = read_picture(picture, self.max_pixels)
        raw = unpack(read_packed(file, picture, self.white), CFA.RGGB)
        clean = RawFrame(raw, CFA.RGGB, camera=self.camera_name(file))
        return Pair(self.names[index], clean, srgb, registered=not is_phone)


def read_packed(file: Path, picture: Path, white: float | None) -> Tensor:
    """Read the packed RAW ``(4, h, w)`` of a file, white at 1.

    The white level is ``white``, or that of an ``.npz``, or that of the extension of the picture beside the file.
    """
    with damage_as_os_error(file, "cannot be read as packed RAW"):
        if file.suffix == ".npz":
            arrays = read_npz(file, lambda names: ["raw", "max_val"])
            numbers = arrays["raw"]
            white = white or float(arrays["max_val"])
        else:
            require_file(file)
            # memory-mapped, so that a file with a wrong header takes no memory
            numbers = np.lib.format.open_memmap(file, mode="r")

    if numbers.ndim != 3 or numbers.shape[2] != 4 or numbers.dtype.kind != "u" or not numbers.size:
        raise ValueError(f"{file}: packed RAW must be unsigned (h, w, 4), got {numbers.dtype} {numbers.shape}")
    white = white or WHITE[picture.suffix.lower()]
    if numbers.max() > white:
        raise ValueError(f"{file}: has value {numbers.max()}, above the white level {white:g}; pass white=")
    return torch.from_numpy(numbers.astype(np.float32)).permute(2, 0, 1) / white


def _picture_beside(file: Path) -> Path:
    """Find the picture with the stem of a file, in its folder; FileNotFoundError if there is none."""
    for suffix in WHITE:
        if file.with_suffix(suffix).is_file():
            return file.with_suffix(suffix)
    raise FileNotFoundError(f"{file}: has no {' or '.join(WHITE)} of the same stem beside it; download it too")


_TENTH = 10
_TURN = {"test": (0,), "validation": (1,), "train": tuple(range(2, _TENTH))}
"""The places of each split's RAWs in every ten RAWs of a folder."""


@DATASETS.register("rgb2raw")
class Rgb2Raw(Rawir):
    """The pairs of a split below a folder; a pair's camera is the name of its folder."""

    def of_split(self, files: list[Path], split: str) -> list[Path]:
        """Choose the files of a split by the place of their RAW among those of the folder."""
        files_of_split = []
        places_in: dict[Path, dict[str, int]] = {}
        for file in files:
            places = places_in.setdefault(file.parent, {})
            scene = places.setdefault(_raw_id(file), len(places))
            if scene % _TENTH in _TURN[split]:
                files_of_split.append(file)
        return files_of_split

    def camera_name(self, file: Path) -> str:
        return file.parent.name


def _raw_id(file: Path) -> str:
    """The number of the RAW that a crop belongs to: ``12_3`` is crop 3 of RAW 12."""
    return file.stem.rpartition("_")[0] or file.stem


_BLACK, _ZURICH_WHITE = 63, 1020
_BITS = 10


@DATASETS.register("zurich")
class Zurich(Frames[Pair]):
    """The pairs of a split, sorted by number; PNGs of 8 bits hold a quarter of the digital numbers."""

    def __init__(self, path: str | Path, split: str = "train") -> None:
        require_split("zurich", split, ("train", "test"))
        self.folder = Path(path) / split
        files = files_in(self.folder / "huawei_raw", "Zurich RAW to RGB", (".png",))
        self.files = sorted(files, key=lambda file: (len(file.stem), file.stem))  # 2 comes before 10

        pictures = set((self.folder / "canon").glob("*.jpg"))
        missing = []
        for file in self.files:
            picture = self._picture(file)
            if picture not in pictures:
                missing.append(picture)
        if missing:
            raise FileNotFoundError(f"{missing[0]}: is missing, and {len(missing) - 1} others")

        super().__init__([f"{split}_{file.stem}" for file in self.files])

    def _picture(self, file: Path) -> Path:
        return self.folder / "canon" / f"{file.stem}.jpg"

    def read(self, index: int) -> Pair:
        file = self.files[index]
        numbers = read_plane(file, self.max_pixels)
        scale = 1.0 if numbers.dtype == np.uint16 else 0.25
        if numbers.max() >= scale * 2**_BITS:
            raise ValueError(f"{file}: has value {numbers.max()}, more than {_BITS} bits; give a file of this dataset")

        light = (numbers.astype(np.float32) - scale * _BLACK) / (scale * (_ZURICH_WHITE - _BLACK))
        srgb = read_picture(self._picture(file), self.max_pixels)
        raw = torch.from_numpy(np.minimum(light, 1))[None]
        clean = RawFrame(raw, CFA.RGGB, camera="Huawei P20 (picture: Canon 5D Mark IV)")
        return Pair(self.names[index], clean, srgb, registered=False)


_NOISY_SHOT = re.compile(r"(Scene_\d+)_ISO\d+(?:_\d+)?", re.IGNORECASE)
_UNCLIPPED = 0.9
"""Maximum of the values at which the exposures are compared."""


@DATASETS.register("rawbench")
class RawBench(Frames[Pair]):
    """Shots of a Sony A7C II, ``Scene_0001/Scene_0001_ISO3200_1.ARW``, and their mean at ISO 100 in ``gt`` beside them.

    The shots of a scene differ only in ISO. The clean frame is scaled to the exposure of the noisy frame, by the ratio
    of their means where neither is clipped, which also amplifies its own noise. The picture is a plain development of
    it. There are no splits.
    """

    def __init__(self, path: str | Path, split: str = "test") -> None:
        self.files = []
        for file in files_in(path, "RawBench", RAW_EXTENSIONS):
            if file.parent.name != "gt" and _NOISY_SHOT.fullmatch(file.stem):
                self.files.append(file)
        if not self.files:
            raise ValueError(f"{path}: contains no RAW file named as Scene_0001_ISO3200_1.ARW")

        self.clean: dict[Path, list[Path]] = {}
        for file in self.files:
            folder = file.parent / "gt"
            if file.parent not in self.clean:
                self.clean[file.parent] = sorted(files_below(folder, RAW_EXTENSIONS))
            if not self.clean[file.parent]:
                raise FileNotFoundError(f"{folder}: has no RAW file at ISO 100; download it too")
        super().__init__([file.stem for file in self.files])

    def frame_files(self, index: int) -> Sequence[Path]:
        file = self.files[index]
        return (file, *self.clean[file.parent])

    def read(self, index: int) -> Pair:
        noisy_file, *clean_files = self.frame_files(index)
        noisy = read_raw(noisy_file)
        mosaics = []
        for file in clean_files:
            frame = read_raw(file)
            if frame.mosaic.shape != noisy.mosaic.shape or frame.cfa != noisy.cfa:
                raise ValueError(f"{noisy_file}: differs in size or pattern from its gt")
            mosaics.append(frame.mosaic)
        mean = torch.stack(mosaics).mean(0)

        unclipped = (noisy.mosaic < _UNCLIPPED) & (mean < _UNCLIPPED)
        exposure = noisy.mosaic[unclipped].mean() / mean[unclipped].mean().clamp_min(1e-6)
        raw = (mean * exposure).clamp(max=1.0)

        noisy = replace(noisy, noise_profile=None)
        return develop_pair(self.names[index], replace(noisy, mosaic=raw), noisy)


REAL_FRAMES = Path(__file__).with_name("real_frames")
REAL_BLACK, REAL_WHITE = 512, 16383
"""Black and white level of the PNGs, with room for noise below black."""


@DATASETS.register("real")
class RealFrames(Frames[Pair]):
    """The frames of a split, such as ``real:train``; ``noise_profile`` of a clean frame is its own noise."""

    def __init__(self, path: str = "", split: str = "test") -> None:
        split = path or split
        require_split("real", split, ("train", "validation", "test"))
        super().__init__([name for name, frame in _real_frames().items() if frame["split"] == split])

    def read(self, index: int) -> Pair:
        name = self.names[index]
        frame = _real_frames()[name]
        cfa = CFA(frame["cfa"])

        # a PNG holds the four planes below each other
        numbers = read_plane(REAL_FRAMES / f"{name}.png").astype(np.float32)
        light = (numbers - REAL_BLACK) / (REAL_WHITE - REAL_BLACK)
        planes = torch.from_numpy(light).reshape(4, -1, numbers.shape[-1])

        clean = RawFrame(
            unpack(planes, cfa),
            cfa,
            white_balance=tuple(frame["white_balance"]),
            color_matrix=torch.tensor(frame["color_matrix"]),
            camera=frame["camera"],
            iso=frame["iso"],
            noise_profile=tuple(frame["own_noise"]),
        )
        return develop_pair(name, clean)


@cache
def _real_frames() -> dict[str, dict[str, Any]]:
    frames: dict[str, dict[str, Any]] = json.loads((REAL_FRAMES / "frames.json").read_text(encoding="utf-8"))
    return frames
