r"""Pairs of clean RAW: the noise alone, ``noisy ~ N(y, shot_var y + read_var)``, with the interface of an augmentation.

If you have clean RAW, you need no camera model. A :class:`RawNoise` takes the place of a :class:`rawaug.RawAugment` in
:class:`rawaug.RawPairs` and :func:`rawaug.wrap`. Crops start at whole cells of the pattern, and turns preserve it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import Dataset

from rawaug import bayer
from rawaug.bayer import CFA, canonical_cfa, pattern
from rawaug.isp.config import ISPParams
from rawaug.noise import Iso, NoiseSpec, noise_model
from rawaug.plugin.camera_noise import USUAL
from rawaug.plugin.maker import PairMaker
from rawaug.plugin.params import AugmentParams, RawPair
from rawaug.plugin.pictures import Where, describe

_ABOVE_WHITE = 1e-3
"""How far clean RAW may exceed 1, to allow for rounding."""


class RawNoise(PairMaker):
    """Make pairs of clean RAW by adding a sensor's noise.

    It takes the place of a :class:`rawaug.RawAugment` if you have RAW instead of pictures. A *frame* is

    - packed RAW ``(4, h, w)`` in the order R, Gr, Gb, B,
    - a mosaic ``(1, H, W)`` or ``(H, W)``, which needs ``cfa``,
    - a :class:`rawaug.io.RawFrame` or a :class:`rawaug.data.Pair`, which know their pattern.

    Values are floating point, black-subtracted, white = 1. RAW of a Bayer pattern becomes packed RAW, RAW of any other
    pattern a mosaic.

    Args:
        noise: as for :class:`rawaug.RawAugment`.
        cfa: pattern of mosaics that do not state their own.
        iso: ISO of the noise of a measured camera, or (lowest, highest); all measured ISOs by default.
        seed: seed of wrapped loaders, and of the module's own draws where no generator is passed.

    Raises:
        ValueError: if the noise or the pattern is unknown.

    Example:
        >>> noise = RawNoise("cycleisp_sidd", cfa="GBRG")
        >>> noisy, clean, variance, params = noise(torch.rand(2, 1, 32, 32))
        >>> noisy.shape
        torch.Size([2, 4, 16, 16])
    """

    stream = "raw noise"
    _nothing: Tensor
    """An empty buffer, which shows where the module is."""

    def __init__(
        self,
        noise: NoiseSpec = USUAL,
        *,
        cfa: str | None = None,
        iso: Iso = None,
        seed: int = 0,
    ) -> None:
        super().__init__(seed)
        self.noise = noise_model(noise, iso=iso)
        self.pattern = None if cfa is None else canonical_cfa(cfa)
        self.register_buffer("_nothing", torch.empty(0), persistent=False)

    @property
    def device(self) -> torch.device:
        """The device that pairs are made on."""
        return self._nothing.device

    def __repr__(self) -> str:
        """Describe in a line what is drawn."""
        return f"RawNoise, {type(self.noise).__name__}, {self.pattern or 'the pattern of the frames'}"

    # -- draw, apply: see PairMaker -----------------------------------------------------------------------------------

    def draw_params(
        self, batch: Tensor, generator: torch.Generator, crop: Tensor | None, chosen: ISPParams | None = None
    ) -> AugmentParams:
        """Draw the parameters of frames ``(B, 4, h, w)`` or mosaics ``(B, 1, H, W)``; there is no camera setting."""
        if crop is None:
            scale = bayer.sites_per_value(batch)
            height, width = scale * batch.shape[-2], scale * batch.shape[-1]
            crop = torch.tensor([0, 0, height, width, 0]).repeat(len(batch), 1)

        none = torch.empty(len(batch), 0)
        setting = ISPParams(none, none, none, none, none)
        return AugmentParams(setting, self.noise.sample(len(batch), generator), crop, {})

    def apply_params(self, batch: Tensor, params: AugmentParams) -> RawPair:
        """Add the noise that the parameters describe to frames ``(B, 4, h, w)`` or mosaics ``(B, 1, H, W)``."""
        self._require_as_many(batch, params)
        if batch.shape[1] == 4:
            noisy, variance = self.noise.apply_with_variance(batch, params.noise)
            return RawPair(noisy, batch, variance, params)

        if self.noise.by_plane:
            raise ValueError("this noise is one of planes R, Gr, Gb, B, which only Bayer patterns have")
        planes = bayer.pack(batch, CFA.RGGB)
        noisy, variance = self.noise.apply_with_variance(planes, params.noise)
        return RawPair(bayer.unpack(noisy, CFA.RGGB), batch, bayer.unpack(variance, CFA.RGGB), params)

    def find(self, sample: Any, key: str | int | None) -> Where:
        """Find the frames in a loader's batch; a list is a batch of frames."""
        if isinstance(sample, (Mapping, tuple)):
            return super().find(sample, key)
        return None

    def _batch(self, inputs: Any) -> Tensor:
        return self.as_batch(inputs).to(self.device)

    # -- frames -------------------------------------------------------------------------------------------------------

    def is_single(self, inputs: Any) -> bool:
        """Whether this is one frame, and not a batch."""
        if isinstance(inputs, (Tensor, np.ndarray)):
            return inputs.ndim < 4
        return not isinstance(inputs, (list, tuple))

    def open_folder(self, path: str | Path, size: tuple[int, int] | None) -> Any:
        """Open the RAW files of a folder, or the pairs of ``kind:path``; frames that are too small fail on access."""
        return _open_clean_raw(path)

    def as_batch(self, inputs: Any, bgr: bool = False) -> Tensor:
        """Turn frames of one size into ``(B, 4, h, w)``, or into mosaics ``(B, 1, H, W)`` if not of a Bayer pattern.

        Args:
            inputs: a batch ``(B, 4, h, w)`` or ``(B, 1, H, W)``, a single frame, or a list of frames.
            bgr: must be false (ValueError), as RAW has no such order.
        """
        _require_no_bgr(bgr)
        if self.is_single(inputs):
            return self._planes(inputs)[None]
        return self.stack([self._planes(frame) for frame in inputs])

    def stack(self, patches: Sequence[Tensor]) -> Tensor:
        """Stack patches of one size; ValueError if they differ."""
        shapes = sorted({tuple(patch.shape) for patch in patches})
        if len(shapes) != 1:
            raise ValueError(f"frames of a batch must have one size, got {shapes}; crop them, as wrap(..., crop=256)")
        return torch.stack(list(patches))

    def draw_patch(
        self,
        whole: Any,
        size: tuple[int, int] | None,
        views: bool,
        generator: torch.Generator,
        zoom: float = 1.0,
        bgr: bool = False,
    ) -> tuple[Tensor, Tensor]:
        """Draw a crop of a frame, and cut it out.

        Args:
            whole: a frame, in any form that the class lists.
            size: height and width of the crop in pixels of the sensor; None for the whole frame.
            views: whether to draw flips and, for a square, quarter turns. A crop that fills its frame is not turned.
            generator: a generator on the CPU.
            zoom: must be 1 (ValueError), as RAW cannot be enlarged.
            bgr: must be false (ValueError), as RAW has no such order.

        Returns:
            The patch, packed ``(4, height / 2, width / 2)`` or a mosaic ``(1, height, width)``, and its place ``(5,)``:
            top, left, H, W and the view.
        """
        _require_no_bgr(bgr)
        if zoom != 1.0:
            raise ValueError(f"zoom enlarges pictures, not RAW; got {zoom}")
        mosaic, name = self.read(whole)
        place = _draw_place(mosaic, pattern(name).period, size, views, generator)
        return self.cut_patch(whole, place, size), place

    def cut_patch(self, whole: Any, place: Tensor, size: tuple[int, int] | None, bgr: bool = False) -> Tensor:
        """Cut the patch of a drawn place ``(5,)`` out of a frame; ValueError if it was drawn for another size."""
        mosaic, name = self.read(whole)
        top, left, height, width, view = place.tolist()[:5]
        if mosaic.shape[-2:] != (height, width):
            raise ValueError(f"the parameters belong to a frame of {height} x {width}, got {tuple(mosaic.shape[-2:])}")

        rows, columns = size or (height, width)
        if not view:
            return bayer.pack_if_bayer(bayer.crop(mosaic, top, left, rows, columns), name).contiguous()

        # Turns that keep the pattern shift it, so they need one cell more than the crop.
        whole_rows, whole_columns = _with_a_cell((rows, columns), pattern(name).period)
        region = mosaic[..., top : top + whole_rows, left : left + whole_columns]
        turned = pattern(name).turn_keeping(region, view)[..., :rows, :columns]
        return bayer.pack_if_bayer(turned, name).contiguous()

    def read(self, frame: Any) -> tuple[Tensor, str]:
        """Read the mosaic ``(1, H, W)`` of a frame, float32, and the name of its pattern.

        Raises:
            ValueError: if it is not a frame, is not scaled to white = 1, or does not state its pattern.
        """
        frame = getattr(frame, "clean", frame)  # of a pair
        if hasattr(frame, "mosaic") and hasattr(frame, "cfa"):
            return _require_raw(frame.mosaic), canonical_cfa(frame.cfa)
        if not isinstance(frame, (Tensor, np.ndarray)):
            raise ValueError(f"clean RAW must be a tensor, an array, a RawFrame or a Pair, got {describe(frame)}")

        raw = torch.as_tensor(frame)
        if not raw.is_floating_point():
            raise ValueError(f"{describe(frame)}: clean RAW is floating point, less the black level, with white at 1")
        if raw.ndim == 2:
            raw = raw[None]
        if raw.ndim == 3 and raw.shape[0] == 4:
            return bayer.unpack(_require_raw(raw, packed=True), CFA.RGGB), str(CFA.RGGB)

        if raw.ndim != 3 or raw.shape[0] != 1:
            raise ValueError(f"clean RAW must be packed (4, h, w) or a mosaic (1, H, W), got {describe(frame)}")
        if self.pattern is None:
            raise ValueError("a mosaic does not say its pattern; give cfa, as RawNoise(..., cfa='RGGB')")
        return _require_raw(raw), self.pattern

    def _planes(self, frame: Any) -> Tensor:
        mosaic, name = self.read(frame)
        return bayer.pack_if_bayer(mosaic, name)


