"""Benchmarks whose clean frames are not public: SIDD's blocks and DND's boxes, and the files that their servers take.

*SIDD.* ``BenchmarkNoisyBlocksRaw.mat`` holds an array of the same name, (40 scene instances, 32 blocks, rows, columns),
as :mod:`rawaug.data.sidd` says. A submission is a CSV with the columns ID (0 to 1279, block by block, frame by frame)
and BLOCK (the bytes of the float32 block, row by row, in base64). Source: the example code of the dataset's first
author, ``sidd_kaggle_submit``.

*DND*: fifty frames of four cameras, to be denoised in twenty boxes each. ``info.mat`` (version 7.3) holds the struct
array ``info`` with, for each frame, ``boundingboxes`` (top, left, bottom, right, counted from 1, both ends inside),
``nlf`` (var(y) = a y + b) and ``camera`` (``pattern`` with R, G, B as 1, 2, 3, ``AsShotNeutral``, ``ColorMatrix2``);
``images_raw/0001.mat`` holds the frame ``Inoisy`` in [0, 1]. As every matrix of such files the pattern is transposed
for those who do not exchange its axes: GBRG then looks like GRBG. Source: T. Plötz, S. Roth, "Benchmarking denoising
algorithms with real photographs", CVPR 2017, and its submission kit.
"""

from __future__ import annotations

import base64
import csv
import sys
from collections.abc import Iterable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from rawaug.bayer import CFA
from rawaug.data.development import gains_from_neutral, srgb_from_camera
from rawaug.data.formats import read_array, read_value, to_raw
from rawaug.data.pairs import Lazy, Pair
from rawaug.data.sidd import BLOCKS, HELD_BACK, Once, blocks_of_scenes, find_file, noise_level_functions, phone_of
from rawaug.files import require_file
from rawaug.io import RawFrame
from rawaug.registry import DATASETS

SIDE = 256
COUNT = len(HELD_BACK) * BLOCKS


class SiddBenchmark(Lazy[RawFrame]):
    """The noisy blocks of ``BenchmarkNoisyBlocksRaw.mat`` below a folder, with their levels where these are published.

    Results go to :func:`write_submission`, in the same order.
    """

    def __init__(self, path: str | Path) -> None:
        self.levels = noise_level_functions(Path(path))
        self._all = Once(partial(blocks_of_scenes, find_file(Path(path), "BenchmarkNoisyBlocksRaw.mat")))
        super().__init__([f"{scene}_{block:02d}" for scene in HELD_BACK for block in range(BLOCKS)])

    def read(self, index: int) -> RawFrame:
        scene, block = divmod(index, BLOCKS)
        (_, cfa), levels = phone_of(HELD_BACK[scene]), self.levels.get(HELD_BACK[scene])
        return RawFrame(self._all()[scene, block], cfa, noise_profile=levels, name=self.names[index], color_known=False)


def write_submission(path: str | Path, blocks: Iterable[Tensor], side: int = SIDE) -> None:
    """Write 1,280 denoised mosaics ``(1, side, side)``, finite, in the order and patterns of :class:`SiddBenchmark`.

    ``path`` is ``SubmitRaw.csv``; values are written as they are.
    """
    path = Path(path)
    if path.suffix != ".csv":
        raise ValueError(f"{path}: a SIDD submission must be a .csv file")
    arrays = [_denoised(block, f"block {k}", (side, side)) for k, block in enumerate(blocks)]
    if len(arrays) != COUNT:
        raise ValueError(f"{path}: a submission must have {COUNT} blocks, got {len(arrays)}")
    with path.open("w", encoding="ascii", newline="") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow(["ID", "BLOCK"])
        table.writerows((k, base64.b64encode(array.astype("<f4").tobytes()).decode()) for k, array in enumerate(arrays))


def check_submission(path: str | Path, side: int = SIDE) -> Tensor:
    """Read a submission back as ``(1280, 1, side, side)``.

    ValueError, in one line, if the benchmark would refuse it, or if values leave [0, 1], which it would not notice.
    """
    blocks = _from_csv(Path(path), side)
    _require_range(blocks, f"{path}:")
    return torch.from_numpy(blocks)[:, None]


def _denoised(mosaic: Tensor, name: str, size: tuple[int, int] | None = None) -> np.ndarray:
    """The array that is written for a denoised mosaic, float32 ``(H, W)``."""
    height, width = size or mosaic.shape[-2:]
    if tuple(mosaic.shape) != (1, height, width) or not mosaic.isfinite().all():
        raise ValueError(f"{name}: must be finite with shape (1, {height}, {width}), got {tuple(mosaic.shape)}")
    return mosaic[0].detach().cpu().float().numpy()


def _require_range(values: np.ndarray, name: str) -> None:
    if not (np.isfinite(values).all() and values.min() >= 0 and values.max() <= 1):
        raise ValueError(f"{name} has values from {values.min():.4g} to {values.max():.4g}; clip them to [0, 1]")


def _from_csv(path: Path, side: int) -> np.ndarray:
    csv.field_size_limit(sys.maxsize)
    require_file(path)
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


