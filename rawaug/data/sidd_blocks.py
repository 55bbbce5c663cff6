"""The validation blocks of SIDD, 256 x 256 pixels each, and the blocks of SIDD+ (NTIRE 2020).

Blocks have black at 0 and white at 1, and the makers clipped them at black. Pictures of blocks do not say how they were
turned. So the blocks of a frame are turned to the one of eight views in which their green correlates best with the
green of the mosaics. Blocks without pictures and METADATA have gains of 1 and show camera colour (``rendered`` is
False). They can test a denoiser, but not an ISP.
"""

from __future__ import annotations

import csv
from abc import abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Generic, TypeVar

import torch
import torch.nn.functional as F
from torch import Tensor

from rawaug import bayer
from rawaug.bayer import CFA
from rawaug.data.development import UNKNOWN_COLOUR, develop_pair
from rawaug.data.frames import Frames
from rawaug.data.mat import read_array, to_raw
from rawaug.data.noise_levels import measure_noise
from rawaug.data.pairs import DATASETS, Pair
from rawaug.data.sidd_scenes import (
    HELD_BACK,
    find_file,
    find_phone,
    index_files,
    matching_files,
    noise_level_functions,
    read_sidd_colour,
)
from rawaug.files import require_file
from rawaug.io import RawFrame

T = TypeVar("T")

LEAST_LIKENESS = 0.8
"""Minimum correlation between the greens of the pictures and of the mosaics of a frame's blocks."""


def turn_like(pictures: Tensor, mosaics: Tensor, cfa: CFA, what: str) -> Tensor:
    """Turn the pictures ``(K, 3, H, W)`` of a frame's blocks to the view of their mosaics ``(K, 1, H, W)``."""
    planes = bayer.pack(mosaics, cfa)
    raw_green = (planes[:, 1] + planes[:, 2]).clamp_min(0.0).sqrt()
    green = F.avg_pool2d(pictures[:, 1:2].float(), 2)[:, 0]

    n_views = bayer.N_VIEWS
    is_square = pictures.shape[-2] == pictures.shape[-1]
    if not is_square:  # quarter turns would change the shape
        n_views //= 2

    likeness = torch.stack([_correlation(bayer.turn_back(green, view), raw_green) for view in range(n_views)])
    best = int(likeness.argmax())
    if likeness[best] < LEAST_LIKENESS:
        raise ValueError(f"{what}: its pictures do not show its RAW blocks (correlation {likeness[best]:.2f})")
    return bayer.turn_back(pictures, best).contiguous()


def _correlation(a: Tensor, b: Tensor) -> Tensor:
    """Correlation of two stacks of images; 1 if one of them is flat."""
    value = torch.corrcoef(torch.stack([a.flatten(), b.flatten()]))[0, 1]
    return torch.where(value.isfinite(), value, torch.ones(()))


BLOCKS = 32
"""Number of blocks of a frame."""


class Once(Generic[T]):
    """A function that calls ``read`` once, and returns its value or raises its error on every call."""

    def __init__(self, read: Callable[[], T]) -> None:
        self.read = read
        self._outcome: T | Exception | None = None

    def __call__(self) -> T:
        if self._outcome is None:
            try:
                self._outcome = self.read()
            except (OSError, ValueError) as error:
                self._outcome = error

        if isinstance(self._outcome, Exception):
            raise self._outcome.with_traceback(None)
        return self._outcome


