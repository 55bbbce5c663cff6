"""A RAW frame and the sRGB picture of the same shot: what an ISP is fitted on and measured against."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from rawaug.bayer import CFA
from rawaug.data.captured_noise import measured_levels


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

    @property
    def balance_known(self) -> bool:
        """Whether ``white_balance`` is the camera's."""
        return self.white_balance != (1.0, 1.0, 1.0)

    def with_levels(self) -> Pair:
        """This pair; the levels of a noisy capture that came without are measured against ``raw``."""
        if self.noisy is None or self.shot_var is not None:
            return self
        shot_var, read_var = measured_levels(self.raw, self.noisy)
        return replace(self, shot_var=shot_var, read_var=read_var, levels_from_clean=True)

    def require_rendered(self) -> None:
        """Refuse a pair whose colours are unknown.

        Raises:
            ValueError: if ``srgb`` is no rendering in the camera's colours.
        """
        if not self.rendered:
            raise ValueError(
                f"{self.name}: has no sRGB picture, and its white balance and colour matrix are unknown; "
                "put the dataset's sRGB files or METADATA beside its RAW (docs/datasets.md)"
            )

    def in_pattern(self, cfa: CFA | str) -> Pair:
        """The frame without the first row or column, where that gives it the pattern ``cfa``; sides stay even."""
        top, left = self.cfa.shift_to(CFA(cfa))
        if not (top or left):
            return self
        height, width = ((size - first) // 2 * 2 for size, first in zip(self.raw.shape[-2:], (top, left), strict=True))
        return self._window(slice(top, top + height), slice(left, left + width), CFA(cfa))

    def middle(self, side: int) -> Pair:
        """The middle ``side x side`` of the frame, or all of it along a side that is shorter; the CFA is kept."""
        top, left = ((size - side) // 4 * 2 if size > side else 0 for size in self.raw.shape[-2:])
        rows, columns = slice(top, top + side // 2 * 2), slice(left, left + side // 2 * 2)
        return self._window(rows, columns, self.cfa)

    def _window(self, rows: slice, columns: slice, cfa: CFA) -> Pair:
        images = {key: getattr(self, key) for key in ("srgb", "raw", "noisy", "noisy_srgb")}
        cut = {key: image[:, rows, columns].contiguous() for key, image in images.items() if image is not None}
        return replace(self, **cut, cfa=cfa)

    def _require_shape(self, field: str, image: Tensor, channels: int, dtype: torch.dtype) -> None:
        expected = (channels, *self.raw.shape[-2:])
        if tuple(image.shape) != expected or image.dtype != dtype:
            raise ValueError(
                f"pair {self.name}: {field} must be {dtype} {expected}, got {image.dtype} {tuple(image.shape)}"
            )
