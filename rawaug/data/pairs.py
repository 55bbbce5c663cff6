"""RAW-sRGB pairs: one shot, RAW and sRGB, with what is known of its camera and its noise."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple, TypeVar

import torch
import torch.nn.functional as F
from torch import Tensor

from rawaug.bayer import CFA, bin_mosaic, bin_mosaic_variance, crop_to_cfa, to_bayer
from rawaug.data.noise_levels import measure_levels
from rawaug.io import RawFrame
from rawaug.io.pictures import decode_srgb, encode_srgb
from rawaug.registry import Registry

T = TypeVar("T")

DATASETS = Registry("kind of data", "rawaug.datasets", "rawaug.data")
"""The readers of pairs by name, for ``kind:path``: ``reader(path, split)`` returns a sequence of :class:`Pair`.

A reader of pairs of developed pictures is a subclass of :class:`rawaug.data.picture_pairs.PicturePairs`.
"""

PICTURES = Registry("kind of pictures", "rawaug.pictures", "rawaug.data")
"""The readers of pictures by name: ``reader(path, min_side)`` returns a sequence of sRGB ``(3, H, W)``."""


@dataclass(frozen=True)
class Pair:
    """One shot, RAW and sRGB.

    Attributes:
        name: name of the shot, for reports.
        srgb: uint8 ``(3, H, W)``, in the sensor's orientation.
        raw: the clean mosaic, float32 ``(1, H, W)``, black 0, white 1, sides even.
        cfa: the pattern of ``raw`` and ``noisy``.
        white_balance: as-shot multipliers of R, G, B, green being 1; all 1 if they are not known.
        color_matrix: float32 ``(3, 3)``, white-balanced camera colour to linear sRGB, rows summing to 1.
        noisy: a noisy mosaic of the same scene, like ``raw``, if one was captured.
        shot_var, read_var: the levels of ``noisy``: its variance is shot_var * raw + read_var.
        camera: make and model.
        iso: None if unknown.
        registered: whether ``srgb`` and ``raw`` agree pixel for pixel. A camera's own JPEG is corrected for its lens:
            compare it at a much lower resolution only.
        rendered: whether ``srgb`` is a rendering in the camera's colours. If False, gains and matrix are unknown, and
            ``srgb`` merely displays the RAW, so that no ISP can be fitted to it or scored on it.
        noisy_srgb: the camera's picture of ``noisy``, like ``srgb``, if there is one.
        levels_from_clean: whether ``shot_var`` and ``read_var`` were measured against ``raw``. A denoiser under test
            must not know such levels.
        own_noise: (shot_var, read_var) of the noise that ``raw`` itself has, if it was measured.
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
        object.__setattr__(self, "cfa", CFA(self.cfa))  # cfa may be the name of a pattern

        self._require_shape("srgb", self.srgb, 3, torch.uint8)
        self._require_shape("raw", self.raw, 1, torch.float32)
        if self.noisy is not None:
            self._require_shape("noisy", self.noisy, 1, torch.float32)
        if self.noisy_srgb is not None:
            self._require_shape("noisy_srgb", self.noisy_srgb, 3, torch.uint8)

        height, width = self.raw.shape[-2:]
        if height % 2 or width % 2 or not height or not width:
            raise ValueError(f"pair {self.name}: the mosaic must have even sides, got {tuple(self.raw.shape)}")
        if self.color_matrix.shape != (3, 3):
            raise ValueError(f"pair {self.name}: color_matrix must be (3, 3), got {tuple(self.color_matrix.shape)}")

        is_incomplete = (self.shot_var is None) != (self.read_var is None)
        if is_incomplete or (self.noisy is None and self.shot_var is not None):
            raise ValueError(f"pair {self.name}: shot_var and read_var must be given together, with a noisy mosaic")

    @classmethod
    def of_frame(cls, name: str, frame: RawFrame, srgb: Tensor, **attributes: Any) -> Pair:
        """Make the pair of a RAW file and its picture, with further ``attributes`` of the pair.

        A mosaic with another pattern than Bayer's is converted to RGGB at half its sides.
        """
        mosaic = frame.mosaic
        cfa = frame.cfa
        if cfa not in CFA.__members__:
            mosaic = to_bayer(mosaic, cfa)
            cfa = CFA.RGGB
            height, width = mosaic.shape[-2:]
            srgb = _bin_picture(srgb[:, : 2 * height, : 2 * width], 2)

        return cls(
            name=name,
            srgb=srgb,
            raw=mosaic,
            cfa=CFA(cfa),
            white_balance=frame.white_balance,
            color_matrix=frame.color_matrix,
            camera=frame.camera,
            iso=frame.iso,
            **attributes,
        )

    @property
    def balance_known(self) -> bool:
        return self.white_balance != (1.0, 1.0, 1.0)

    def with_levels(self) -> Pair:
        """Return this pair with levels, measured against ``raw`` if the capture states none."""
        if self.noisy is None or self.shot_var is not None:
            return self

        shot_var, read_var = measure_levels(self.raw, self.noisy)
        return replace(self, shot_var=shot_var, read_var=read_var, levels_from_clean=True)

    def with_own_noise(self, estimate: Callable[[Tensor, CFA], tuple[float, float] | None]) -> Pair:
        """Return this pair with the noise levels of ``raw`` itself, from ``estimate(raw, cfa)`` if it states none."""
        if self.own_noise is not None:
            return self

        return replace(self, own_noise=estimate(self.raw, self.cfa))

    def require_rendered(self) -> None:
        if not self.rendered:
            raise ValueError(
                f"{self.name}: has no sRGB picture, and its white balance and colour matrix are unknown; "
                "put the dataset's sRGB files or METADATA beside its RAW (docs/datasets.md)"
            )

    def in_pattern(self, cfa: CFA | str) -> Pair:
        """Crop the outer rows or columns so that the frame has the pattern ``cfa``."""
        target = CFA(cfa)
        if target == self.cfa:
            return self

        def crop(image: Tensor) -> Tensor:
            return crop_to_cfa(image, self.cfa, target).contiguous()

        return self._transform(crop, cfa=target)

    def middle(self, side: int) -> Pair:
        """Crop the middle ``side x side`` of the frame, or its full length along a shorter side; the CFA stays."""
        even_side = side // 2 * 2

        def crop(image: Tensor) -> Tensor:
            return centre(image, even_side, even_side)

        return self._transform(crop)

    def binned(self, factor: int, together: bool = False) -> Pair:
        """Shrink the frame to 1 / ``factor`` of its sides; its noise then has about 1 / ``factor``^2 of the variance.

        :func:`rawaug.bayer.bin_mosaic` bins RAW and explains ``together``; pictures are averaged in linear light.

        Raises:
            ValueError: if a side is shorter than two of the new cells.
        """
        if factor == 1 and not together:
            return self

        cell = 2 * factor
        height = self.raw.shape[-2] // cell * cell
        width = self.raw.shape[-1] // cell * cell
        if not min(height, width):
            raise ValueError(f"pair {self.name}: {tuple(self.raw.shape[-2:])} is too small to be binned by {factor}")

        levels: dict[str, Any] = {}
        scale = bin_mosaic_variance(factor, together)
        if self.shot_var is not None and self.read_var is not None:
            levels["shot_var"] = self.shot_var * scale
            levels["read_var"] = self.read_var * scale
        if self.own_noise is not None:
            levels["own_noise"] = (self.own_noise[0] * scale, self.own_noise[1] * scale)

        def bin_image(image: Tensor) -> Tensor:
            whole_cells = image[:, :height, :width]
            if len(whole_cells) == 1:
                return bin_mosaic(whole_cells, self.cfa, factor, together)
            return _bin_picture(whole_cells, factor)

        return self._transform(bin_image, **levels)

    def _transform(self, change: Callable[[Tensor], Tensor], **attributes: Any) -> Pair:
        """Copy the pair with ``change`` applied to every image, and with other ``attributes``."""
        for key in ("srgb", "raw", "noisy", "noisy_srgb"):
            image = getattr(self, key)
            if image is not None:
                attributes[key] = change(image)
        return replace(self, **attributes)

    def _require_shape(self, field: str, image: Tensor, channels: int, dtype: torch.dtype) -> None:
        expected = (channels, *self.raw.shape[-2:])
        if tuple(image.shape) != expected or image.dtype != dtype:
            got = f"{image.dtype} {tuple(image.shape)}"
            raise ValueError(f"pair {self.name}: {field} must be {dtype} {expected}, got {got}")


def centre(image: Tensor, height: int, width: int, step: int = 2) -> Tensor:
    """Crop the middle of ``(..., H, W)``, or its full length along a shorter side.

    The crop begins at a multiple of ``step``. A step of 2 keeps the pattern of a mosaic; use 1 for packed RAW.
    """
    top = max(0, image.shape[-2] - height) // (2 * step) * step
    left = max(0, image.shape[-1] - width) // (2 * step) * step
    return image[..., top : top + height, left : left + width].contiguous()


def _bin_picture(srgb: Tensor, factor: int) -> Tensor:
    """Average a picture in linear light, uint8 ``(3, H, W)``."""
    linear = F.avg_pool2d(decode_srgb(srgb.float() / 255), factor)
    return (encode_srgb(linear) * 255).round().to(torch.uint8)


class Sample(NamedTuple):
    """A training sample of a denoiser, packed ``(4, h, w)``, or a batch of them, ``(B, 4, h, w)``."""

    noisy: Tensor
    clean: Tensor
    variance: Tensor


def require_split(kind: str, split: str, splits: Iterable[str]) -> None:
    if split not in splits:
        raise ValueError(f"{kind}: no split {split}; use one of {', '.join(splits)}")
