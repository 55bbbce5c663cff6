"""Crops, turns and packing of mosaics as modules: `sample` draws, `apply` does it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

import torch
from torch import Tensor, nn
from torch.utils.data import get_worker_info

from rawaug.bayer.cfa import CFA, N_VIEWS, crop, pack, turn
from rawaug.bayer.patterns import pattern


class _Transform(nn.Module, ABC):
    """A module whose ``apply(raw, params)`` transforms; with only a function, it is still ``nn.Module.apply``.

    Without a generator, as in ``nn.Sequential``, it draws from ``seed``, the worker's number and the call's number.
    """

    def __init__(self, seed: int) -> None:
        super().__init__()
        self.seed, self._calls = seed, 0

    def _own(self, generator: torch.Generator | None) -> torch.Generator:
        if generator is not None:
            return generator
        from rawaug.seeding import keyed_generator, rank_key  # late: denoisers, which only turn mosaics, need no seeds

        self._calls += 1
        worker = get_worker_info()
        worker_seed = worker.seed if worker else 0
        return keyed_generator(self.seed, type(self).__name__, worker_seed, self._calls, *rank_key())

    def apply(self, raw: Any, params: Tensor | None = None) -> Any:
        if params is None:
            return super().apply(raw)
        return self._apply_params(raw, params)

    @abstractmethod
    def _apply_params(self, raw: Tensor, params: Tensor) -> Tensor: ...


def draw_corner(frame: tuple[int, int], size: tuple[int, int], generator: torch.Generator) -> tuple[int, int]:
    """Draw the even top and left of a crop of ``size`` in a frame, both (height, width); ValueError if it is larger."""
    (height, width), (rows, columns) = frame, size
    if height < rows or width < columns:
        raise ValueError(f"{height} x {width} is smaller than the crop {rows} x {columns}; choose a smaller crop")

    top = torch.randint((height - rows) // 2 + 1, (), generator=generator)
    left = torch.randint((width - columns) // 2 + 1, (), generator=generator)
    return 2 * int(top), 2 * int(left)


class RandomCrop(_Transform):
    """Crops mosaics ``(..., H, W)`` to ``(..., size, size)`` at a random even offset, so that the pattern stays.

    One draw serves the whole tensor, so stacked noisy and clean mosaics are cropped alike.

    Args:
        size: even side, or (height, width), in mosaic pixels, at most those of the mosaics.
        seed: of its own draws, where no generator is passed.

    Example:
        >>> crop = RandomCrop(4)
        >>> raw, generator = torch.rand(2, 1, 8, 12), torch.Generator().manual_seed(0)
        >>> params = crop.sample(8, 12, generator)
        >>> crop.apply(raw, params).shape
        torch.Size([2, 1, 4, 4])
    """

    def __init__(self, size: int | tuple[int, int], seed: int = 0) -> None:
        super().__init__(seed)
        if isinstance(size, int):
            size = (size, size)
        for side in size:
            if side % 2 or side < 2:
                raise ValueError(f"crop must be even and at least 2, got {size[0]} x {size[1]}")
        self.size = size

    def sample(self, height: int, width: int, generator: torch.Generator) -> Tensor:
        """Draw the top and left ``(2,)`` of a crop of a mosaic of ``height`` x ``width``."""
        return torch.tensor(draw_corner((height, width), self.size, generator))

    def _apply_params(self, raw: Tensor, params: Tensor) -> Tensor:
        top, left = params.tolist()
        return crop(raw, top, left, *self.size)

    def forward(self, raw: Tensor, generator: torch.Generator | None = None) -> Tensor:
        """Crop ``(..., H, W)`` at an offset drawn from ``generator``."""
        return self._apply_params(raw, self.sample(raw.shape[-2], raw.shape[-1], self._own(generator)))


class RandomView(_Transform):
    """Flips or turns mosaics ``(..., H, W)`` in one of eight ways, the same for the whole tensor.

    Args:
        cfa: pattern of the mosaics.
        keep_cfa: crop a line on either side where the pattern would move; otherwise it becomes ``cfa.turn(view)``.
        quarter: draw quarter turns too; without them the sides are not exchanged.
        seed: of its own draws, where no generator is passed.

    Example:
        >>> turn = RandomView("GRBG")
        >>> turn.apply(torch.rand(1, 1, 8, 12), torch.tensor(2)).shape
        torch.Size([1, 1, 6, 12])
    """

    def __init__(self, cfa: CFA | str, keep_cfa: bool = True, quarter: bool = True, seed: int = 0) -> None:
        super().__init__(seed)
        self.cfa = CFA(cfa)
        self.keep_cfa = keep_cfa
        self.views = N_VIEWS if quarter else N_VIEWS // 2

    def sample(self, generator: torch.Generator) -> Tensor:
        """Draw the view, a scalar."""
        return torch.randint(self.views, (), generator=generator)

    def _apply_params(self, raw: Tensor, params: Tensor) -> Tensor:
        view = int(params)
        if self.keep_cfa:
            return pattern(self.cfa).turn_keeping(raw, view)
        return turn(raw, view)

    def forward(self, raw: Tensor, generator: torch.Generator | None = None) -> Tensor:
        """Turn ``(..., H, W)`` by a view drawn from ``generator``."""
        return self._apply_params(raw, self.sample(self._own(generator)))


class Pack(nn.Module):
    """:func:`pack` as a module."""

    def __init__(self, cfa: CFA | str) -> None:
        super().__init__()
        self.cfa = CFA(cfa)

    def forward(self, mosaic: Tensor) -> Tensor:
        """Pack ``(..., 1, H, W)`` to ``(..., 4, H/2, W/2)``."""
        return pack(mosaic, self.cfa)