def _draw_place(
    mosaic: Tensor, period: int, size: tuple[int, int] | None, views: bool, generator: torch.Generator
) -> Tensor:
    """Draw top, left, H, W and view ``(5,)`` of a crop that begins at a whole cell of ``period`` lines."""
    height, width = mosaic.shape[-2:]
    rows, columns = size or (height, width)

    view = torch.tensor(0)
    if views and size is not None:
        larger = _with_a_cell(size, period)
        if larger[0] <= height and larger[1] <= width:
            view = bayer.RandomView(CFA.RGGB, quarter=rows == columns).sample(generator)
            if int(view):
                rows, columns = larger

    if rows > height or columns > width:
        raise ValueError(f"{height} x {width} is smaller than the crop {rows} x {columns}")
    top = torch.randint((height - rows) // period + 1, (), generator=generator) * period
    left = torch.randint((width - columns) // period + 1, (), generator=generator) * period
    return torch.stack([top, left, torch.tensor(height), torch.tensor(width), view])


def _with_a_cell(size: tuple[int, int], period: int) -> tuple[int, int]:
    """Height and width of the whole cells that hold a crop at any phase of the pattern."""
    rows, columns = size
    return math.ceil(rows / period) * period + period, math.ceil(columns / period) * period + period


def _require_no_bgr(bgr: bool) -> None:
    if bgr:
        raise ValueError("bgr is an order of pictures; packed RAW is R, Gr, Gb, B")


def _require_raw(raw: Tensor, packed: bool = False) -> Tensor:
    """Return RAW as float32; ValueError unless its sides are even and it is finite and at most 1."""
    raw = raw.float()
    height, width = raw.shape[-2:]

    if min(height, width) < 1 or (not packed and min(height, width) < 2):
        raise ValueError(f"clean RAW of {height} x {width} has no cell")

    largest = float(raw.max())
    if not math.isfinite(float(raw.min())) or not largest <= 1.0 + _ABOVE_WHITE:
        raise ValueError(
            f"clean RAW is less the black level, with white at 1, and finite; its largest value is {largest}"
        )

    if packed:
        return raw
    return raw[..., : height - height % 2, : width - width % 2]


# -- files -------------------------------------------------------------------------------------------------------------


class CleanRawFiles(Dataset[Any]):
    """The RAW files of a folder and its subfolders, sorted by path, each a :class:`rawaug.io.RawFrame`.

    Args:
        path: a folder, or one RAW file.

    Raises:
        FileNotFoundError: if there is no such file or folder.
        ValueError: if it holds no RAW file, or, on access, if a file is damaged.
    """

    def __init__(self, path: str | Path) -> None:
        from rawaug.files import files_in
        from rawaug.io.raw import RAW_EXTENSIONS

        self.path = Path(path)
        self.files = files_in(path, "RAW", RAW_EXTENSIONS)

    def __len__(self) -> int:
        return len(self.files)

    def __getitem__(self, index: int) -> Any:
        from rawaug.io import read_raw

        return read_raw(self.files[index])

    def file(self, index: int) -> Path:
        return self.files[index]


def _open_clean_raw(path: str | Path) -> Any:
    """Open the RAW files of a folder, or the pairs of a known dataset, ``kind:path``, whose RAW is clean."""
    from rawaug.data import open_pairs

    if Path(path).exists():
        return CleanRawFiles(path)
    return open_pairs(str(path))
