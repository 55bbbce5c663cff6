"""DND: fifty noisy RAW frames of four cameras, to be denoised in twenty boxes each; the clean ones are not public.

``info.mat`` (version 7.3) holds the struct array ``info`` with, for each frame, ``boundingboxes`` (top, left, bottom,
right, counted from 1, both ends inside), ``nlf`` (var(y) = a y + b) and ``camera`` (``pattern`` with R, G, B as 1, 2,
3, ``AsShotNeutral``, ``ColorMatrix2``); ``images_raw/0001.mat`` holds the frame ``Inoisy`` in [0, 1]. As every matrix
of such files the pattern is transposed for those who do not exchange its axes: GBRG then looks like GRBG.

Source: T. Plötz, S. Roth, "Benchmarking denoising algorithms with real photographs", CVPR 2017, and its submission kit.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from rawaug.bayer import CFA
from rawaug.data.development import color_matrix, white_balance
from rawaug.data.mat import read_array, read_value
from rawaug.data.pairs import Pair
from rawaug.registry import DATASETS

FRAMES, BOXES = 50, 20
_EVALUATION = "1.0"


@dataclass(frozen=True)
class DndCrop:
    """One box of a frame.

    Attributes:
        name: ``"0001_01"``, frame and box, counted from 1 as in the submission.
        noisy: float32 ``(1, H, W)``, black 0, white 1, as published.
        cfa: the pattern of ``noisy``, which is the frame's moved to the corner of the box.
        shot_var, read_var: the published noise levels of the frame.
        white_balance: as-shot multipliers of R, G, B, green being 1.
        color_matrix: float32 ``(3, 3)``, white-balanced camera colour to linear sRGB, rows summing to 1.
    """

    name: str
    noisy: Tensor
    cfa: CFA
    shot_var: float
    read_var: float
    white_balance: tuple[float, float, float]
    color_matrix: Tensor


class Dnd(Sequence[DndCrop]):
    """The boxes, frame by frame: 1,000 of 512 x 512; one frame at a time is in memory.

    Args:
        path: the folder with ``info.mat`` and ``images_raw``.

    Raises:
        FileNotFoundError, OSError, ValueError: if a file is missing, damaged, or is not as published.

    Example:
        >>> dnd = Dnd("dnd_2017")  # doctest: +SKIP
        >>> write_dnd_submission("submission", (denoise(crop) for crop in dnd))  # doctest: +SKIP
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        info = self.path / "info.mat"
        frames = read_value(info, "info")
        if not isinstance(frames, list):
            raise ValueError(f"{info}: info is not a struct array over the frames")
        self.frames = [_Frame.of(frame, info, k) for k, frame in enumerate(frames)]
        missing = [file for file in map(self.file, range(len(frames))) if not file.is_file()]
        if missing:
            raise FileNotFoundError(f"{missing[0]}: no such frame of DND; {len(missing)} of {len(frames)} are missing")
        self._last: tuple[int, np.ndarray] | None = None

    def file(self, frame: int) -> Path:
        """The file of a frame, counted from 0."""
        return self.path / "images_raw" / f"{frame + 1:04d}.mat"

    def __len__(self) -> int:
        return sum(len(frame.boxes) for frame in self.frames)

    def __getitem__(self, index: int) -> DndCrop:  # type: ignore[override]
        index = range(len(self))[index]
        for k, frame in enumerate(self.frames):
            if index < len(frame.boxes):
                return self._crop(k, index)
            index -= len(frame.boxes)
        raise AssertionError("the index is below the sum of the boxes")

    def _crop(self, k: int, box: int) -> DndCrop:
        frame, noisy = self.frames[k], self._noisy(k)
        top, left, bottom, right = frame.boxes[box]
        if not (0 <= top < bottom <= noisy.shape[0] and 0 <= left < right <= noisy.shape[1]):
            raise ValueError(f"{self.file(k)}: box {box + 1} of info.mat extends beyond the frame {noisy.shape}")
        return DndCrop(
            name=f"{k + 1:04d}_{box + 1:02d}",
            noisy=torch.from_numpy(np.ascontiguousarray(noisy[top:bottom, left:right]))[None],
            cfa=frame.cfa.shifted(top, left),
            shot_var=frame.shot_var,
            read_var=frame.read_var,
            white_balance=frame.white_balance,
            color_matrix=frame.color_matrix,
        )

    def _noisy(self, k: int) -> np.ndarray:
        if self._last is None or self._last[0] != k:
            frame = read_array(self.file(k), "Inoisy")
            low, high = float(frame.min()), float(frame.max())
            if frame.ndim != 2 or not (low > -1 and high <= 1):
                raise ValueError(
                    f"{self.file(k)}: Inoisy {frame.shape} has values from {low:.4g} to {high:.4g}, expected at most 1"
                )
            self._last = k, frame.astype(np.float32)
        return self._last[1]


