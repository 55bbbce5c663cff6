"""The Darmstadt Noise Dataset: noisy boxes whose clean versions are not public, and the files that its server takes.

Fifty frames of four cameras are to be denoised in twenty boxes each. ``info.mat`` (version 7.3) holds the struct array
``info`` with, for each frame, ``boundingboxes`` (top, left, bottom, right, counted from 1, both ends inside), ``nlf``
(var(y) = a y + b) and ``camera`` (``pattern`` with R, G, B as 1, 2, 3, ``AsShotNeutral``, ``ColorMatrix2``);
``images_raw/0001.mat`` holds the frame ``Inoisy`` in [0, 1]. As with every matrix in such files, the pattern appears
transposed to a reader that does not exchange its axes: GBRG then looks like GRBG. Source: T. Plötz, S. Roth,
"Benchmarking denoising algorithms with real photographs", CVPR 2017, and its submission kit.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor

from rawaug.bayer import CFA
from rawaug.data.development import gains_from_neutral, srgb_from_camera
from rawaug.data.frames import Frames
from rawaug.data.mat import read_array, read_value, to_raw
from rawaug.data.pairs import DATASETS, Pair
from rawaug.files import write_bytes
from rawaug.io import RawFrame

FRAMES, BOXES = 50, 20
"""Number of frames of the published dataset, and number of boxes in a frame."""


class Dnd(Frames[RawFrame]):
    """The boxes, frame by frame: 1,000 boxes of 512 x 512. One frame at a time is in memory.

    Results go to :func:`write_dnd_submission`, in the same order.

    Raises:
        FileNotFoundError: if ``info.mat`` or a frame is missing below ``path``.
        ValueError: if ``info.mat`` is not as published.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        info = self.path / "info.mat"
        entries = read_value(info, "info")
        if not isinstance(entries, list):
            raise ValueError(f"{info}: info is not a struct array over the frames")
        self.frames = [parse_frame(entry, info, number) for number, entry in enumerate(entries)]

        missing = [self.file(number) for number in range(len(self.frames)) if not self.file(number).is_file()]
        if missing:
            raise FileNotFoundError(
                f"{missing[0]}: no such frame of DND; {len(missing)} of {len(self.frames)} are missing"
            )

        self.places: list[tuple[int, int]] = []
        names = []
        for number, (boxes, _, _) in enumerate(self.frames):
            for box in range(len(boxes)):
                self.places.append((number, box))
                names.append(f"{number + 1:04d}_{box + 1:02d}")
        self._open_frame: tuple[int, Tensor] | None = None
        super().__init__(names)

    def file(self, number: int) -> Path:
        """The file of a frame; frames are counted from 0."""
        return self.path / "images_raw" / f"{number + 1:04d}.mat"

    def read(self, index: int) -> RawFrame:
        number, box_number = self.places[index]
        if self._open_frame is None or self._open_frame[0] != number:
            mosaic = to_raw(read_array(self.file(number), "Inoisy"), 2, self.file(number))
            self._open_frame = (number, mosaic)

        noisy = self._open_frame[1]
        boxes, cfa, stated = self.frames[number]
        top, left, bottom, right = boxes[box_number]
        height, width = noisy.shape[-2:]
        inside = 0 <= top < bottom <= height and 0 <= left < right <= width
        if not inside:
            raise ValueError(
                f"{self.file(number)}: box {box_number + 1} of info.mat extends beyond the frame of {height} x {width}"
            )

        cut = noisy[:, top:bottom, left:right].contiguous()
        return RawFrame(cut, cfa.shift(top, left), name=self.names[index], **stated)


def parse_frame(entry: Any, file: Path, number: int) -> tuple[list[tuple[int, ...]], CFA, dict[str, Any]]:
    """Parse a frame of the struct array ``info``: its boxes, its pattern, and what it states for a RawFrame.

    A box is top, left, bottom and right, counted from 0; the ends lie outside.

    ValueError, naming the file, is raised if it is not as published.
    """
    try:
        boxes: list[tuple[int, ...]] = []
        for top, left, bottom, right in np.asarray(entry["boundingboxes"]).reshape(-1, 4).astype(int).tolist():
            boxes.append((top - 1, left - 1, bottom, right))

        camera, noise = entry["camera"], entry["nlf"]
        colours = ["RGB"[int(colour) - 1] for colour in np.ravel(camera["pattern"])]
        stated = {
            "noise_profile": (float(noise["a"]), float(noise["b"])),
            "white_balance": gains_from_neutral(camera["AsShotNeutral"]),
            "color_matrix": srgb_from_camera(camera["ColorMatrix2"]),
        }
        return boxes, CFA("".join(colours)), stated
    except (KeyError, TypeError, ValueError, IndexError, np.linalg.LinAlgError) as error:
        raise ValueError(f"{file}: frame {number + 1} of info is not as published ({error})") from error


@DATASETS.register("dnd")
def no_clean_frames(path: str, split: str) -> Sequence[Pair]:
    """Refuse to open pairs, which DND does not have."""
    raise ValueError(
        f"dnd:{path}: the clean frames of DND are not public; denoise it with rawaug submit dnd:{path}, and submit "
        "the result"
    )


def write_dnd_submission(folder: str | Path, denoised: Iterable[Tensor]) -> None:
    """Write 1,000 denoised boxes ``(1, H, W)`` in [0, 1], in the order and patterns of :class:`Dnd`, as its 50 files.

    Raises:
        ValueError: if a box has another shape or values outside [0, 1], or there are not 1,000 of them.
    """
    from scipy.io import savemat

    folder = Path(folder)
    cells = np.empty(BOXES, object)
    count = 0

    for mosaic in denoised:
        cells[count % BOXES] = checked_box(mosaic, f"box {count}")
        count += 1
        if count % BOXES == 0 and count <= FRAMES * BOXES:
            file = folder / f"{count // BOXES:04d}.mat"
            content = BytesIO()
            savemat(content, {"Idenoised": cells, "israw": True, "eval_version": "1.0"})
            write_bytes(content.getbuffer(), file)

    if count != FRAMES * BOXES:
        raise ValueError(f"{folder}: a submission must have {FRAMES * BOXES} boxes, got {count}")


def checked_box(mosaic: Tensor, name: str) -> np.ndarray:
    """Make the array to write for a denoised mosaic, float32 ``(H, W)``."""
    in_range = bool((mosaic >= 0.0).all() and (mosaic <= 1.0).all())  # False for NaN
    if mosaic.ndim != 3 or mosaic.shape[0] != 1 or not in_range:
        raise ValueError(f"{name}: must have values in [0, 1] and shape (1, H, W), got {tuple(mosaic.shape)}")
    return mosaic[0].detach().cpu().float().numpy()
