"""The file in which results go to the SIDD benchmark (RAW track), and a check of it.

Published in two forms: a CSV with the columns ID (0 to 1279, block by block, frame by frame) and BLOCK (the bytes of
the float32 block, row by row, in base64), for the pages on Kaggle; and ``SubmitRaw.mat`` of version 5 with the array
``SubmitRaw`` (40, 32, 256, 256). Source: the example code of the dataset's first author, ``sidd_kaggle_submit``.
"""

from __future__ import annotations

import base64
import csv
import sys
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from rawaug.data.mat import read_array
from rawaug.data.sidd.blocks import BLOCKS
from rawaug.data.sidd.scenes import HELD_BACK

SIDE = 256
COUNT = len(HELD_BACK) * BLOCKS


def write_submission(path: str | Path, blocks: Iterable[Tensor], side: int = SIDE) -> None:
    """Write denoised mosaics, in the order of :class:`rawaug.data.SiddBenchmark`, as ``.csv`` or ``.mat``.

    Args:
        path: ``SubmitRaw.csv`` or ``SubmitRaw.mat``.
        blocks: 1,280 tensors ``(1, H, W)``, in the pattern that they came in. Values are written as they are.
        side: of the blocks.

    Raises:
        ValueError: if the extension is another, a block has the wrong shape or a value that is not finite, or there are
            not 1,280.
    """
    path = Path(path)
    if path.suffix not in (".csv", ".mat"):
        raise ValueError(f"{path}: a SIDD submission must be a .csv or .mat file")
    arrays = [_checked(block, k, side) for k, block in enumerate(blocks)]
    if len(arrays) != COUNT:
        raise ValueError(f"{path}: a submission must have {COUNT} blocks, got {len(arrays)}")
    if path.suffix == ".mat":
        from scipy.io import savemat

        savemat(path, {"SubmitRaw": np.stack(arrays).reshape(len(HELD_BACK), BLOCKS, side, side)})
        return
    with path.open("w", encoding="ascii", newline="") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow(["ID", "BLOCK"])
        table.writerows((k, base64.b64encode(array.tobytes()).decode()) for k, array in enumerate(arrays))


def check_submission(path: str | Path, side: int = SIDE) -> Tensor:
    """Read a submission back as ``(1280, 1, side, side)``.

    Raises:
        FileNotFoundError, OSError: if there is no such file, or it is damaged.
        ValueError: in one line, if the benchmark would refuse it, or values leave [0, 1] (which it would not notice).
    """
    path = Path(path)
    blocks = _from_mat(path, side) if path.suffix == ".mat" else _from_csv(path, side)
    if not np.isfinite(blocks).all() or blocks.min() < 0 or blocks.max() > 1:
        raise ValueError(f"{path}: has values from {blocks.min():.4g} to {blocks.max():.4g}; clip them to [0, 1]")
    return torch.from_numpy(blocks)[:, None]


def _checked(block: Tensor, index: int, side: int) -> np.ndarray:
    if tuple(block.shape) != (1, side, side):
        raise ValueError(f"block {index}: must have shape (1, {side}, {side}), got {tuple(block.shape)}")
    if not block.isfinite().all():
        raise ValueError(f"block {index}: has values that are not finite")
    return block[0].detach().cpu().numpy().astype("<f4", order="C")


def _from_mat(path: Path, side: int) -> np.ndarray:
    array = read_array(path, "SubmitRaw")
    if array.shape != (len(HELD_BACK), BLOCKS, side, side) or array.dtype != np.float32:
        expected = (len(HELD_BACK), BLOCKS, side, side)
        raise ValueError(f"{path}: SubmitRaw must be float32 {expected}, got {array.dtype} {array.shape}")
    return np.ascontiguousarray(array).reshape(COUNT, side, side)


def _from_csv(path: Path, side: int) -> np.ndarray:
    csv.field_size_limit(sys.maxsize)
    with path.open(encoding="ascii", newline="") as file:
        rows = list(csv.reader(file))
    if rows[:1] != [["ID", "BLOCK"]] or [row[0] for row in rows[1:]] != [str(k) for k in range(COUNT)]:
        raise ValueError(f"{path}: must have the columns ID and BLOCK, with IDs 0 to {COUNT - 1} in order")
    blocks = np.empty((COUNT, side, side), np.float32)
    for k, row in enumerate(rows[1:]):
        data = base64.b64decode(row[1])
        if len(data) != 4 * side * side:
            raise ValueError(f"{path}: block {k} has {len(data)} bytes, expected {4 * side * side} (float32)")
        blocks[k] = np.frombuffer(data, "<f4").reshape(side, side)
    return blocks
