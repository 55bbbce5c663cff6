r"""RAW-sRGB pairs: one shot, sequences that read it when asked, which of them a recipe uses, and their noise.

A frame is identified by the resolved paths of its files where it has some, else by its name: what is trained on must
not be scored, and no frame has to be read to know. A dataset that knows more of its frames has ``labels``.

The noise levels of a capture whose clean version is known,

    E[(noisy - clean)^2 | clean = y] = shot_var y + read_var,

are those of a line through the mean squared differences of equally filled bins of y, weighted by the inverse variance
of these means, 2 (shot_var y + read_var)^2 / n, in a few rounds. Bins whose noise would reach black or white (three
standard deviations) are left out while enough others remain: published frames are clipped there, which narrows the
noise.
"""

from __future__ import annotations

import os
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from itertools import accumulate, groupby
from pathlib import Path
from typing import Any, Generic, NamedTuple, TypeVar, overload

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from rawaug.bayer import CFA, bin_mosaic, bin_mosaic_variance, crop_to_cfa, to_bayer
from rawaug.files import digest
from rawaug.io import RawFrame
from rawaug.io.pictures import MAX_PIXELS, decode_srgb, encode_srgb
from rawaug.registry import Registry

T = TypeVar("T")

DATASETS = Registry("kind of data", "rawaug.datasets", "rawaug.data")
"""The readers of pairs by name: ``reader(path, split) -> Sequence[Pair]``, for ``kind:path``."""

PICTURES = Registry("kind of pictures", "rawaug.pictures", "rawaug.data")
"""The readers of pictures by name: ``reader(path, min_side)`` returns a sequence of sRGB ``(3, H, W)``."""