class _Blocks(Frames[Pair]):
    """Blocks that are all read on the first access; what the blocks of a frame share is cached for the last frame."""

    def __init__(self, path: Path, frames: Sequence[str]) -> None:
        self.path = path
        self._all = Once(self._read_all)
        self._last_frame: tuple[int, RawFrame, dict[str, Tensor], bool] | None = None
        super().__init__(block_names(frames))

    @abstractmethod
    def _read_all(self) -> dict[str, Tensor]:
        """Read ``raw``, ``noisy`` and any pictures, ``srgb`` and ``noisy_srgb``, as ``(frames, 32, C, H, W)``."""

    @abstractmethod
    def _describe(self, number: int, blocks: Tensor) -> RawFrame:
        """Describe the frame with this number, whose mosaics are ``(32, 1, H, W)``; its levels are those of noise."""

    def read(self, index: int) -> Pair:
        number, block = divmod(index, BLOCKS)
        if self._last_frame is None or self._last_frame[0] != number:
            self._last_frame = (number, *self._read_frame(number))
        _, frame, images, is_measured = self._last_frame

        clean = replace(frame, mosaic=images["raw"][block], noise_profile=None)
        noisy = replace(frame, mosaic=images["noisy"][block])
        pictures = {key: images[key][block] for key in ("srgb", "noisy_srgb") if key in images}
        return develop_pair(
            self.names[index],
            clean,
            noisy,
            levels_from_clean=is_measured,
            rendered="srgb" in images or frame.color_known,
            **pictures,
        )

    def _read_frame(self, number: int) -> tuple[RawFrame, dict[str, Tensor], bool]:
        """Read a frame, the images of its blocks, turned alike, and whether its levels were measured on them."""
        images = {}
        for key, stack in self._all().items():
            images[key] = stack[number]

        frame = self._describe(number, images["raw"])
        for key in ("srgb", "noisy_srgb"):
            if key in images:
                images[key] = turn_like(images[key], images["raw"], CFA(frame.cfa), f"{self.path}: {frame.name}")

        is_measured = frame.noise_profile is None
        if is_measured:
            levels = measure_noise(images["raw"].numpy(), images["noisy"].numpy())
            frame = replace(frame, noise_profile=levels)
        return frame, images, is_measured


def block_names(frames: Sequence[str]) -> list[str]:
    """List the names of the blocks of these frames."""
    names = []
    for frame in frames:
        names += [f"{frame}_{block:02d}" for block in range(BLOCKS)]
    return names


class SiddBlocks(_Blocks):
    """The validation blocks, 1,280 pairs; all stay in memory (0.7 GB, pictures 0.5 GB) once the first is read.

    Noise levels come from a ``noise_level_functions.csv`` below the folder that lists the scene instance. Otherwise
    they are measured on the 32 blocks of a frame against the clean blocks.
    """

    def __init__(self, path: str | Path) -> None:
        self.clean_file = find_file(Path(path), "ValidationGtBlocksRaw.mat")
        self.noisy_file = find_file(Path(path), "ValidationNoisyBlocksRaw.mat")
        super().__init__(Path(path), HELD_BACK)

    def _describe(self, number: int, blocks: Tensor) -> RawFrame:
        name = HELD_BACK[number]
        camera, cfa = find_phone(name)
        gains, matrix, _ = self._colours.get(name, (*UNKNOWN_COLOUR, 0))
        return RawFrame(
            blocks,
            cfa,
            white_balance=gains,
            color_matrix=matrix,
            camera=camera,
            noise_profile=self._levels.get(name),
            name=name,
            color_known=name in self._colours,
        )

    def _read_all(self) -> dict[str, Tensor]:
        clean = blocks_of_scenes(self.clean_file)
        noisy = blocks_of_scenes(self.noisy_file)
        _require_same_shape(clean, noisy, self.noisy_file)

        self._levels = noise_level_functions(self.path)
        self._colours = _colours(self.path)
        pictures = _pictures(self.path, "Validation{}BlocksSrgb.mat", ("Gt", "Noisy"), clean)
        return {"raw": clean, "noisy": noisy, **pictures}


