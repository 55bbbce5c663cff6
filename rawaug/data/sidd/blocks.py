"""SIDD's blocks of 256 x 256: validation, benchmark and its submission, and those of SIDD+ (NTIRE 2020).

``ValidationNoisyBlocksRaw.mat``, ``ValidationGtBlocksRaw.mat`` and ``BenchmarkNoisyBlocksRaw.mat`` hold an array of the
same name, (40 scene instances, 32 blocks, rows, columns), black at 0, white at 1, whose patterns go by the phone of
:data:`rawaug.data.sidd.frames.HELD_BACK`. SIDD+ holds (1024, rows, columns), 32 blocks a frame, with the pattern of
each frame in a line of ``siddplus_*bayer_patterns.csv``.

Pictures are read from ``ValidationGtBlocksSrgb.mat`` and ``ValidationNoisyBlocksSrgb.mat`` (SIDD+:
``siddplus_valid_gt_srgb.mat``), uint8 (scene instances, blocks, rows, columns, RGB), where these are below the same
folder. SIDD turns its pictures upright and not its mosaics, and these files do not say how: of the eight turns, a
frame's blocks take the one in which their green agrees best with the green of the mosaics. Gains and colour matrix are
those of METADATA files. Where there is neither, the gains are 1, the matrix is the identity, the picture shows camera
colour, and the pair says so (``rendered`` is False): it can test a denoiser, but no ISP.

A submission is a CSV with the columns ID (0 to 1279, block by block, frame by frame) and BLOCK (the bytes of the
float32 block, row by row, in base64), or ``SubmitRaw.mat`` of version 5 with the array ``SubmitRaw`` (40, 32, 256,
256). Source: the example code of the dataset's first author, ``sidd_kaggle_submit``.
"""

from __future__ import annotations

import base64
import csv
import sys
from abc import abstractmethod
from collections.abc import Callable, Iterable, Sequence
from fnmatch import fnmatchcase
from functools import partial
from pathlib import Path
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from rawaug import bayer
from rawaug.bayer import CFA
from rawaug.data.development import develop_mosaic
from rawaug.data.folders import files_below
from rawaug.data.mat import normalised, read_array
from rawaug.data.pairs import Lazy, LazyPairs, NoisyBlock, Pair, captured_noise
from rawaug.data.sidd.frames import (
    HELD_BACK,
    Colour,
    SiddFrames,
    SiddScene,
    colour_of,
    indexed,
    noise_level_functions,
)
from rawaug.registry import DATASETS

LEAST_LIKENESS = 0.8
"""Correlation of the greens below which pictures do not show the blocks of the mosaics."""


