"""RAW-sRGB pairs: one shot as clean RAW, as noisy RAW if it was captured, and as a picture."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from rawaug.bayer import CFA, bin_mosaic, bin_mosaic_variance, crop_to_cfa, to_bayer
from rawaug.data.noise_levels import measure_levels
from rawaug.io import RawFrame
from rawaug.io.pictures import decode_srgb, encode_srgb
from rawaug.registry import Registry

DATASETS = Registry("kind of data", "rawaug.datasets", "rawaug.data")
"""The readers of pairs by name, for ``kind:path``: ``reader(path, split)`` returns a sequence of :class:`Pair`.

A reader of pairs of developed pictures is a subclass of :class:`rawaug.data.picture_pairs.PicturePairs`.
"""

PICTURES = Registry("kind of pictures", "rawaug.pictures", "rawaug.data")
"""The readers of pictures by name: ``reader(path, min_side)`` returns a sequence of sRGB ``(3, H, W)``."""


@dataclass(frozen=True)
class Pair:
    """One shot: a clean RAW frame, a noisy one if it was captured, and what they were rendered to.

    Attributes:
        name: name of the shot, for reports.
        clean: the clean frame, of a Bayer pattern. Its ``noise_profile`` is its own noise, if that was measured.
            Without ``color_known`` and a white balance no ISP can be fitted to it.
        srgb: the picture of ``clean``, uint8 ``(3, H, W)``, in the sensor's orientation.
        noisy: a noisy frame of the same scene, like ``clean``, if one was captured. Its ``noise_profile`` has
            (shot_var, read_var): its variance is shot_var * clean + read_var.
        noisy_srgb: the camera's picture of ``noisy``, like ``srgb``, if there is one.
        registered: whether ``srgb`` and ``clean`` agree pixel for pixel. A camera's own JPEG is corrected for its lens:
            compare it at a much lower resolution only.
        rendered: whether ``srgb`` is a rendering in the camera's colours. If False, gains and matrix are unknown, and
            ``srgb`` merely displays the RAW, so that no ISP can be fitted to it or scored on it.
        levels_from_clean: whether the levels of ``noisy`` were measured against ``clean``. A denoiser under test must
            not know such levels.

    Raises:
        ValueError: if the pattern is not Bayer's, patterns, shapes or dtypes disagree, or a side is odd.

    Example:
        >>> picture, mosaic = torch.zeros(3, 4, 6, dtype=torch.uint8), torch.zeros(1, 4, 6)
        >>> Pair("black", RawFrame(mosaic, "RGGB"), picture).middle(4).clean.mosaic.shape
        torch.Size([1, 4, 4])
    """

    name: str
    clean: RawFrame
    srgb: Tensor
    noisy: RawFrame | None = None
    noisy_srgb: Tensor | None = None
    registered: bool = True
    rendered: bool = True
    levels_from_clean: bool = False

    def __post_init__(self) -> None:
        CFA(self.clean.cfa)
        if self.clean.color_matrix.shape != (3, 3):
            shape = tuple(self.clean.color_matrix.shape)
            raise ValueError(f"pair {self.name}: color_matrix must be (3, 3), got {shape}")

        images = {"clean": self.clean.mosaic, "srgb": self.srgb, "noisy_srgb": self.noisy_srgb}
        if self.noisy is not None:
            if self.noisy.cfa != self.clean.cfa:
                raise ValueError(f"pair {self.name}: clean has the pattern {self.clean.cfa}, noisy {self.noisy.cfa}")
            images["noisy"] = self.noisy.mosaic
        size = tuple(self.clean.mosaic.shape[-2:])
        for key, image in images.items():
            dtype, shape = torch.float32, (1, *size)
            if key in ("srgb", "noisy_srgb"):
                dtype, shape = torch.uint8, (3, *size)
            if image is not None and (tuple(image.shape) != shape or image.dtype != dtype):
                got = f"{image.dtype} {tuple(image.shape)}"
                raise ValueError(f"pair {self.name}: {key} must be {dtype} {shape}, got {got}")

        height, width = size
        if height % 2 or width % 2 or not height or not width:
            raise ValueError(f"pair {self.name}: the mosaic must have even sides, got {size}")

    @classmethod
    def of_frame(cls, name: str, frame: RawFrame, srgb: Tensor, registered: bool = True) -> Pair:
        """Make the pair of a RAW file and its picture.

        A mosaic with another pattern than Bayer's is converted to RGGB at half its sides. What the file states of its
        noise is left out: it is that of a whole exposure, and a reference's own noise is measured.
        """
        mosaic = frame.mosaic
        cfa = frame.cfa
        if cfa not in CFA.__members__:
            mosaic = to_bayer(mosaic, cfa)
            cfa = CFA.RGGB
            height, width = mosaic.shape[-2:]
            srgb = _bin_picture(srgb[:, : 2 * height, : 2 * width], 2)

        clean = RawFrame(
            mosaic,
            cfa,
            white_balance=frame.white_balance,
            color_matrix=frame.color_matrix,
            color_known=frame.color_known,
            camera=frame.camera,
            iso=frame.iso,
            name=name,
        )
        return cls(name, clean, srgb, registered=registered)

    @property
    def cfa(self) -> CFA:
        """The pattern of both frames."""
        return CFA(self.clean.cfa)

    @property
    def balance_known(self) -> bool:
        """Whether the clean frame states its white balance."""
        return self.clean.white_balance != (1.0, 1.0, 1.0)

    def with_levels(self) -> Pair:
        """Return this pair with levels of ``noisy``, measured against ``clean`` if the capture states none."""
        if self.noisy is None or self.noisy.noise_profile is not None:
            return self

        levels = measure_levels(self.clean.mosaic, self.noisy.mosaic)
        return replace(self, noisy=replace(self.noisy, noise_profile=levels), levels_from_clean=True)

    def with_own_noise(self, estimate: Callable[[Tensor, CFA], tuple[float, float] | None]) -> Pair:
        """Return this pair with the levels of ``clean``, from ``estimate(mosaic, cfa)`` if it states none."""
        if self.clean.noise_profile is not None:
            return self

        levels = estimate(self.clean.mosaic, self.cfa)
        return replace(self, clean=replace(self.clean, noise_profile=levels))

    def require_rendered(self) -> None:
        if not self.rendered:
            raise ValueError(
                f"{self.name}: has no sRGB picture, and its white balance and colour matrix are unknown; "
                "put the dataset's sRGB files or METADATA beside its RAW (docs/datasets.md)"
            )

    def in_pattern(self, cfa: CFA | str) -> Pair:
        """Crop the outer rows or columns so that the frames have the pattern ``cfa``."""
        target = CFA(cfa)
        if target == self.cfa:
            return self

        def crop(image: Tensor) -> Tensor:
            return crop_to_cfa(image, self.cfa, target).contiguous()

        return self._transform(crop, cfa=target)

    def middle(self, side: int) -> Pair:
        """Crop the middle ``side x side`` of the frames, or their full length along a shorter side; the CFA stays."""
        even_side = side // 2 * 2

        def crop(image: Tensor) -> Tensor:
            return centre(image, even_side, even_side)

        return self._transform(crop)

    def binned(self, factor: int, together: bool = False) -> Pair:
        """Shrink the frames to 1 / ``factor`` of their sides; noise then has about 1 / ``factor``^2 of its variance.

        :func:`rawaug.bayer.bin_mosaic` bins RAW and explains ``together``; pictures are averaged in linear light.

        Raises:
            ValueError: if a side is shorter than two of the new cells.
        """
        if factor == 1 and not together:
            return self

        cell = 2 * factor
        size = self.clean.mosaic.shape[-2:]
        height = size[0] // cell * cell
        width = size[1] // cell * cell
        if not min(height, width):
            raise ValueError(f"pair {self.name}: {tuple(size)} is too small to be binned by {factor}")

        def bin_image(image: Tensor) -> Tensor:
            whole_cells = image[:, :height, :width]
            if len(whole_cells) == 1:
                return bin_mosaic(whole_cells, self.cfa, factor, together)
            return _bin_picture(whole_cells, factor)

        return self._transform(bin_image, variance=bin_mosaic_variance(factor, together))

    def _transform(self, change: Callable[[Tensor], Tensor], cfa: CFA | None = None, variance: float = 1.0) -> Pair:
        """Copy the pair with ``change`` applied to every image, which multiplies the noise by ``variance``."""

        def change_frame(frame: RawFrame) -> RawFrame:
            levels = frame.noise_profile
            if levels is not None:
                levels = levels[0] * variance, levels[1] * variance
            return replace(frame, mosaic=change(frame.mosaic), cfa=cfa or frame.cfa, noise_profile=levels)

        changed = replace(self, clean=change_frame(self.clean), srgb=change(self.srgb), noisy=None, noisy_srgb=None)
        if self.noisy is not None:
            changed = replace(changed, noisy=change_frame(self.noisy))
        if self.noisy_srgb is not None:
            changed = replace(changed, noisy_srgb=change(self.noisy_srgb))
        return changed


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
