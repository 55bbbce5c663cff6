"""A folder of sRGB pictures as a map-style dataset."""

from __future__ import annotations

import warnings
from pathlib import Path

from torch import Tensor
from torch.utils.data import Dataset

from rawaug.io import read_picture

EXTENSIONS = (".bmp", ".exr", ".jpeg", ".jpg", ".jxl", ".png", ".ppm", ".tif", ".tiff", ".webp")


class PictureFolder(Dataset[Tensor]):
    """The pictures of a folder and its subfolders, sorted by path: uint8 ``(3, H, W)`` of any size.

    A file that cannot be read is replaced by the next one that can, whoever asks and in whatever order; a warning
    names it, and :attr:`skipped` holds the reason (of the files met so far, by this process).

    Args:
        path: a folder; files with the extensions of :data:`EXTENSIONS` are taken.

    Raises:
        FileNotFoundError: if there is no such folder.
        ValueError: if it holds no picture, or none that can be read.

    Example:
        >>> pictures = PictureFolder("photographs")  # doctest: +SKIP
        >>> pictures[0].shape  # doctest: +SKIP
        torch.Size([3, 375, 500])
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        if not self.path.is_dir():
            raise FileNotFoundError(f"{path}: no such folder of pictures")
        self.files = sorted(file for file in self.path.rglob("*") if file.suffix.lower() in EXTENSIONS)
        self.skipped: dict[Path, str] = {}
        if not self.files:
            raise ValueError(f"{path}: holds no picture; known are {', '.join(EXTENSIONS)}")
        self[0]  # a folder of unreadable files is told here, not in a worker

    def __len__(self) -> int:
        return len(self.files)

    def __getitem__(self, index: int) -> Tensor:
        first = range(len(self))[index]
        for file in self.files[first:] + self.files[:first]:
            if file in self.skipped:
                continue
            try:
                return read_picture(file)
            except (OSError, ValueError) as error:
                self.skipped[file] = str(error)
                warnings.warn(f"{error}; skipped", stacklevel=2)
        reason = self.skipped[self.files[first]]
        raise ValueError(f"{self.path}: none of its {len(self)} pictures can be read; {reason}")
