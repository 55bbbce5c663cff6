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

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from rawaug.data.mat import read_array
from rawaug.data.pair_folder import clean_pattern, pairs_by_pattern
from rawaug.data.pairs import LazyPairs, centre
from rawaug.data.sidd_scenes import find_file
from rawaug.files import files_below
from rawaug.io.pictures import read_picture
from rawaug.registry import Registry

PICTURE_PAIRS = Registry("kind of picture pairs", "rawaug.picture_pairs", "rawaug.data")
"""The readers of pairs of developed pictures by name: ``reader(folder) -> PicturePairs``, for ``kind:DIR``."""

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


class PicturePairs(LazyPairs):
    """Pairs of developed pictures, read on access.

    Args:
        names: a name for each pair.
        files: the files of each pair, for reports.
        read: a function of a pair's index that returns the noisy and the clean picture, uint8 ``(3, H, W)`` each.
    """

    def __init__(
        self, names: Sequence[str], files: Sequence[Sequence[Path]], read: Callable[[int], tuple[Tensor, Tensor]]
    ) -> None:
        super().__init__(names)
        self._files = files
        self._read = read

    def __iter__(self) -> Iterator[PicturePair]:  # type: ignore[override]
        return map(self.read, range(len(self)))

    def files_of(self, index: int) -> Sequence[Path]:
        return self._files[index]

    def read(self, index: int) -> PicturePair:  # type: ignore[override]
        name = self.names[index]
        noisy, clean = self._read(index)
        if noisy.shape != clean.shape:
            raise ValueError(f"{name}: the noisy picture is {tuple(noisy.shape)}, the clean one {tuple(clean.shape)}")
        return PicturePair(name, noisy, clean)


def is_picture_pairs(spec: str) -> bool:
    """Whether ``spec`` names pairs of developed pictures, as ``cc15:DIR`` does."""
    kind, colon, _ = spec.partition(":")
    return bool(colon) and kind in PICTURE_PAIRS


def open_picture_pairs(spec: str, noisy: str | None = None, clean: str | None = None) -> PicturePairs:
    """Open pairs of developed pictures.

    Args:
        spec: ``kind:DIR``, of one of :data:`PICTURE_PAIRS`.
        noisy, clean: patterns of the files of ``pictures:DIR``, such as ``"*_iso6400.jpg"`` and ``"*_iso100.jpg"``.

    Raises:
        FileNotFoundError: if there is no such folder, or a noisy file lacks its clean one.
        ValueError: if the kind is unknown, or the folder has no pair.
    """
    kind, _, path = spec.partition(":")
    reader = PICTURE_PAIRS[kind]
    patterns = {}
    if noisy is not None or clean is not None:
        patterns = {"noisy": noisy, "clean": clean}
        if kind != "pictures":
            raise ValueError(f"{spec}: noisy and clean are patterns of pictures:DIR; leave them out")

    folder = Path(path)
    if not folder.is_dir():
        raise FileNotFoundError(f"{folder}: no such folder of noisy and clean pictures")
    pairs: PicturePairs = reader(folder, **patterns)
    return pairs


@PICTURE_PAIRS.register("pictures")
def _by_pattern(folder: Path, noisy: str | None = None, clean: str | None = None) -> PicturePairs:
    if noisy is None:
        noisy, clean = "*_noisy.*", "*_clean.*"
    elif clean is None:
        clean = clean_pattern(noisy)
    return _matched(folder, noisy, str(clean))


@PICTURE_PAIRS.register("cc15")
@PICTURE_PAIRS.register("polyu")
def _of_means(folder: Path) -> PicturePairs:
    return _matched(folder, "*_real.*", "*_mean.*")


def _matched(folder: Path, noisy: str, clean: str) -> PicturePairs:
    """Pair the files of a folder by their names."""
    pairs = pairs_by_pattern(folder, sorted(files_below(folder, EXTENSIONS)), noisy, clean)
    if not pairs:
        raise ValueError(f"{folder}: has no pictures named {noisy} and {clean}")
    pairs.sort(key=lambda pair: pair.noisy)

    names, files = [], []
    for pair in pairs:
        names.append(pair.name)
        files.append((pair.noisy, pair.clean))

    def read(index: int) -> tuple[Tensor, Tensor]:
        noisy_file, clean_file = files[index]
        return read_picture(noisy_file), read_picture(clean_file)

    return PicturePairs(names, files, read)


@PICTURE_PAIRS.register("sidd-srgb")
def _blocks(folder: Path) -> PicturePairs:
    arrays = []
    for kind in ("Noisy", "Gt"):
        file = find_file(folder, f"Validation{kind}BlocksSrgb.mat")
        array = read_array(file, file.stem)
        if array.dtype.name != "uint8" or array.ndim != 5 or array.shape[-1] != 3:
            raise ValueError(
                f"{file}: holds {array.dtype} {array.shape}; the published file uint8 (40, 32, 256, 256, 3)"
            )
        arrays.append(torch.from_numpy(array).flatten(0, 1).movedim(-1, 1))
    noisy, clean = arrays

    def read(index: int) -> tuple[Tensor, Tensor]:
        return noisy[index].contiguous(), clean[index].contiguous()

    names = [f"block {number:04d}" for number in range(len(noisy))]
    return PicturePairs(names, [()] * len(names), read)