def turned_like(pictures: Tensor, mosaics: Tensor, cfa: CFA, what: str) -> Tensor:
    """The pictures ``(K, 3, H, W)`` of a frame's blocks, turned as their mosaics ``(K, 1, H, W)`` are."""
    square = pictures.shape[-2] == pictures.shape[-1]
    views = range(bayer.N_VIEWS if square else bayer.N_VIEWS // 2)
    planes = bayer.pack(mosaics, cfa)
    raw = (planes[:, 1] + planes[:, 2]).clamp_min(0.0).sqrt()
    green = F.avg_pool2d(pictures[:, 1:2].float(), 2)[:, 0]
    likeness = torch.stack([_correlation(bayer.turn_back(green, view), raw) for view in views])
    best = int(likeness.argmax())
    if likeness[best] < LEAST_LIKENESS:
        raise ValueError(f"{what}: its pictures do not show its RAW blocks (correlation {likeness[best]:.2f})")
    return bayer.turn_back(pictures, best).contiguous()


def _correlation(a: Tensor, b: Tensor) -> Tensor:
    """Correlation of two stacks of images; 1 if one of them is flat."""
    value = torch.corrcoef(torch.stack([a.flatten(), b.flatten()]))[0, 1]
    return torch.where(value.isfinite(), value, torch.ones(()))


BLOCKS = 32
"""Blocks of a frame."""

MOST_FRAMES = 1000
"""Of SIDD+, which has 32."""

T = TypeVar("T")

_NO_COLOUR = Colour((1.0, 1.0, 1.0), torch.eye(3), 0)


class Once(Generic[T]):
    """Calls ``read`` once and keeps its value or its error."""

    def __init__(self, read: Callable[[], T]) -> None:
        self.read = read
        self.value: T | None = None
        self.fault: Exception | None = None

    def __call__(self) -> T:
        if self.fault is not None:
            raise self.fault.with_traceback(None)
        if self.value is None:
            try:
                self.value = self.read()
            except (OSError, ValueError) as error:
                self.fault = error
                raise
        return self.value


class _Known(NamedTuple):
    """What is stated of a frame: published levels, and its colour, if there are any."""

    name: str
    cfa: CFA
    camera: str
    levels: tuple[float, float] | None = None
    colour: Colour | None = None


class _Blocks(LazyPairs):
    """Blocks, read all at once; what the 32 blocks of a frame share is kept for the last frame."""

    def __init__(self, path: Path, frames: Sequence[str]) -> None:
        self.path = path
        self._all = Once(self._read_all)
        self._frame: tuple[int, dict[str, Tensor], dict[str, Any]] | None = None
        super().__init__([f"{name}_{block:02d}" for name in frames for block in range(BLOCKS)])

    @abstractmethod
    def _read_all(self) -> dict[str, Tensor]:
        """``raw``, ``noisy`` and, where there are pictures, ``srgb`` and ``noisy_srgb``, ``(frames, 32, C, H, W)``."""

    @abstractmethod
    def _known(self, number: int) -> _Known:
        """Of a frame."""

    def read(self, index: int) -> Pair:
        number, block = divmod(index, BLOCKS)
        if self._frame is None or self._frame[0] != number:
            self._frame = number, *self._shared(number)
        _, images, shared = self._frame
        known: dict[str, Any] = {key: image[block] for key, image in images.items()} | shared
        if "srgb" not in images:
            colours = known["white_balance"], known["color_matrix"]
            known["srgb"] = develop_mosaic(known["raw"], known["cfa"], *colours)
        return Pair(self.names[index], **known)

    def _shared(self, number: int) -> tuple[dict[str, Tensor], dict[str, Any]]:
        """The images of a frame's blocks, turned alike, and what else of a :class:`Pair` they share."""
        images, known = {key: every[number] for key, every in self._all().items()}, self._known(number)
        for key in {"srgb", "noisy_srgb"} & images.keys():
            images[key] = turned_like(images[key], images["raw"], known.cfa, f"{self.path}: {known.name}")
        shot_var, read_var = known.levels or captured_noise(images["raw"].numpy(), images["noisy"].numpy())
        gains, matrix, _ = known.colour or _NO_COLOUR
        return images, {
            "cfa": known.cfa,
            "camera": known.camera,
            "white_balance": gains,
            "color_matrix": matrix,
            "shot_var": shot_var,
            "read_var": read_var,
            "levels_from_clean": known.levels is None,
            "color_known": known.colour is not None,
            "rendered": "srgb" in images or known.colour is not None,
        }


class SiddBlocks(_Blocks):
    """The validation blocks, 1,280 pairs; all stay in memory (0.7 GB, pictures 0.5 GB) once the first is read.

    Noise levels are those of a ``noise_level_functions.csv`` if there is one below the folder with the scene
    instance, else measured on the 32 blocks of a frame against the clean ones.

    Args:
        path: contains ``ValidationNoisyBlocksRaw.mat`` and ``ValidationGtBlocksRaw.mat``, at any depth.
    """

    def __init__(self, path: str | Path) -> None:
        self.files = [find_file(Path(path), f"Validation{kind}BlocksRaw.mat") for kind in ("Gt", "Noisy")]
        super().__init__(Path(path), HELD_BACK)

    def _known(self, number: int) -> _Known:
        shot = SiddScene.parse(HELD_BACK[number])
        return _Known(shot.name, shot.cfa, shot.camera, self._levels.get(shot.name), self._colours.get(shot.name))

    def _read_all(self) -> dict[str, Tensor]:
        clean, noisy = (_blocks_of_scenes(file) for file in self.files)
        _require_same_shape(clean, noisy, self.files[1])
        self._levels = noise_level_functions(self.path)
        self._colours = _colours(self.path)
        pictures = _pictures(self.path, "Validation{}BlocksSrgb.mat", ("Gt", "Noisy"), clean)
        return {"raw": clean, "noisy": noisy, **pictures}


class SiddPlusBlocks(_Blocks):
    """The validation blocks of SIDD+, 1,024 pairs; noise levels are measured as for :class:`SiddBlocks`.

    Args:
        path: contains ``siddplus_valid_noisy_raw.mat``, ``siddplus_valid_gt_raw.mat`` and a
            ``siddplus_*bayer_patterns.csv`` with a pattern for each frame of 32 blocks, at any depth; pictures in
            ``siddplus_valid_gt_srgb.mat`` and ``siddplus_valid_noisy_srgb.mat``, if there are any.
    """

    def __init__(self, path: str | Path) -> None:
        self.files = [find_file(Path(path), f"siddplus_valid_{kind}_raw.mat") for kind in ("gt", "noisy")]
        self.cfas = _patterns(find_file(Path(path), "siddplus_*bayer_patterns.csv"))
        super().__init__(Path(path), [f"siddplus_{k:02d}" for k in range(len(self.cfas))])

    def _known(self, number: int) -> _Known:
        return _Known(f"frame {number}", self.cfas[number], "SIDD+")

    def _read_all(self) -> dict[str, Tensor]:
        clean, noisy = (normalised(read_array(file, file.stem), 3, file) for file in self.files)
        _require_same_shape(clean, noisy, self.files[1])
        if len(clean) != len(self):
            raise ValueError(f"{self.files[0]}: has {len(clean)} blocks, but there are patterns for {len(self)}")
        pictures = _pictures(self.path, "siddplus_valid_{}_srgb.mat", ("gt", "noisy"), clean)
        images = {"raw": clean, "noisy": noisy, **pictures}
        return {key: every.unflatten(0, (-1, BLOCKS)) for key, every in images.items()}


class SiddBenchmark(Lazy[NoisyBlock]):
    """The benchmark's noisy blocks, whose clean ones are not public; results go to :func:`write_submission`.

    Args:
        path: contains ``BenchmarkNoisyBlocksRaw.mat``, at any depth, and ``noise_level_functions.csv`` if there is one.

    Raises:
        FileNotFoundError: if the blocks are not there.

    Example:
        >>> blocks = SiddBenchmark("SIDD_Benchmark")  # doctest: +SKIP
        >>> write_submission("SubmitRaw.csv", (denoise(b.mosaic, b.cfa) for b in blocks))  # doctest: +SKIP
    """

    def __init__(self, path: str | Path) -> None:
        self.levels = noise_level_functions(Path(path))
        self._all = Once(partial(_blocks_of_scenes, find_file(Path(path), "BenchmarkNoisyBlocksRaw.mat")))
        super().__init__([f"{scene}_{block:02d}" for scene in HELD_BACK for block in range(BLOCKS)])

    def read(self, index: int) -> NoisyBlock:
        scene, block = divmod(index, BLOCKS)
        cfa, levels = SiddScene.parse(HELD_BACK[scene]).cfa, self.levels.get(HELD_BACK[scene])
        return NoisyBlock(self.names[index], self._all()[scene, block], cfa, levels)


@DATASETS.register("sidd")
def sidd_pairs(path: str, split: str) -> Sequence[Pair]:
    """The full frames (``train``) or the validation blocks (``test``)."""
    if split == "train":
        return SiddFrames(path)
    if split == "test":
        return SiddBlocks(path)
    raise ValueError(
        f"sidd:{path}: no split {split}; use train (full frames) or test (validation blocks), "
        "and another folder, or null, for validation"
    )


@DATASETS.register("sidd-cc")
def sidd_cc_pairs(path: str, split: str) -> Sequence[Pair]:
    """The full frames of SIDD-CC's own ``train``, in the layout of SIDD Medium, their clean RAW estimated anew.

    Source: <https://huggingface.co/datasets/MhdMohammadi/SIDD-CC>.
    """
    if split != "train":
        raise ValueError(f"sidd-cc:{path}: no split {split}; use train; its test blocks are not read")
    return SiddFrames(path, left_out=())


@DATASETS.register("siddplus")
def siddplus_pairs(path: str, split: str) -> Sequence[Pair]:
    """The validation blocks of SIDD+, whatever the split."""
    return SiddPlusBlocks(path)


def find_file(path: Path, pattern: str) -> Path:
    """The one file of this name below ``path``, or ``path`` itself."""
    found = [path] if path.is_file() and path.match(pattern) else _matching(path, pattern)
    if not found:
        raise FileNotFoundError(f"{path}: contains no {pattern}; docs/datasets.md says where to get it")
    if len(found) > 1:
        raise ValueError(
            f"{path}: contains {len(found)} files {pattern}, such as {found[0]} and {found[1]}; give a folder with one"
        )
    return found[0]


def _matching(folder: Path, pattern: str) -> list[Path]:
    return sorted(file for file in files_below(folder) if fnmatchcase(file.name, pattern))


def _pictures(path: Path, pattern: str, kinds: tuple[str, str], clean: Tensor) -> dict[str, Tensor]:
    """Pictures uint8 of the clean and noisy blocks, with the axes of ``clean``, as far as their files exist."""
    found, expected = {}, (*clean.shape[:-3], *clean.shape[-2:], 3)
    for key, kind in zip(("srgb", "noisy_srgb"), kinds, strict=True):
        if not _matching(path, name := pattern.format(kind)):
            continue
        file = find_file(path, name)
        array = read_array(file, file.stem)
        if array.dtype.name != "uint8" or array.shape != expected:
            raise ValueError(f"{file}: holds {array.dtype} {array.shape}; the mosaics need uint8 {expected}")
        found[key] = torch.from_numpy(array).movedim(-1, -3)
    return found


def _patterns(file: Path) -> list[CFA]:
    """A pattern for each frame of 32 blocks."""
    try:
        with file.open(encoding="utf-8-sig", newline="") as stream:
            names = [row[0].strip().upper() for row in csv.reader(stream) if row]
        if len(names) > MOST_FRAMES:
            raise ValueError(f"{len(names)} rows, at most {MOST_FRAMES} expected")
        return [CFA(name) for name in names]
    except (ValueError, csv.Error) as error:
        raise ValueError(f"{file}: is not a list of patterns, one for each frame ({error}); copy it again") from None


def _blocks_of_scenes(file: Path) -> Tensor:
    """``(40, 32, 1, H, W)``."""
    blocks = normalised(read_array(file, file.stem), 4, file)
    if blocks.shape[:2] != (len(HELD_BACK), BLOCKS):
        raise ValueError(f"{file}: holds {tuple(blocks.shape[:2])} blocks, the published file {len(HELD_BACK), BLOCKS}")
    return blocks


def _colours(path: Path) -> dict[str, Colour]:
    files = {scene: found["METADATA_RAW"] for (scene, _), found in indexed(path).items() if "METADATA_RAW" in found}
    return {scene: colour_of(file) for scene, file in files.items() if scene in HELD_BACK}


def _require_same_shape(clean: Tensor, noisy: Tensor, file: Path) -> None:
    if clean.shape != noisy.shape:
        raise ValueError(f"{file}: holds {tuple(noisy.shape)}, its clean counterpart {tuple(clean.shape)}")


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
