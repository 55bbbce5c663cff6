"""DND: fifty noisy RAW frames of four cameras, to be denoised in twenty boxes each; the clean ones are not public.

``info.mat`` (version 7.3) holds the struct array ``info`` with, for each frame, ``boundingboxes`` (top, left, bottom,
right, counted from 1, both ends inside), ``nlf`` (var(y) = a y + b) and ``camera`` (``pattern`` with R, G, B as 1, 2,
3, ``AsShotNeutral``, ``ColorMatrix2``); ``images_raw/0001.mat`` holds the frame ``Inoisy`` in [0, 1]. As every matrix
of such files the pattern is transposed for those who do not exchange its axes: GBRG then looks like GRBG.

Source: T. Plötz, S. Roth, "Benchmarking denoising algorithms with real photographs", CVPR 2017, and its submission kit.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from torch import Tensor

from rawaug.bayer import CFA
from rawaug.data.development import color_matrix, white_balance
from rawaug.data.mat import normalised, read_array, read_value
from rawaug.data.pairs import Lazy, NoisyBlock, Pair
from rawaug.registry import DATASETS

FRAMES, BOXES = 50, 20
_EVALUATION = "1.0"


class Dnd(Lazy[NoisyBlock]):
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

    def read(self, index: int) -> NoisyBlock:
        k, box = self.places[index]
        if self._frame is None or self._frame[0] != k:
            self._frame = k, normalised(read_array(self.file(k), "Inoisy"), 2, self.file(k))
        (_, noisy), frame = self._frame, self.frames[k]
        top, left, bottom, right = frame.boxes[box]
        if not (0 <= top < bottom <= noisy.shape[1] and 0 <= left < right <= noisy.shape[2]):
            size = f"{noisy.shape[1]} x {noisy.shape[2]}"
            raise ValueError(f"{self.file(k)}: box {box + 1} of info.mat extends beyond the frame of {size}")
        mosaic = noisy[:, top:bottom, left:right].contiguous()
        return NoisyBlock(self.names[index], mosaic, frame.cfa.shifted(top, left), frame.levels, *frame.colour)


class _Frame(NamedTuple):
    """What ``info`` says of a frame; boxes run from 0, and end outside."""

    boxes: list[tuple[int, int, int, int]]
    cfa: CFA
    levels: tuple[float, float]
    colour: tuple[tuple[float, float, float], Tensor]


def _frame(info: dict[str, Any], file: Path, index: int) -> _Frame:
    try:
        boxes = np.asarray(info["boundingboxes"]).reshape(-1, 4).astype(int).tolist()
        camera, noise = info["camera"], info["nlf"]
        return _Frame(
            [(top - 1, left - 1, bottom, right) for top, left, bottom, right in boxes],
            CFA("".join("RGB"[int(colour) - 1] for colour in np.ravel(camera["pattern"]))),
            (float(noise["a"]), float(noise["b"])),
            (white_balance(camera["AsShotNeutral"]), color_matrix(camera["ColorMatrix2"])),
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
