"""Pairs of developed pictures from real test sets: a noisy shot, and a clean reference.

- ``cc15:DIR``: ``*_real.*`` beside ``*_mean.*``, the mean of 500 shots. Nam, Hwang, Matsushita and Kim, "A Holistic
  Approach to Cross-Channel Image Noise Modeling and Its Application to Image Denoising", CVPR 2016.
- ``polyu:DIR``: the same names. Xu, Li, Liang, Zhang and Zhang, "Real-world Noisy Image Denoising: A New Benchmark",
  2018.
- ``sidd-srgb:DIR``: ``ValidationNoisyBlocksSrgb.mat`` and ``ValidationGtBlocksSrgb.mat``. Abdelhamed, Lin and Brown, "A
  High-Quality Denoising Dataset for Smartphone Cameras", CVPR 2018.
- ``pictures:DIR``: ``*_noisy.*`` beside ``*_clean.*``, or other patterns.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from rawaug.data.frames import Frames
from rawaug.data.mat import read_array
from rawaug.data.pair_folder import clean_pattern, pairs_by_pattern
from rawaug.data.pairs import DATASETS, centre
from rawaug.data.sidd_scenes import find_file
from rawaug.files import files_below
from rawaug.io.pictures import read_picture
from rawaug.registry import suggest

EXTENSIONS = (".png", ".jpg", ".jpeg", ".tif", ".tiff")
"""Extensions of the pictures of a pair."""


@dataclass(frozen=True, eq=False)
class PicturePair:
    """A shot and its noise-free version, uint8 sRGB ``(3, H, W)`` each."""

    name: str
    noisy: Tensor
    clean: Tensor

    def middle(self, crop: int) -> PicturePair:
        """Crop the middle of both pictures, ``crop x crop``."""
        noisy = centre(self.noisy, crop, crop, step=1)
        clean = centre(self.clean, crop, crop, step=1)
        return PicturePair(self.name, noisy, clean)

    def binned(self, factor: int, together: bool = False) -> PicturePair:
        """Return this pair unchanged: binning would average its real noise."""
        return self

    def with_own_noise(self, estimate: Callable[..., Any]) -> PicturePair:
        """Return this pair unchanged: the noise of developed pictures has no levels."""
        return self


class PicturePairs(Frames[PicturePair]):
    """Pairs of developed pictures, read on access: the base class of readers registered in :data:`DATASETS`.

    Args:
        names: a name for each pair.
        files: the noisy and the clean file of each pair; empty for pairs that :meth:`load` takes from elsewhere.
    """

    def __init__(self, names: Sequence[str], files: Sequence[Sequence[Path]]) -> None:
        super().__init__(names)
        self._files = files

    def load(self, index: int) -> tuple[Tensor, Tensor]:
        """Load the noisy and the clean picture of a pair, uint8 ``(3, H, W)`` each."""
        noisy, clean = self._files[index]
        return read_picture(noisy), read_picture(clean)

    def frame_files(self, index: int) -> Sequence[Path]:
        return self._files[index]

    def read(self, index: int) -> PicturePair:
        name = self.names[index]
        noisy, clean = self.load(index)
        if noisy.shape != clean.shape:
            raise ValueError(f"{name}: the noisy picture is {tuple(noisy.shape)}, the clean one {tuple(clean.shape)}")
        return PicturePair(name, noisy, clean)


def is_picture_pairs(spec: str) -> bool:
    """Whether ``spec`` names pairs of developed pictures, as ``cc15:DIR`` does."""
    kind, colon, _ = spec.partition(":")
    if not colon or kind not in DATASETS:
        return False

    reader = DATASETS[kind]
    return isinstance(reader, type) and issubclass(reader, PicturePairs)


def open_picture_pairs(spec: str, noisy: str | None = None, clean: str | None = None) -> PicturePairs:
    """Open pairs of developed pictures.

    Args:
        spec: ``kind:DIR``, whose kind is a subclass of :class:`PicturePairs` in :data:`DATASETS`.
        noisy, clean: patterns of the files of ``pictures:DIR``, such as ``"*_iso6400.jpg"`` and ``"*_iso100.jpg"``.

    Raises:
        FileNotFoundError: if there is no such folder, or a noisy file lacks its clean one.
        ValueError: if the kind is unknown, or the folder has no pair.
    """
    kind, _, path = spec.partition(":")
    if not is_picture_pairs(spec):
        raise ValueError(f"{spec}: no such kind of picture pairs; use pictures:DIR{suggest(kind, DATASETS)}")

    patterns = {}
    if noisy is not None or clean is not None:
        patterns = {"noisy": noisy, "clean": clean}
        if kind != "pictures":
            raise ValueError(f"{spec}: noisy and clean are patterns of pictures:DIR; leave them out")

    folder = Path(path)
    if not folder.is_dir():
        raise FileNotFoundError(f"{folder}: no such folder of noisy and clean pictures")
    pairs: PicturePairs = DATASETS[kind](path, **patterns)
    return pairs


@DATASETS.register("pictures")
class NamedPictures(PicturePairs):
    """The files of a folder, paired by their names.

    Args:
        path: the folder.
        split: has no effect, since there is only one.
        noisy: the pattern of the names of noisy files.
        clean: the pattern of clean files; None for the one that belongs to ``noisy``.
    """

    def __init__(self, path: str, split: str = "test", noisy: str | None = None, clean: str | None = None) -> None:
        if noisy is None:
            noisy, clean = "*_noisy.*", "*_clean.*"
        elif clean is None:
            clean = clean_pattern(noisy)

        folder = Path(path)
        pairs = pairs_by_pattern(folder, sorted(files_below(folder, EXTENSIONS)), noisy, str(clean))
        if not pairs:
            raise ValueError(f"{folder}: has no pictures named {noisy} and {clean}")
        pairs.sort(key=lambda pair: pair.noisy)

        names = []
        files = []
        for pair in pairs:
            names.append(pair.name)
            files.append((pair.noisy, pair.clean))
        super().__init__(names, files)


@DATASETS.register("cc15")
@DATASETS.register("polyu")
class MeanPictures(NamedPictures):
    """Shots ``*_real.*``, and the means of many shots ``*_mean.*``."""

    def __init__(self, path: str, split: str = "test") -> None:
        super().__init__(path, split, "*_real.*", "*_mean.*")


@DATASETS.register("sidd-srgb")
class SiddPictures(PicturePairs):
    """SIDD's validation blocks of developed pictures, in the order of the published file."""

    def __init__(self, path: str, split: str = "test") -> None:
        self._noisy = _blocks(Path(path), "Noisy")
        self._clean = _blocks(Path(path), "Gt")
        names = [f"block {number:04d}" for number in range(len(self._noisy))]
        super().__init__(names, [()] * len(names))

    def load(self, index: int) -> tuple[Tensor, Tensor]:
        return self._noisy[index].contiguous(), self._clean[index].contiguous()


def _blocks(folder: Path, kind: str) -> Tensor:
    """Read the blocks of one of SIDD's files, uint8 ``(1280, 3, 256, 256)``."""
    file = find_file(folder, f"Validation{kind}BlocksSrgb.mat")
    array = read_array(file, file.stem)
    if array.dtype.name != "uint8" or array.ndim != 5 or array.shape[-1] != 3:
        raise ValueError(f"{file}: holds {array.dtype} {array.shape}; the published file uint8 (40, 32, 256, 256, 3)")

    return torch.from_numpy(array).flatten(0, 1).movedim(-1, 1)