@DATASETS.register("siddplus")
class SiddPlusBlocks(_Blocks):
    """The validation blocks of SIDD+, 1,024 pairs, for any split; noise is measured as for :class:`SiddBlocks`."""

    def __init__(self, path: str | Path, split: str = "test") -> None:
        self.clean_file = find_file(Path(path), "siddplus_valid_gt_raw.mat")
        self.noisy_file = find_file(Path(path), "siddplus_valid_noisy_raw.mat")
        self.cfas = _patterns(find_file(Path(path), "siddplus_*bayer_patterns.csv"))
        super().__init__(Path(path), [f"siddplus_{number:02d}" for number in range(len(self.cfas))])

    def _describe(self, number: int, blocks: Tensor) -> RawFrame:
        return RawFrame(blocks, self.cfas[number], camera="SIDD+", name=f"frame {number}", color_known=False)

    def _read_all(self) -> dict[str, Tensor]:
        clean = to_raw(read_array(self.clean_file, self.clean_file.stem), 3, self.clean_file)
        noisy = to_raw(read_array(self.noisy_file, self.noisy_file.stem), 3, self.noisy_file)
        _require_same_shape(clean, noisy, self.noisy_file)
        if len(clean) != len(self):
            raise ValueError(f"{self.clean_file}: has {len(clean)} blocks, but there are patterns for {len(self)}")

        images = {"raw": clean, "noisy": noisy}
        images |= _pictures(self.path, "siddplus_valid_{}_srgb.mat", ("gt", "noisy"), clean)
        for key, stack in images.items():
            images[key] = stack.unflatten(0, (-1, BLOCKS))
        return images


def _pictures(path: Path, pattern: str, kinds: tuple[str, str], clean: Tensor) -> dict[str, Tensor]:
    """Read the uint8 pictures of the clean and noisy blocks, with the axes of ``clean``, as far as the files exist."""
    expected = (*clean.shape[:-3], *clean.shape[-2:], 3)
    pictures = {}
    for key, kind in zip(("srgb", "noisy_srgb"), kinds, strict=True):
        name = pattern.format(kind)
        if not matching_files(path, name):
            continue

        file = find_file(path, name)
        array = read_array(file, file.stem)
        if array.dtype.name != "uint8" or array.shape != expected:
            raise ValueError(f"{file}: holds {array.dtype} {array.shape}; the mosaics need uint8 {expected}")
        pictures[key] = torch.from_numpy(array).movedim(-1, -3)
    return pictures


def _patterns(file: Path) -> list[CFA]:
    """Read the patterns in the first column of a CSV file, one for each frame."""
    require_file(file)
    patterns = []
    try:
        with file.open(encoding="utf-8-sig", newline="") as stream:
            for row in csv.reader(stream):
                if row:
                    patterns.append(CFA(row[0].strip().upper()))
    except (ValueError, csv.Error) as error:
        raise ValueError(f"{file}: is not a list of patterns, one for each frame ({error}); copy it again") from None
    return patterns


def blocks_of_scenes(file: Path) -> Tensor:
    """Read the blocks in a file, ``(40, 32, 1, H, W)``."""
    blocks = to_raw(read_array(file, file.stem), 4, file)
    if blocks.shape[:2] != (len(HELD_BACK), BLOCKS):
        raise ValueError(f"{file}: holds {tuple(blocks.shape[:2])} blocks, the published file {len(HELD_BACK), BLOCKS}")
    return blocks


def _colours(path: Path) -> dict[str, tuple[tuple[float, float, float], Tensor, int]]:
    """Read the colour of each scene instance of the blocks that has a METADATA file below ``path``."""
    files = {}
    for (scene, _), files_of_frame in index_files(path).items():
        if scene in HELD_BACK and "METADATA_RAW" in files_of_frame:
            files[scene] = files_of_frame["METADATA_RAW"]

    colours = {}
    for scene, file in files.items():
        colours[scene] = read_sidd_colour(file)
    return colours


def _require_same_shape(clean: Tensor, noisy: Tensor, file: Path) -> None:
    if clean.shape != noisy.shape:
        raise ValueError(f"{file}: holds {tuple(noisy.shape)}, its clean counterpart {tuple(clean.shape)}")
