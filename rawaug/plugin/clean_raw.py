r"""Pairs of clean RAW: the noise alone, ``noisy ~ N(y, shot_var y + read_var)``, with the face of an augmentation.

Who has clean RAW needs no camera model. A :class:`RawNoise` takes the place of a :class:`rawaug.RawAugment` in
:class:`rawaug.RawPairs` and :func:`rawaug.wrap`: crops start at whole cells of the pattern, and turns keep it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.utils.data import Dataset, get_worker_info

from rawaug import bayer
from rawaug.bayer import CFA, canonical_cfa, pattern
from rawaug.isp.config import ISPParams
from rawaug.kernels.runtime import eager
from rawaug.noise import Iso, NoiseLevels, NoiseModel, NoiseSpec, noise_model
from rawaug.plugin.params import AugmentParams, RawPair
from rawaug.plugin.pictures import describe, find_picture, get_picture, replace_picture
from rawaug.seeding import keyed_generator, rank_key

_ABOVE_WHITE = 1e-3
"""How far beyond 1 clean RAW may go, as rounding leaves it."""


class RawNoise(nn.Module):
    """Make pairs of clean RAW by adding a sensor's noise.

    It takes the place of a :class:`rawaug.RawAugment`, for RAW in place of pictures. A *frame* is

    - packed RAW ``(4, h, w)`` in the order R, Gr, Gb, B,
    - a mosaic ``(1, H, W)`` or ``(H, W)``, which needs ``cfa``,
    - a :class:`rawaug.io.RawFrame` or a :class:`rawaug.data.Pair`, which know their pattern,

    in floating point, black-subtracted, white = 1. RAW of a Bayer pattern becomes packed RAW, of others a mosaic.

    Args:
        noise: as for :class:`rawaug.RawAugment`.
        cfa: pattern of mosaics that do not say it.
        iso: of the noise of a measured camera: one ISO, or (lowest, highest); all of them by default.
        seed: of the module's own draws, where no generator is passed, and of wrapped loaders.

    Raises:
        ValueError: if the noise or the pattern is unknown.

    Example:
        >>> noise = RawNoise("cycleisp_sidd", cfa="GBRG")
        >>> noisy, clean, variance, params = noise(torch.rand(2, 1, 32, 32))
        >>> noisy.shape
        torch.Size([2, 4, 16, 16])
    """

    _nothing: Tensor
    """Says where the module is."""

    def __init__(
        self,
        noise: NoiseSpec | NoiseLevels | NoiseModel = "cycleisp_sidd",
        *,
        cfa: str | None = None,
        iso: Iso = None,
        seed: int = 0,
    ) -> None:
        super().__init__()
        self.noise = noise_model(noise, iso=iso)
        self.pattern = None if cfa is None else canonical_cfa(cfa)
        self.seed = seed
        self._calls = 0
        self._rank: tuple[int, ...] = ()
        self.register_buffer("_nothing", torch.empty(0), persistent=False)

    @property
    def device(self) -> torch.device:
        """The device that pairs are made on."""
        return self._nothing.device

    # -- the face of an augmentation ----------------------------------------------------------------------------------

    def open_folder(self, path: str | Path, size: tuple[int, int] | None) -> Any:
        """The RAW files of a folder, or the pairs of ``kind:path``; frames smaller than the crop are met on access."""
        return open_clean_raw(path)

    def as_batch(self, frames: Any, bgr: bool = False) -> Tensor:
        """Frames of one size as ``(B, 4, h, w)``, or mosaics ``(B, 1, H, W)`` of other patterns than Bayer's.

        Args:
            frames: a batch ``(B, 4, h, w)`` or ``(B, 1, H, W)``, a single frame, or a list of frames.
            bgr: RAW has no such order: ValueError.
        """
        _require_no_bgr(bgr)
        if isinstance(frames, (list, tuple)):
            return self.stack([self._planes(frame)[0] for frame in frames])
        if isinstance(frames, (Tensor, np.ndarray)) and frames.ndim == 4:
            return self.stack([self._planes(frame)[0] for frame in frames])
        return self._planes(frames)[0][None]

    def draw_patch(
        self,
        frame: Any,
        size: tuple[int, int] | None,
        turns: bool,
        generator: torch.Generator,
        zoom: float = 1.0,
        bgr: bool = False,
    ) -> tuple[Tensor, Tensor]:
        """Draw a crop of a frame, and cut it out.

        Args:
            frame: as the class lists them.
            size: height and width of the crop in pixels of the sensor; None for the whole frame.
            turns: whether flips are drawn, and, of a square, quarter turns. A crop that fills its frame is not turned.
            generator: on the CPU.
            zoom: RAW cannot be enlarged: ValueError unless it is 1.
            bgr: RAW has no such order: ValueError.

        Returns:
            The patch, packed ``(4, height / 2, width / 2)`` or a mosaic ``(1, height, width)``, and its place ``(5,)``:
            top, left, H, W and the view.
        """
        _require_no_bgr(bgr)
        if zoom != 1.0:
            raise ValueError(f"zoom enlarges pictures, not RAW; got {zoom}")
        mosaic, name = self.read(frame)
        place = self._draw_place(mosaic, name, size, turns, generator)
        return self.cut_patch(frame, place, size), place

    def cut_patch(self, frame: Any, place: Tensor, size: tuple[int, int] | None, bgr: bool = False) -> Tensor:
        """Cut the patch of a drawn place ``(5,)`` out of a frame; ValueError if it was drawn for another size."""
        mosaic, name = self.read(frame)
        top, left, height, width, view = place.tolist()[:5]
        if mosaic.shape[-2:] != (height, width):
            raise ValueError(f"the parameters belong to a frame of {height} x {width}, got {tuple(mosaic.shape[-2:])}")
        region = size or (height, width)
        if view:
            whole = _region(region, pattern(name).period)
            mosaic = pattern(name).turn_keeping(mosaic[..., top:, left:][..., : whole[0], : whole[1]], view)
            mosaic = mosaic[..., : region[0], : region[1]]
        else:
            mosaic = bayer.crop(mosaic, top, left, *region)
        return bayer.pack_if_bayer(mosaic, name).contiguous()

    def _draw_place(
        self, mosaic: Tensor, name: str, size: tuple[int, int] | None, turns: bool, generator: torch.Generator
    ) -> Tensor:
        height, width = mosaic.shape[-2:]
        region = size or (height, width)
        view = torch.tensor(0)
        if turns and size is not None:
            # Turns that move the pattern need a cell more than the crop.
            larger = _region(region, pattern(name).period)
            if larger[0] <= height and larger[1] <= width:
                view = bayer.RandomTurn(CFA.RGGB, quarter=region[0] == region[1]).sample(generator)
                region = larger if int(view) else region

        period = pattern(name).period
        if region[0] > height or region[1] > width:
            raise ValueError(f"{height} x {width} is smaller than the crop {region[0]} x {region[1]}")
        rows = torch.randint((height - region[0]) // period + 1, (), generator=generator)
        columns = torch.randint((width - region[1]) // period + 1, (), generator=generator)
        return torch.stack([rows * period, columns * period, torch.tensor(height), torch.tensor(width), view])

    def stack(self, patches: Sequence[Tensor]) -> Tensor:
        """Stack patches of one size; ValueError if they differ."""
        shapes = sorted({tuple(patch.shape) for patch in patches})
        if len(shapes) != 1:
            raise ValueError(f"frames of a batch must have one size, got {shapes}; crop them, as wrap(..., crop=256)")
        return torch.stack(list(patches))

    @torch.no_grad()
    def sample(
        self, frames: Any, generator: torch.Generator | None = None, crop: Tensor | None = None
    ) -> AugmentParams:
        """Draw the parameters of a batch ``(B, ...)``; those of a single frame have no leading B.

        Args:
            frames: as for :meth:`as_batch`.
            generator: on the CPU; the module's own by default.
            crop: ``(B, 5)`` where the frames are crops of larger ones.
        """
        batch = self.as_batch(frames)
        params = self._sample(batch, generator or self._own_generator(), crop)
        return params.map(lambda tensor: tensor[0]) if _is_single(frames) else params

    def _sample(self, batch: Tensor, generator: torch.Generator, crop: Tensor | None) -> AugmentParams:
        if crop is None:
            scale = bayer.sites_per_value(batch)
            height, width = (scale * side for side in batch.shape[-2:])
            crop = torch.tensor([0, 0, height, width, 0]).repeat(len(batch), 1)
        none = torch.empty(len(batch), 0)
        return AugmentParams(
            ISPParams(none, none, none, none, none), self.noise.sample(len(batch), generator), crop, {}
        )

    @eager
    @torch.no_grad()
    def apply(self, frames: Any, params: AugmentParams | None = None) -> Any:
        """Make the :class:`RawPair` that parameters describe, bit for bit the same at every call.

        Args:
            frames: as for :meth:`as_batch`. A function alone, as a surrounding module may pass it, goes to
                ``nn.Module.apply``.
            params: those of as many frames; for a single frame they and the pair have no leading B.
        """
        if params is None:
            return super().apply(frames)
        if _is_single(frames):
            batch = params.map(lambda tensor: tensor[None])
            return self._pair(self.as_batch(frames), batch).map(lambda tensor: tensor[0])
        return self._pair(self.as_batch(frames), params)

    @eager
    @torch.no_grad()
    def make_pair(self, frames: Tensor, generator: torch.Generator, crop: Tensor | None = None) -> RawPair:
        """Sample, then apply, to frames as :meth:`as_batch` gives them, on the module's device."""
        return self._pair(frames, self._sample(frames, generator, crop))

    def _pair(self, clean: Tensor, params: AugmentParams) -> RawPair:
        if len(params.crop) != len(clean):
            raise ValueError(f"the parameters are for {len(params.crop)} frames, but the batch has {len(clean)}")
        if clean.shape[1] == 4:
            noisy, variance = self.noise.apply_with_variance(clean, params.noise)
            return RawPair(noisy, clean, variance, params)
        if self.noise.by_plane:
            raise ValueError("this noise is one of planes R, Gr, Gb, B, which only Bayer patterns have")
        planes = bayer.pack(clean, CFA.RGGB)
        noisy, variance = self.noise.apply_with_variance(planes, params.noise)
        return RawPair(bayer.unpack(noisy, CFA.RGGB), clean, bayer.unpack(variance, CFA.RGGB), params)

    def forward(self, batch: Any, generator: torch.Generator | None = None, key: str | int | None = None) -> Any:
        """Draw parameters for a batch and apply them.

        Args:
            batch: as for :meth:`as_batch`, or a tuple or mapping that has frames. A single frame makes a single pair.
            generator: of all that is drawn, on the CPU; the module's own by default.
            key: name or index of the frames in a mapping or tuple.

        Returns:
            A :class:`RawPair`; of a tuple or mapping, this with the pair in place of the frames.
        """
        where = find_picture(batch, key, batched=True) if isinstance(batch, (Mapping, tuple)) else None
        frames = get_picture(batch, where)
        pair = self.make_pair(self.as_batch(frames).to(self.device), generator or self._own_generator())
        return replace_picture(batch, where, pair.map(lambda tensor: tensor[0]) if _is_single(frames) else pair)

    def __repr__(self) -> str:
        """Tell in a line what is drawn."""
        return f"RawNoise, {type(self.noise).__name__}, {self.pattern or 'the pattern of the frames'}"

    # -- frames -------------------------------------------------------------------------------------------------------

    def read(self, frame: Any) -> tuple[Tensor, str]:
        """The mosaic ``(1, H, W)`` of a frame, float32, and the name of its pattern.

        Raises:
            ValueError: if it is no frame, is not scaled to white = 1, or does not say its pattern.
        """
        if hasattr(frame, "mosaic") and hasattr(frame, "cfa"):
            return _require_raw(frame.mosaic), canonical_cfa(frame.cfa)
        if hasattr(frame, "raw") and hasattr(frame, "cfa"):
            return _require_raw(frame.raw), canonical_cfa(frame.cfa)
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

    def _planes(self, frame: Any) -> tuple[Tensor, str]:
        mosaic, name = self.read(frame)
        return bayer.pack_if_bayer(mosaic, name), name

    def _own_generator(self) -> torch.Generator:
        """A new generator for each call, worker and process."""
        self._calls += 1
        worker = get_worker_info()
        rank = rank_key() or self._rank
        return keyed_generator(self.seed, "raw noise", worker.seed if worker else 0, self._calls, *rank)

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_rank": rank_key() or self._rank}  # a spawned worker has no process group


def _region(size: tuple[int, int], period: int) -> tuple[int, int]:
    """Whole cells that hold a crop at any phase."""
    height, width = (math.ceil(side / period) * period + period for side in size)
    return height, width


def _is_single(frames: Any) -> bool:
    if isinstance(frames, (Tensor, np.ndarray)):
        return frames.ndim < 4
    return not isinstance(frames, (list, tuple))


def _require_no_bgr(bgr: bool) -> None:
    if bgr:
        raise ValueError("bgr is an order of pictures; packed RAW is R, Gr, Gb, B")


def _require_raw(raw: Tensor, packed: bool = False) -> Tensor:
    """RAW as float32 with even sides; ValueError unless it is finite and at most 1."""
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


class RawFiles(Dataset[Any]):
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


def open_clean_raw(path: str | Path) -> Any:
    """The RAW files of a folder, or the pairs of a known dataset, ``kind:path``, whose RAW is clean."""
    from rawaug.data import open_pairs

    return RawFiles(path) if Path(path).exists() else open_pairs(str(path))
