r"""The black level that masked pixels tell: sites beside the picture, under a shield that no light passes.

    black_k = mean of the digital numbers of the masked sites of colour k

after outliers are left out. LibRaw gives such margins where a camera's files have them. Each is halved along its
length, and a level is trusted where all halves agree, since margins may be dummies, or lit at their ends. Where numbers
end at 0 within the noise, the mean is not the level, and the margin tells nothing.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from rawaug.bayer import plane_indices

NEAR, LEAST = 2, 8
"""Lines beside the picture, which light may reach, are left out; a margin of fewer lines tells nothing."""
CLEAR, LARGEST, OUTLIER = 4.0, 0.01, 4.0
"""A level is another one than the file's if it is standard errors off, and implausible if it is this part of white off;
an outlier is standard deviations off."""
_AT_0 = 0.01

Levels = tuple[float, float, float, float]


@dataclass(frozen=True)
class MaskedPixels:
    """What the masked pixels of a frame tell, in digital numbers.

    Attributes:
        black: the levels of R, Gr, Gb, B; patterns whose greens are one have it twice.
        error: the standard error of one of them.
        spread: by how much the halves of the margins differ.
        sites: how many sites there are.
    """

    black: Levels
    error: float
    spread: float
    sites: int

    def corrects(self, black: Levels, white: float) -> bool:
        """Whether these levels are clearly others than the file's ``black``, and can be trusted."""
        off = max(abs(found - stated) for found, stated in zip(self.black, black, strict=True))
        return max(CLEAR * self.error, self.spread) < off < LARGEST * (white - max(black))


def measure_masked(numbers: np.ndarray, window: tuple[int, int, int, int], cfa: str) -> MaskedPixels | None:
    """Measure the black level of the margins around a picture.

    Args:
        numbers: all digital numbers that the file holds, ``(H, W)``.
        window: the picture's first row and column, its height and its width.
        cfa: the pattern of the picture, from its first site on.

    Returns:
        The levels, or None if no margin has :data:`LEAST` lines that vary, or a colour is missing in it.
    """
    kinds, sums = plane_indices(cfa).numpy(), []
    for part, row, column in _halves(numbers, window):
        size, (rows, columns) = len(kinds), part.shape
        of_part = kinds[(np.arange(rows) + row)[:, None] % size, (np.arange(columns) + column) % size]
        sums.append([_mean(part[of_part == kind]) for kind in np.unique(kinds)])
    if not sums or min(count for part in sums for _, _, count in part) == 0:
        return None
    means, variances, counts = np.moveaxis(np.array(sums), -1, 0)  # (parts, kinds) each
    levels = (means * counts).sum(0) / counts.sum(0)
    error = np.sqrt((variances * counts).sum(0) / counts.sum(0) / counts.sum(0)).max()
    by_kind: dict[int, float] = dict(zip(np.unique(kinds).tolist(), levels.tolist(), strict=True))
    black = by_kind[0], by_kind[1], by_kind.get(2, by_kind[1]), by_kind[3]
    return MaskedPixels(black, float(error), float(np.ptp((means - levels).mean(1))), int(counts.sum()))


def _halves(numbers: np.ndarray, window: tuple[int, int, int, int]) -> Iterator[tuple[np.ndarray, int, int]]:
    """The halves of each margin that tells something, and where they begin, from the picture's first site."""
    top, left, height, width = window
    rows, columns = slice(top, top + height), slice(left, left + width)
    sides = (
        (rows, slice(0, max(0, left - NEAR))),
        (rows, slice(left + width + NEAR, numbers.shape[1])),
        (slice(0, max(0, top - NEAR)), columns),
        (slice(top + height + NEAR, numbers.shape[0]), columns),
    )
    for along, (down, across) in enumerate(sides):
        margin, axis = numbers[down, across], 0 if along < 2 else 1
        if margin.shape[1 - axis] < LEAST - NEAR or (margin == 0).mean() > _AT_0 or np.ptp(margin, axis).mean() < 1:
            continue  # too few, clipped at 0, or made up: of one number a line
        middle = margin.shape[axis] // 2
        for part, moved in zip(np.split(margin, [middle], axis), (0, middle), strict=True):
            yield part, down.start - top + moved * (axis == 0), across.start - left + moved * (axis == 1)


def _mean(values: np.ndarray) -> tuple[float, float, int]:
    """Mean and variance without outliers, and the number of values that are left."""
    if not values.size:
        return 0.0, 0.0, 0
    low, middle, high = np.percentile(values, (16, 50, 84))
    kept = values[np.abs(values - middle) <= OUTLIER * ((high - low) / 2 + 0.5)].astype(np.float64)
    return float(kept.mean()), float(kept.var()), kept.size
