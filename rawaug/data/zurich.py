r"""Zurich RAW to RGB: crops of a Huawei P20's RAW, and of the same scenes by a Canon 5D Mark IV.

    y = min((d - 63) / (1020 - 63), 1)

for the numbers d of ``SPLIT/huawei_raw/0.png``, a PNG of 16 bits with 10 of them used, RGGB, 448 x 448; the picture is
``SPLIT/canon/0.jpg``. It was taken by another camera from another place: the pairs are not registered, and no camera's
ISP leads from one to the other. The files have no white balance: gains are 1, the colour matrix is the identity.

Source: A. Ignatov, L. Van Gool, R. Timofte, "Replacing mobile camera ISP with a single deep learning model", CVPR
workshops 2020, whose loader divides by 1020 and leaves black in; the black level is that of Z. Zhang et al., "Learning
RAW-to-sRGB mappings with inaccurately aligned supervision", ICCV 2021.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from rawaug.bayer import CFA
from rawaug.data.lazy import LazyPairs
from rawaug.data.pair import Pair
from rawaug.io import read_picture
from rawaug.io.apart import apart
from rawaug.io.picture_files import read_plane
from rawaug.registry import DATASETS

BLACK, WHITE = 63, 1020
_BITS = 10


@DATASETS.register("zurich")
class Zurich(LazyPairs):
    """The pairs of a split, sorted by number.

    Args:
        path: contains ``train`` and ``test`` with ``huawei_raw`` and ``canon`` in each.
        split: ``"train"`` or ``"test"``.
        black, white: in digital numbers of 10 bits. PNGs of 8 bits hold a quarter of them.

    Raises:
        FileNotFoundError: if there is no such folder, or a RAW has no picture.
        ValueError: if there is no such split, or it holds no RAW.

    Example:
        >>> Zurich("Zurich-RAW-to-DSLR", "test")[0].registered  # doctest: +SKIP
        False
    """

    def __init__(self, path: str | Path, split: str = "train", black: float = BLACK, white: float = WHITE) -> None:
        if split not in ("train", "test"):
            raise ValueError(f"zurich: no split {split}; use train or test")
        folder = Path(path) / split
        if not (folder / "huawei_raw").is_dir():
            raise FileNotFoundError(f"{folder / 'huawei_raw'}: no such folder of Zurich RAW to RGB")
        self.files = sorted((folder / "huawei_raw").glob("*.png"), key=lambda file: (len(file.stem), file.stem))
        if not self.files:
            raise ValueError(f"{folder / 'huawei_raw'}: contains no PNG")
        existing = {file.name for file in (folder / "canon").glob("*.jpg")}
        missing = [file for file in self.files if f"{file.stem}.jpg" not in existing]
        if missing:
            raise FileNotFoundError(
                f"{folder / 'canon' / missing[0].stem}.jpg: is missing, and {len(missing) - 1} others"
            )
        self.folder, self.black, self.white = folder, black, white
        super().__init__([f"{split}_{file.stem}" for file in self.files])

    def read(self, index: int) -> Pair:
        file = self.files[index]
        numbers = apart(read_plane, file, self.max_pixels)
        scale = 1.0 if numbers.dtype == np.uint16 else 0.25
        if numbers.max() >= scale * 2**_BITS:
            raise ValueError(
                f"{file}: has value {numbers.max()}, more than {_BITS} bits; it is not a RAW of this dataset"
            )
        light = (numbers.astype(np.float32) - scale * self.black) / (scale * (self.white - self.black))
        return Pair(
            name=self.names[index],
            srgb=apart(read_picture, self.folder / "canon" / f"{file.stem}.jpg", self.max_pixels),
            raw=torch.from_numpy(np.minimum(light, 1))[None],
            cfa=CFA.RGGB,
            white_balance=(1.0, 1.0, 1.0),
            color_matrix=torch.eye(3),
            camera="Huawei P20 (picture: Canon 5D Mark IV)",
            registered=False,
        )