FRAMES, BOXES = 50, 20


class Dnd(Lazy[RawFrame]):
    """The boxes, frame by frame: 1,000 of 512 x 512; one frame at a time is in memory."""

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        info = self.path / "info.mat"
        frames = read_value(info, "info")
        if not isinstance(frames, list):
            raise ValueError(f"{info}: info is not a struct array over the frames")
        self.frames = [_frame(frame, info, k) for k, frame in enumerate(frames)]
        missing = [file for file in map(self.file, range(len(frames))) if not file.is_file()]
        if missing:
            raise FileNotFoundError(f"{missing[0]}: no such frame of DND; {len(missing)} of {len(frames)} are missing")
        self.places = [(k, box) for k, frame in enumerate(self.frames) for box in range(len(frame.boxes))]
        self._frame: tuple[int, Tensor] | None = None
        super().__init__([f"{k + 1:04d}_{box + 1:02d}" for k, box in self.places])

    def file(self, frame: int) -> Path:
        """The file of a frame, counted from 0."""
        return self.path / "images_raw" / f"{frame + 1:04d}.mat"

    def read(self, index: int) -> RawFrame:
        k, box = self.places[index]
        if self._frame is None or self._frame[0] != k:
            self._frame = k, to_raw(read_array(self.file(k), "Inoisy"), 2, self.file(k))
        (_, noisy), frame = self._frame, self.frames[k]
        top, left, bottom, right = frame.boxes[box]
        if not (0 <= top < bottom <= noisy.shape[1] and 0 <= left < right <= noisy.shape[2]):
            size = f"{noisy.shape[1]} x {noisy.shape[2]}"
            raise ValueError(f"{self.file(k)}: box {box + 1} of info.mat extends beyond the frame of {size}")
        mosaic = noisy[:, top:bottom, left:right].contiguous()
        return RawFrame(mosaic, frame.cfa.shift(top, left), name=self.names[index], **frame.stated)


class _Frame(NamedTuple):
    """A frame as ``info`` describes it; boxes are counted from 0, and their ends lie outside."""

    boxes: list[tuple[int, int, int, int]]
    cfa: CFA
    stated: dict[str, Any]


def _frame(info: dict[str, Any], file: Path, index: int) -> _Frame:
    try:
        boxes = np.asarray(info["boundingboxes"]).reshape(-1, 4).astype(int).tolist()
        camera, noise = info["camera"], info["nlf"]
        return _Frame(
            [(top - 1, left - 1, bottom, right) for top, left, bottom, right in boxes],
            CFA("".join("RGB"[int(colour) - 1] for colour in np.ravel(camera["pattern"]))),
            {
                "noise_profile": (float(noise["a"]), float(noise["b"])),
                "white_balance": gains_from_neutral(camera["AsShotNeutral"]),
                "color_matrix": srgb_from_camera(camera["ColorMatrix2"]),
            },
        )
    except (KeyError, TypeError, ValueError, IndexError, np.linalg.LinAlgError) as error:
        raise ValueError(f"{file}: frame {index + 1} of info is not as published ({error})") from error


@DATASETS.register("dnd")
def no_clean_frames(path: str, split: str) -> Sequence[Pair]:
    """Nothing: DND has no pairs."""
    raise ValueError(f"dnd:{path}: the clean frames of DND are not public; use rawaug.data.Dnd and submit the results")


def write_dnd_submission(folder: str | Path, denoised: Iterable[Tensor]) -> None:
    """Write 1,000 denoised boxes ``(1, H, W)``, finite, in the order and patterns of :class:`Dnd`, as its 50 files."""
    from scipy.io import savemat

    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    cells, count = np.empty(BOXES, object), 0
    for mosaic in denoised:
        cells[count % BOXES] = _denoised(mosaic, f"box {count}")
        count += 1
        if count % BOXES == 0 and count <= FRAMES * BOXES:
            savemat(folder / f"{count // BOXES:04d}.mat", {"Idenoised": cells, "israw": True, "eval_version": "1.0"})
    if count != FRAMES * BOXES:
        raise ValueError(f"{folder}: a submission must have {FRAMES * BOXES} boxes, got {count}")


def check_dnd_submission(folder: str | Path, dnd: Dnd) -> None:
    """Raise ValueError, in one line, if a box of a submission has another size, type or range than it should."""
    for k, frame in enumerate(dnd.frames):
        file = Path(folder) / f"{k + 1:04d}.mat"
        boxes = list(np.atleast_1d(np.asarray(read_value(file, "Idenoised"))))
        if len(boxes) != len(frame.boxes) or not int(read_value(file, "israw")):
            raise ValueError(f"{file}: contains {len(boxes)} RAW boxes, expected {len(frame.boxes)}")
        for number, (box, (top, left, bottom, right)) in enumerate(zip(boxes, frame.boxes, strict=True), 1):
            if box.shape != (bottom - top, right - left) or box.dtype != np.float32:
                expected = (bottom - top, right - left)
                raise ValueError(f"{file}: box {number} must be float32 {expected}, got {box.dtype} {box.shape}")
            _require_range(box, f"{file}: box {number}")
