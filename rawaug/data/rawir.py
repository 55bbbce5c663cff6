"""RAWIR and AIM 2022 Reversed ISP: crops of phone RAW, packed in ``.npy`` files, with the phone's picture beside them.

A file is uint16 ``(h, w, 4)`` in the order R, G of the red row, G of the blue row, B, whatever the sensor, and taken to
be black-subtracted; the picture of the same stem is ``(2h, 2w)``. White is 2^10 where the picture is a JPEG (AIM 2022:
Samsung S7, Huawei P20), 2^12 - 1 where it is a PNG (RAWIR, NTIRE 2024 and 2025). An ``.npz`` holds the same array as
``raw`` and its white level as ``max_val``. There is no white balance or colour matrix in a form that is safe to open
(RAWIR's metadata are pickles): gains are 1 and the matrix is the identity.

The P20's pictures are cropped and zoomed against their RAW: they are not registered. Source: M. V. Conde et al.,
"Reversed image signal processing and RAW reconstruction", ECCV workshops 2022, and the pages of both datasets.
"""

from __future__ import annotations

import os
import tokenize
import zipfile
import zlib
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from rawaug.bayer import CFA, unpack
from rawaug.data.lazy import LazyPairs
from rawaug.data.mat import MAX_BYTES
from rawaug.data.pair import Pair
from rawaug.io import read_picture
from rawaug.io.apart import apart
from rawaug.registry import DATASETS

WHITE = {".jpg": 2**10, ".png": 2**12 - 1}
"""White level by the picture's extension."""

_DAMAGE = (
    *(ArithmeticError, EOFError, LookupError, MemoryError, OSError, RuntimeError, SyntaxError, TypeError, ValueError),
    tokenize.TokenError,
)
"""What NumPy raises for headers that say anything."""
_ARRAYS = (".npy", ".npz")
_MAGIC = b"\x93NUMPY"

_SPLITS = {"train": "train", "validation": "val", "test": "test"}


@DATASETS.register("rawir")
class Rawir(LazyPairs):
    """The pairs below a folder, in RGGB.

    Args:
        path: contains ``.npy`` or ``.npz`` files with a picture beside each, at any depth. Where it has subfolders
            ``train``, ``val`` or ``test``, only the one of the split is taken.
        split: ``"train"``, ``"validation"`` or ``"test"``.
        white: in digital numbers; by default as :data:`WHITE` says.

    Raises:
        FileNotFoundError: if there is no such folder, or an array has no picture beside it.
        ValueError: if there is no such split, or it holds no pair.

    Example:
        >>> Rawir("data-s7", "train")[0].raw.shape  # doctest: +SKIP
        torch.Size([1, 504, 504])
    """

    def __init__(self, path: str | Path, split: str = "train", white: float | None = None) -> None:
        folder, self.white = Path(path), white
        if split not in _SPLITS:
            raise ValueError(f"rawir: no split {split}; use one of {', '.join(_SPLITS)}")
        if not folder.is_dir():
            raise FileNotFoundError(f"{path}: no such folder of RAWIR")
        if any((folder / name).is_dir() for name in _SPLITS.values()):
            folder = folder / _SPLITS[split]
        self.files = sorted(
            Path(parent, file) for parent, _, files in os.walk(folder) for file in files if file.endswith(_ARRAYS)
        )
        if not self.files:
            raise ValueError(f"{folder}: contains no .npy or .npz file of RAWIR")
        self.pictures = [picture_beside(file) for file in self.files]
        super().__init__([str(file.relative_to(folder).with_suffix("")) for file in self.files])

    def camera_of(self, file: Path) -> str:
        """The camera of a file, which the names do not say."""
        return "unknown"

    def read(self, index: int) -> Pair:
        file, picture = self.files[index], self.pictures[index]
        return Pair(
            name=self.names[index],
            srgb=apart(read_picture, picture, self.max_pixels),
            raw=unpack(read_packed(file, picture, self.white), CFA.RGGB),
            cfa=CFA.RGGB,
            camera=self.camera_of(file),
            white_balance=(1.0, 1.0, 1.0),
            color_matrix=torch.eye(3),
            registered=not _is_p20(file),
        )


def read_packed(file: Path, picture: Path, white: float | None) -> Tensor:
    """Packed RAW ``(4, h, w)`` of a file, white at 1; an ``.npz`` or the picture beside it says which white level.

    Raises:
        OSError: if the file is damaged.
        ValueError: if its array is of another kind, or exceeds white.
    """
    numbers, stated = apart(_archive, file) if file.suffix == ".npz" else (_array(file), None)
    if numbers.ndim != 3 or numbers.shape[2] != 4 or numbers.dtype.kind != "u" or not numbers.size:
        raise ValueError(f"{file}: packed RAW must be unsigned (h, w, 4), got {numbers.dtype} {numbers.shape}")
    white = white or stated or WHITE[picture.suffix.lower()]
    if numbers.max() > white:
        raise ValueError(f"{file}: has value {numbers.max()}, above the white level {white:g}; pass white=")
    return torch.from_numpy(numbers.astype(np.float32)).permute(2, 0, 1) / white


def _array(file: Path) -> np.ndarray:
    """The array of an ``.npy`` file, mapped: one that claims more than the file holds takes no memory.

    Raises:
        OSError: if it is damaged.
    """
    try:
        with file.open("rb") as opened:
            if opened.read(len(_MAGIC)) != _MAGIC:  # NumPy would open an archive of arrays, or a pickle
                raise ValueError("does not begin as one")
        return np.load(file, mmap_mode="r", allow_pickle=False)
    except _DAMAGE as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise OSError(f"{file}: cannot be read as an array ({reason}); copy it again") from error


def _archive(file: Path) -> tuple[np.ndarray, float]:
    """``raw`` and ``max_val`` of an ``.npz`` file.

    Raises:
        OSError: if it is damaged, or lacks one.
    """
    try:
        with np.load(file, allow_pickle=False) as arrays:
            size = sum(arrays.zip.getinfo(f"{name}.npy").file_size for name in ("raw", "max_val"))
            if size > MAX_BYTES:
                raise ValueError(f"declares {size} bytes, above the limit of {MAX_BYTES}")
            return arrays["raw"], float(arrays["max_val"])
    except (*_DAMAGE, zipfile.BadZipFile, zlib.error) as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise OSError(f"{file}: cannot be read as raw and max_val ({reason}); copy it again") from error


def picture_beside(file: Path) -> Path:
    """The picture of the same stem.

    Raises:
        FileNotFoundError: if there is no such picture.
    """
    for suffix in WHITE:
        if file.with_suffix(suffix).is_file():
            return file.with_suffix(suffix)
    raise FileNotFoundError(f"{file}: has no {' or '.join(WHITE)} of the same stem beside it; download it too")


def _is_p20(file: Path) -> bool:
    return any("p20" in part.lower() for part in file.parts)
