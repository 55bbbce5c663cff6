"""Pairs of developed pictures: a noisy shot, and what it would be without noise, as real test sets have them.

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

from rawaug.data.formats import read_array
from rawaug.data.pair_folder import clean_pattern, pairs_by_pattern
from rawaug.data.pairs import LazyPairs, centre
from rawaug.data.sidd import find_file
from rawaug.files import files_below
from rawaug.io.pictures import read_picture
from rawaug.registry import suggest

EXTENSIONS = (".png", ".jpg", ".jpeg", ".tif", ".tiff")
_NAMES = {"cc15": ("*_real.*", "*_mean.*"), "polyu": ("*_real.*", "*_mean.*"), "pictures": ("*_noisy.*", "*_clean.*")}
_BLOCKS = "sidd-srgb"
KINDS = (*_NAMES, _BLOCKS)
"""The datasets of :func:`open_picture_pairs`."""


@dataclass(frozen=True, eq=False)
class PicturePair:
    """A shot and its noise-free version, uint8 sRGB ``(3, H, W)`` each."""

    name: str
    noisy: Tensor
    clean: Tensor

    def middle(self, crop: int) -> PicturePair:
        """The middle of both, ``crop x crop``."""
        return PicturePair(self.name, *(centre(x, crop, crop, step=1) for x in (self.noisy, self.clean)))


class PicturePairs(LazyPairs):
    """Pairs that are read when they are asked for."""

    def __init__(
        self, names: Sequence[str], files: Sequence[Sequence[Path]], read: Callable[[int], tuple[Tensor, Tensor]]
    ) -> None:
        super().__init__(names)
        self._files, self._read = files, read

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
    return spec.partition(":")[0] in KINDS and ":" in spec


def open_picture_pairs(spec: str, noisy: str | None = None, clean: str | None = None) -> PicturePairs:
    """Open pairs of developed pictures.

    Args:
        spec: ``kind:DIR``, of one of :data:`KINDS`.
        noisy, clean: patterns of the files of ``pictures:DIR``, such as ``"*_iso6400.jpg"`` and ``"*_iso100.jpg"``.

    Raises:
        FileNotFoundError: if there is no such folder, or a noisy file lacks its clean one.
        ValueError: if the kind is unknown, or the folder has no pair.
    """
    kind, _, path = spec.partition(":")
    if kind not in KINDS:
        raise ValueError(f"{spec}: no such pairs of pictures; use one of {', '.join(KINDS)}{suggest(kind, KINDS)}")
    if (noisy or clean) and kind != "pictures":
        raise ValueError(f"{spec}: noisy and clean are patterns of pictures:DIR; omit them")
    folder = Path(path)
    if not folder.is_dir():
        raise FileNotFoundError(f"{folder}: no such folder of noisy and clean pictures")
    if kind == _BLOCKS:
        return _blocks(folder)
    first, second = _NAMES[kind] if noisy is None else (noisy, clean or clean_pattern(noisy))
    found = pairs_by_pattern(folder, sorted(files_below(folder, EXTENSIONS)), first, second)
    if not found:
        raise ValueError(f"{folder}: has no pictures named {first} and {second}")
    found.sort(key=lambda pair: pair.noisy)
    files = [(pair.noisy, pair.clean) for pair in found]
    return PicturePairs(
        [pair.name for pair in found], files, lambda k: (read_picture(files[k][0]), read_picture(files[k][1]))
    )


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
    names = [f"block {number:04d}" for number in range(len(noisy))]
    return PicturePairs(names, [()] * len(names), lambda k: (noisy[k].contiguous(), clean[k].contiguous()))