@dataclass(frozen=True)
class _Frame:
    boxes: list[tuple[int, int, int, int]]
    cfa: CFA
    shot_var: float
    read_var: float
    white_balance: tuple[float, float, float]
    color_matrix: Tensor

    @classmethod
    def of(cls, info: dict[str, Any], file: Path, index: int) -> _Frame:
        """From an element of the struct array; boxes then run from 0, and end outside."""
        try:
            boxes = np.asarray(info["boundingboxes"]).reshape(-1, 4).astype(int).tolist()
            pattern = "".join("RGB"[int(colour) - 1] for colour in np.ravel(info["camera"]["pattern"]))
            return cls(
                [(top - 1, left - 1, bottom, right) for top, left, bottom, right in boxes],
                CFA(pattern),
                float(info["nlf"]["a"]),
                float(info["nlf"]["b"]),
                white_balance(info["camera"]["AsShotNeutral"]),
                color_matrix(info["camera"]["ColorMatrix2"]),
            )
        except (KeyError, TypeError, ValueError, IndexError, np.linalg.LinAlgError) as error:
            raise ValueError(f"{file}: frame {index + 1} of info is not as published ({error})") from error


@DATASETS.register("dnd")
def no_clean_frames(path: str, split: str) -> Sequence[Pair]:
    """Nothing: DND has no pairs."""
    raise ValueError(f"dnd:{path}: the clean frames of DND are not public; use rawaug.data.Dnd and submit the results")


def write_dnd_submission(folder: str | Path, denoised: Iterable[Tensor]) -> None:
    """Write denoised boxes, in the order of :class:`Dnd`, as the benchmark's files ``0001.mat`` to ``0050.mat``.

    Args:
        folder: made where it does not exist.
        denoised: 1,000 mosaics ``(1, H, W)``, in the pattern that they came in. Values are written as they are.

    Raises:
        ValueError: if one has the wrong shape or a value that is not finite, or there are not 1,000.
    """
    from scipy.io import savemat

    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    cells, count = np.empty(BOXES, object), 0
    for mosaic in denoised:
        if mosaic.ndim != 3 or mosaic.shape[0] != 1 or not mosaic.isfinite().all():
            raise ValueError(
                f"box {count}: a denoised box must be finite with shape (1, H, W), got {tuple(mosaic.shape)}"
            )
        cells[count % BOXES] = mosaic[0].detach().cpu().float().numpy()
        count += 1
        if count % BOXES == 0 and count <= FRAMES * BOXES:
            content = {"Idenoised": cells, "israw": True, "eval_version": _EVALUATION}
            savemat(folder / f"{count // BOXES:04d}.mat", content)
    if count != FRAMES * BOXES:
        raise ValueError(f"{folder}: a submission must have {FRAMES * BOXES} boxes, got {count}")


def check_dnd_submission(folder: str | Path, dnd: Dnd) -> None:
    """Check a submission's files against the boxes that they answer.

    Raises:
        FileNotFoundError, OSError: if a file is missing or damaged.
        ValueError: in one line, if a box has another size, type or range than it should.
    """
    for k, frame in enumerate(dnd.frames):
        file = Path(folder) / f"{k + 1:04d}.mat"
        boxes = list(np.atleast_1d(np.asarray(read_value(file, "Idenoised"))))
        if len(boxes) != len(frame.boxes) or not int(read_value(file, "israw")):
            raise ValueError(f"{file}: contains {len(boxes)} RAW boxes, expected {len(frame.boxes)}")
        for number, (box, (top, left, bottom, right)) in enumerate(zip(boxes, frame.boxes, strict=True), 1):
            if box.shape != (bottom - top, right - left) or box.dtype != np.float32:
                expected = (bottom - top, right - left)
                raise ValueError(f"{file}: box {number} must be float32 {expected}, got {box.dtype} {box.shape}")
            if not (np.isfinite(box).all() and box.min() >= 0 and box.max() <= 1):
                raise ValueError(
                    f"{file}: box {number} has values from {box.min():.4g} to {box.max():.4g}; clip it to [0, 1]"
                )
