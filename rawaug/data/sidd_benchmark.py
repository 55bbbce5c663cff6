"""The noisy blocks of SIDD's benchmark, whose clean blocks are not public, and submissions to it.

A submission is a CSV with the columns ID (0 to 1279, block by block, frame by frame) and BLOCK (the bytes of the
float32 block, row by row, in base64). Source: the example code of the dataset's first author, ``sidd_kaggle_submit``.
"""

from __future__ import annotations

import base64
import csv
from collections.abc import Iterable
from functools import partial
from pathlib import Path

from torch import Tensor

from rawaug.data.frames import Frames
from rawaug.data.sidd_blocks import BLOCKS, Once, block_names, blocks_of_scenes
from rawaug.data.sidd_scenes import HELD_BACK, find_file, find_phone, noise_level_functions
from rawaug.files import replacing
from rawaug.io import RawFrame


class SiddBenchmark(Frames[RawFrame]):
    """The noisy blocks of ``BenchmarkNoisyBlocksRaw.mat`` below a folder, with their noise levels if published.

    Pass the results to :func:`write_submission` in the same order.
    """

    def __init__(self, path: str | Path) -> None:
        file = find_file(Path(path), "BenchmarkNoisyBlocksRaw.mat")
        self.levels = noise_level_functions(Path(path))
        self._all = Once(partial(blocks_of_scenes, file))
        super().__init__(block_names(HELD_BACK))

    def read(self, index: int) -> RawFrame:
        number, block = divmod(index, BLOCKS)
        scene = HELD_BACK[number]
        _, cfa = find_phone(scene)
        return RawFrame(
            self._all()[number, block],
            cfa,
            noise_profile=self.levels.get(scene),
            name=self.names[index],
            color_known=False,
        )


def write_submission(path: str | Path, blocks: Iterable[Tensor], side: int = 256) -> None:
    """Write 1,280 denoised mosaics ``(1, side, side)`` in [0, 1], in the order and patterns of :class:`SiddBenchmark`.

    Raises:
        ValueError: if ``path`` is not a .csv file, or the server would refuse the blocks.
    """
    path = Path(path)
    if path.suffix != ".csv":
        raise ValueError(f"{path}: a SIDD submission must be a .csv file")
    rows = []
    for number, block in enumerate(blocks):
        in_range = bool(block.numel()) and bool(block.min() >= 0.0 and block.max() <= 1.0)  # False for NaN, too
        if block.shape != (1, side, side) or not in_range:
            raise ValueError(
                f"block {number}: must have values in [0, 1] and shape (1, {side}, {side}): {tuple(block.shape)}"
            )
        content = block[0].cpu().numpy().astype("<f4").tobytes()
        rows.append((number, base64.b64encode(content).decode()))

    if len(rows) != len(HELD_BACK) * BLOCKS:
        raise ValueError(f"{path}: a submission must have {len(HELD_BACK) * BLOCKS} blocks, got {len(rows)}")

    with replacing(path) as partial, partial.open("w", encoding="ascii", newline="") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow(["ID", "BLOCK"])
        table.writerows(rows)
