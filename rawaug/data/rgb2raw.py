"""RGB2RAW, the set of NTIRE 2025's RAW reconstruction from sRGB: crops of three phones, as RAWIR's.

Files are ``PHONE/RAWID_CROP.npy``, uint16 ``(512, 512, 4)`` in RGGB with white at 2^12 - 1, and the phone's PNG
of 1024 x 1024 beside each. Only the training pairs are public, so the splits are this package's own: of each folder's
RAW files in the order of their names every tenth is for the test and the one after it for validation, with all
of its crops. Source: the dataset's page, <https://huggingface.co/datasets/marcosv/rgb2raw>.
"""

from __future__ import annotations

from pathlib import Path

from rawaug.data.rawir import Rawir
from rawaug.registry import DATASETS

TENTH = 10
_TURN = {"test": (0,), "validation": (1,), "train": tuple(range(2, TENTH))}


@DATASETS.register("rgb2raw")
class Rgb2Raw(Rawir):
    """The pairs of a split; a pair's camera is the name of its folder.

    Args:
        path: contains the arrays, ``.npy`` or ``.npz``, with a picture beside each, at any depth.
        split: ``"train"``, ``"validation"`` or ``"test"``.

    Raises:
        FileNotFoundError: if there is no such folder, or an array has no picture beside it.
        ValueError: if there is no such split, or it holds no pair.

    Example:
        >>> Rgb2Raw("train_rgb2raw", "test")[0].raw.shape  # doctest: +SKIP
        torch.Size([1, 1024, 1024])
    """

    def __init__(self, path: str | Path, split: str = "train") -> None:
        super().__init__(path, split)
        by_folder: dict[Path, list[str]] = {}
        for file in self.files:
            shots = by_folder.setdefault(file.parent, [])
            shots += [] if _raw_id(file) in shots else [_raw_id(file)]
        turn = {(folder, shot): k % TENTH for folder, shots in by_folder.items() for k, shot in enumerate(shots)}
        kept = [k for k, file in enumerate(self.files) if turn[file.parent, _raw_id(file)] in _TURN[split]]
        if not kept:
            raise ValueError(f"{path}: has no pair of RGB2RAW for {split}; it needs files of {TENTH} RAWs")
        for key in ("files", "pictures", "names"):
            setattr(self, key, [getattr(self, key)[k] for k in kept])

    def camera_of(self, file: Path) -> str:
        return file.parent.name


def _raw_id(file: Path) -> str:
    """``12_3`` is crop 3 of RAW 12."""
    return file.stem.rpartition("_")[0] or file.stem