@dataclass(frozen=True)
class Pair:
    """One shot, RAW and sRGB.

    Attributes:
        name: of the shot, for reports.
        srgb: uint8 ``(3, H, W)``, in the sensor's orientation.
        raw: the clean mosaic, float32 ``(1, H, W)``, black 0, white 1, sides even.
        cfa: the pattern of ``raw`` and ``noisy``.
        white_balance: as-shot multipliers of R, G, B, green being 1; all 1 where they are not known.
        color_matrix: float32 ``(3, 3)``, white-balanced camera colour to linear sRGB, rows summing to 1.
        noisy: a noisy mosaic of the same scene, like ``raw``, where one was captured.
        shot_var, read_var: the levels of ``noisy``: its variance is shot_var * raw + read_var.
        camera: make and model.
        iso: None if unknown.
        registered: whether ``srgb`` and ``raw`` agree pixel for pixel. A camera's own JPEG is corrected for its lens:
            compare it at a much lower resolution only.
        rendered: whether ``srgb`` is a rendering in the camera's colours. False: gains and matrix are unknown, and
            ``srgb`` merely displays the RAW, so that no ISP can be fitted to it or scored on it.
        noisy_srgb: the camera's picture of ``noisy``, like ``srgb``, where there is one.
        levels_from_clean: whether ``shot_var`` and ``read_var`` were measured against ``raw``, which a denoiser that is
            tested must not know.
        own_noise: (shot_var, read_var) of the noise that ``raw`` itself has, where it was measured.
        color_known: whether ``white_balance`` and ``color_matrix`` are the camera's; without them no ISP can be fitted.

    Raises:
        ValueError: if shapes or dtypes disagree, a side is odd, or levels come without the other or without ``noisy``.
    """

    name: str
    srgb: Tensor
    raw: Tensor
    cfa: CFA
    white_balance: tuple[float, float, float] = (1.0, 1.0, 1.0)
    color_matrix: Tensor = field(default_factory=lambda: torch.eye(3))
    noisy: Tensor | None = None
    shot_var: float | None = None
    read_var: float | None = None
    camera: str = "unknown"
    registered: bool = True
    rendered: bool = True
    noisy_srgb: Tensor | None = None
    levels_from_clean: bool = False
    color_known: bool = True
    iso: float | None = None
    own_noise: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "cfa", CFA(self.cfa))  # or its name
        self._require_shape("srgb", self.srgb, 3, torch.uint8)
        self._require_shape("raw", self.raw, 1, torch.float32)
        if self.noisy is not None:
            self._require_shape("noisy", self.noisy, 1, torch.float32)
        if self.noisy_srgb is not None:
            self._require_shape("noisy_srgb", self.noisy_srgb, 3, torch.uint8)
        if any(side % 2 or side == 0 for side in self.raw.shape[-2:]):
            raise ValueError(f"pair {self.name}: the mosaic must have even sides, got {tuple(self.raw.shape)}")
        if self.color_matrix.shape != (3, 3):
            raise ValueError(f"pair {self.name}: color_matrix must be (3, 3), got {tuple(self.color_matrix.shape)}")
        if (self.shot_var is None) != (self.read_var is None) or (self.noisy is None and self.shot_var is not None):
            raise ValueError(f"pair {self.name}: shot_var and read_var must be given together, with a noisy mosaic")

    @classmethod
    def of_frame(cls, name: str, frame: RawFrame, srgb: Tensor, **known: Any) -> Pair:
        """Make the pair of a RAW file and its picture, with further attributes that are ``known``.

        A mosaic of another pattern than Bayer's becomes one of RGGB at half its sides.
        """
        mosaic, cfa = frame.mosaic, frame.cfa
        if cfa not in CFA.__members__:
            mosaic, cfa = to_bayer(mosaic, cfa), CFA.RGGB
            height, width = mosaic.shape[-2:]
            srgb = _bin_picture(srgb[:, : 2 * height, : 2 * width], 2)
        stated = (mosaic, CFA(cfa), frame.white_balance, frame.color_matrix)
        return cls(name, srgb, *stated, camera=frame.camera, iso=frame.iso, **known)

    @property
    def balance_known(self) -> bool:
        return self.white_balance != (1.0, 1.0, 1.0)

    def with_levels(self) -> Pair:
        """This pair, with levels measured against ``raw`` if the capture states none."""
        if self.noisy is None or self.shot_var is not None:
            return self
        shot_var, read_var = measure_levels(self.raw, self.noisy)
        return replace(self, shot_var=shot_var, read_var=read_var, levels_from_clean=True)

    def require_rendered(self) -> None:
        if not self.rendered:
            raise ValueError(
                f"{self.name}: has no sRGB picture, and its white balance and colour matrix are unknown; "
                "put the dataset's sRGB files or METADATA beside its RAW (docs/datasets.md)"
            )

    def in_pattern(self, cfa: CFA | str) -> Pair:
        """The frame without its outer rows or columns, where that gives it the pattern ``cfa``."""
        target = CFA(cfa)
        if target == self.cfa:
            return self
        return self._changed(lambda image: crop_to_cfa(image, self.cfa, target).contiguous(), cfa=target)

    def middle(self, side: int) -> Pair:
        """The middle ``side x side`` of the frame, or all of it along a side that is shorter; the CFA is kept."""
        return self._changed(lambda image: centre(image, side // 2 * 2, side // 2 * 2))

    def binned(self, factor: int, together: bool = False) -> Pair:
        """The frame at 1 / ``factor`` of its sides, whose noise has about 1 / ``factor``^2 of the variance.

        RAW by :func:`rawaug.bayer.bin_mosaic`, which explains ``together``; pictures are averaged in linear light.

        Raises:
            ValueError: if a side is shorter than two of the new cell's.
        """
        if factor == 1 and not together:
            return self
        height, width = (side // (2 * factor) * 2 * factor for side in self.raw.shape[-2:])
        if not min(height, width):
            raise ValueError(f"pair {self.name}: {tuple(self.raw.shape[-2:])} is too small to be binned by {factor}")
        levels: dict[str, Any] = {}
        left = bin_mosaic_variance(factor, together)
        if self.shot_var is not None and self.read_var is not None:
            levels |= {"shot_var": self.shot_var * left, "read_var": self.read_var * left}
        if self.own_noise is not None:
            levels["own_noise"] = (self.own_noise[0] * left, self.own_noise[1] * left)

        def binned(image: Tensor) -> Tensor:
            cut = image[:, :height, :width]
            return bin_mosaic(cut, self.cfa, factor, together) if len(cut) == 1 else _bin_picture(cut, factor)

        return self._changed(binned, **levels)

    def _changed(self, change: Callable[[Tensor], Tensor], **known: Any) -> Pair:
        """Copy the pair with every image changed, and attributes that are ``known`` besides."""
        for key in ("srgb", "raw", "noisy", "noisy_srgb"):
            if (image := getattr(self, key)) is not None:
                known[key] = change(image)
        return replace(self, **known)

    def _require_shape(self, field: str, image: Tensor, channels: int, dtype: torch.dtype) -> None:
        expected = (channels, *self.raw.shape[-2:])
        if tuple(image.shape) != expected or image.dtype != dtype:
            got = f"{image.dtype} {tuple(image.shape)}"
            raise ValueError(f"pair {self.name}: {field} must be {dtype} {expected}, got {got}")


def centre(image: Tensor, height: int, width: int, step: int = 2) -> Tensor:
    """The middle of ``(..., H, W)``, or all of it along a side that is shorter.

    It begins at a multiple of ``step``: 2 keeps the pattern of a mosaic, 1 is that of packed RAW.
    """
    sides = zip(image.shape[-2:], (height, width), strict=True)
    top, left = (max(0, size - side) // (2 * step) * step for size, side in sides)
    return image[..., top : top + height, left : left + width].contiguous()


def _bin_picture(srgb: Tensor, factor: int) -> Tensor:
    """uint8 ``(3, H, W)``, averaged in linear light."""
    linear = F.avg_pool2d(decode_srgb(srgb.float() / 255), factor)
    return (encode_srgb(linear) * 255).round().to(torch.uint8)


class Sample(NamedTuple):
    """A training sample of a denoiser, packed ``(4, h, w)``, or a batch of them, ``(B, 4, h, w)``."""

    noisy: Tensor
    clean: Tensor
    variance: Tensor


class FrameLabel(NamedTuple):
    """The scene that a frame shows, the phone that took it, and its ISO."""

    scene: str
    phone: str
    iso: int


class Lazy(Sequence[T], ABC, Generic[T]):
    """A sequence of named items that reads one at a time; the last one stays in memory."""

    def __init__(self, names: Sequence[str]) -> None:
        self.names = list(names)
        self._last: tuple[int, T] | None = None

    @abstractmethod
    def read(self, index: int) -> T:
        """The item at ``index`` in [0, len)."""

    def __len__(self) -> int:
        return len(self.names)

    @overload
    def __getitem__(self, index: int) -> T: ...

    @overload
    def __getitem__(self, index: slice) -> list[T]: ...

    def __getitem__(self, index: int | slice) -> T | list[T]:
        if isinstance(index, slice):
            return [self[i] for i in range(len(self))[index]]
        index = range(len(self))[index]
        if self._last is None or self._last[0] != index:
            self._last = index, self.read(index)
        return self._last[1]


class LazyPairs(Lazy[Pair]):
    """Pairs, read when they are asked for."""

    max_pixels: int = MAX_PIXELS
    """Maximum number of pixels of sRGB pictures and of mosaics in PNG files."""
    labels: Sequence[FrameLabel] = ()
    """The labels of the frames, if the dataset knows them without reading a frame."""

    def files_of(self, index: int) -> Sequence[Path]:
        """The files that identify a pair; none where its name does."""
        return ()

    def stamp(self, index: int) -> str:
        """Identify the content of a pair by the path, size and modification time of its files, or by its name."""
        files = [f"{os.path.realpath(f)} {f.stat().st_size} {f.stat().st_mtime_ns}" for f in self.files_of(index)]
        return " ".join(files) or self.names[index]


class _InMemory(LazyPairs):
    def __init__(self, pairs: Sequence[Pair]) -> None:
        self.pairs = pairs
        super().__init__([pair.name for pair in pairs])

    def read(self, index: int) -> Pair:
        return self.pairs[index]

    def stamp(self, index: int) -> str:
        pair = self.pairs[index]
        known = repr((pair.name, pair.camera, pair.cfa, pair.white_balance, pair.raw.shape)).encode()
        images = [image for image in (pair.srgb, pair.raw, pair.noisy) if image is not None]
        return digest(known, *(image.flatten()[::4099].numpy().tobytes() for image in images))[:16]


def lazy(pairs: Sequence[Pair]) -> LazyPairs:
    """The pairs as ones whose names and files are known without reading them."""
    return pairs if isinstance(pairs, LazyPairs) else _InMemory(pairs)


def names_of(pairs: Sequence[Pair]) -> list[str]:
    return lazy(pairs).names


def stamps(pairs: Sequence[Pair]) -> list[str]:
    """A fingerprint for each frame, without reading its file."""
    return [lazy(pairs).stamp(index) for index in range(len(pairs))]


def shared_frame(first: Sequence[Pair], second: Sequence[Pair]) -> str | None:
    """A frame that both hold, by its path or name; None if they share none."""
    return min(_identities(lazy(first)) & _identities(lazy(second)), default=None)


def _identities(pairs: LazyPairs) -> set[str]:
    found: set[str] = set()
    for index, name in enumerate(pairs.names):
        found |= {os.path.realpath(file) for file in pairs.files_of(index)} or {name}
    return found


def require_split(kind: str, split: str, known: Iterable[str]) -> None:
    if split not in known:
        raise ValueError(f"{kind}: no split {split}; use one of {', '.join(known)}")


class SomePairs(LazyPairs):
    """Some pairs of a sequence, by index; all of them by default."""

    def __init__(self, pairs: Sequence[Pair], indices: Iterable[int] | None = None) -> None:
        self.pairs, self.indices = lazy(pairs), list(range(len(pairs)) if indices is None else indices)
        super().__init__([self.pairs.names[index] for index in self.indices])
        self.labels = [self.pairs.labels[index] for index in self.indices] if self.pairs.labels else ()

    def read(self, index: int) -> Pair:
        return self.pairs[self.indices[index]]

    def files_of(self, index: int) -> Sequence[Path]:
        return self.pairs.files_of(self.indices[index])

    def stamp(self, index: int) -> str:
        return self.pairs.stamp(self.indices[index])


class Middles(SomePairs):
    """The middle ``crop x crop`` of each pair."""

    def __init__(self, pairs: Sequence[Pair], crop: int) -> None:
        super().__init__(pairs)
        self.crop = crop

    def read(self, index: int) -> Pair:
        return super().read(index).middle(self.crop)


class Binned(SomePairs):
    """All pairs of a sequence, :meth:`Pair.binned`: references with less noise of their own.

    Example:
        >>> from rawaug.data import demo_pairs
        >>> Binned(demo_pairs("test", count=1), 4)[0].raw.shape
        torch.Size([1, 72, 112])
    """

    def __init__(self, pairs: Sequence[Pair], factor: int, together: bool = False) -> None:
        if factor < 1:
            raise ValueError(f"bin must be at least 1, got {factor}")
        super().__init__(pairs)
        self.factor, self.together = factor, together

    def read(self, index: int) -> Pair:
        return super().read(index).binned(self.factor, self.together)

    def stamp(self, index: int) -> str:
        return f"{super().stamp(index)} binned by {self.factor}{', around one centre' * self.together}"


OWN_PICTURES = "pairs"
"""The value of ``data.pictures`` for augmenting the pictures of a recipe's own pairs."""


class PairPictures(Lazy[Tensor]):
    """The pictures uint8 ``(3, H, W)`` of pairs; a pair is read when its picture is asked for."""

    def __init__(self, pairs: Sequence[Pair]) -> None:
        self.pairs = pairs
        super().__init__(names_of(pairs))

    def read(self, index: int) -> Tensor:
        return self.pairs[index].srgb


def select_pairs(
    pairs: Sequence[Pair], kept: int, count: int | None, select: str | Sequence[str] = "first"
) -> list[int]:
    """Choose ``count`` (None: all) of the first ``kept`` pairs without reading any; returns their indices."""
    if not isinstance(select, str):
        return _named(names_of(pairs)[:kept], select)[:count]
    if select == "first":
        return list(range(kept)[:count])
    choices = {"scenes": whole_scenes, "phones": one_a_phone}
    if select not in choices:
        raise ValueError(f"data.select {select!r} is unknown; use first, {', '.join(choices)} or a list of names")
    labels = lazy(pairs).labels
    if not labels:
        raise ValueError(f"data.select: {select} needs frames with labels, such as sidd:; use first or names")
    return list(range(kept)) if count is None else choices[select](labels[:kept], count)


def whole_scenes(labels: Sequence[FrameLabel], count: int) -> list[int]:
    """Indices of the first scenes, in order of their names, whose frames are ``count`` in all."""
    order = sorted(range(len(labels)), key=lambda k: labels[k].scene)
    totals = list(accumulate(len(list(group)) for _, group in groupby(order, key=lambda k: labels[k].scene)))
    if count not in totals:
        near = sorted(totals, key=lambda total: abs(total - count))[:2]
        use = " or ".join(map(str, sorted(near)))
        raise ValueError(f"data.count: {count} pairs are not whole scenes; use {use}, or select: first")
    return order[:count]


def one_a_phone(labels: Sequence[FrameLabel], count: int) -> list[int]:
    """Indices of ``count`` frames, one phone after another; of each phone evenly spread in ISO."""
    phones = sorted({label.phone for label in labels})
    chosen: list[list[int]] = []
    for place, phone in enumerate(phones):
        share = count // len(phones) + (place < count % len(phones))
        frames = sorted((k for k, label in enumerate(labels) if label.phone == phone), key=lambda k: labels[k].iso)
        if share > len(frames):
            raise ValueError(f"data.count: {count} pairs are {share} of {phone}, which has {len(frames)}")
        chosen.append([frames[(2 * i + 1) * len(frames) // (2 * share)] for i in range(share)])
    longest = max(len(frames) for frames in chosen)
    return [frames[i] for i in range(longest) for frames in chosen if i < len(frames)]


def _named(names: Sequence[str], wanted: Sequence[str]) -> list[int]:
    indices: list[int] = []
    for name in wanted:
        found = [k for k, known in enumerate(names) if known == name or known.rpartition("_")[0] == name]
        if not found:
            examples = ", ".join(names[:3])
            raise ValueError(f"data.select: {name} is not among the {len(names)} frames, such as {examples}")
        indices += [k for k in found if k not in indices]
    return indices


# -- the noise of a capture --------------------------------------------------------------------------------------------

_BINS = 64
_FEWEST = 8
_ROUNDS = 5
_LEAST = 1e-9
_SITES = 2**20


def measure_noise(clean: np.ndarray, noisy: np.ndarray) -> tuple[float, float]:
    """(shot_var, read_var) of ``noisy``, both positive; arrays of the same shape, black 0, white 1."""
    signal = np.ravel(clean).astype(np.float64)
    square = (np.ravel(noisy) - signal) ** 2
    order = np.argsort(signal)
    parts = [part for part in np.array_split(order, _BINS) if len(part)]
    x, y = (np.array([values[part].mean() for part in parts]) for values in (signal, square))
    weight: np.ndarray = np.ones_like(x)
    for _ in range(_ROUNDS):
        shot, read = _line(x, y, weight)
        reach = 3 * np.sqrt(shot * x + read)
        whole = (x > reach) & (x < 1 - reach)
        weight = np.where(whole if whole.sum() >= _FEWEST else True, 1 / (shot * x + read) ** 2, 0.0)
    return shot, read


def measure_levels(clean: Tensor, noisy: Tensor) -> tuple[float, float]:
    """:func:`measure_noise` of two mosaics ``(1, H, W)``, of about a million of their sites if they are larger."""
    step = max(1, clean.numel() // _SITES) | 1  # odd, so that all four sites of the cell take part
    return measure_noise(clean.flatten()[::step].numpy(), noisy.flatten()[::step].numpy())


def _line(x: np.ndarray, y: np.ndarray, weight: np.ndarray) -> tuple[float, float]:
    middle = np.average(x, weights=weight), np.average(y, weights=weight)
    spread = np.average((x - middle[0]) ** 2, weights=weight)
    slope = np.average((x - middle[0]) * (y - middle[1]), weights=weight) / spread if spread > 0 else 0.0
    shot = float(np.clip(slope, _LEAST, max(middle[1] / max(middle[0], _LEAST), _LEAST)))
    return shot, float(max(middle[1] - shot * middle[0], _LEAST))
