r"""Dead-leaves pictures: opaque disks that fall on each other, with the statistics of natural images.

    p(r) = C r^-3   for r_min <= r <= r_max,    centres uniform

With this law the pictures look alike at every scale, and have occlusion edges and a 1/f^2 power spectrum as photographs
do. Source: A. B. Lee, D. Mumford, J. Huang, "Occlusion models for natural images: a statistical study of a
scale-invariant dead leaves model", IJCV 41, 2001; as training data for restoration: R. Achddou, Y. Gousseau, S. Ladjal,
"Synthetic images as a regularity prior for image restoration neural networks", SSVM 2021.

Here a disk is a window of a photograph, or flat in one of its colours. Seen from below, the first leaf is on top: disks
are laid front to back on what is still bare, until nothing is, which draws exactly from the stationary model.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

_OVERSAMPLING = 2
_FLAT_SHARE = 0.25
_BATCH = 4096


def dead_leaves(
    height: int, width: int, sources: Sequence[Tensor], generator: torch.Generator, smallest_radius: float = 4.0
) -> Tensor:
    """One dead-leaves picture, uint8 ``(3, height, width)``, anti-aliased (each pixel the mean of 2 x 2).

    Args:
        height, width: in pixels, at least 8.
        sources: photographs for colours and textures, uint8 ``(3, h, w)``, sides at least 32; textures are drawn at
            half the photograph's scale.
        generator: the only source of randomness, on the CPU.
        smallest_radius: r_min in pixels, above 0.5; r_max is what fits into every source, a third of the picture's
            longer side at most.

    Raises:
        ValueError: if there is no source, or one of another shape or dtype or too small for r_min.

    Example:
        >>> source = torch.randint(0, 256, (3, 64, 64), dtype=torch.uint8)
        >>> dead_leaves(48, 64, [source], torch.Generator().manual_seed(0)).shape
        torch.Size([3, 48, 64])
    """
    for source in sources:
        if source.ndim != 3 or source.shape[0] != 3 or source.dtype != torch.uint8 or min(source.shape[1:]) < 32:
            raise ValueError(
                f"a source must be uint8 (3, h, w) with sides of at least 32, got {source.dtype} {tuple(source.shape)}"
            )
    if not sources or smallest_radius <= 0.5 or min(height, width) < 8:
        raise ValueError(f"dead leaves need sources ({len(sources)}), r_min > 0.5 and sides >= 8 ({height} x {width})")
    photographs = [source.permute(1, 2, 0).contiguous().numpy() for source in sources]
    fits = min(min(photograph.shape[:2]) for photograph in photographs) / 2 - 1
    radii = (_OVERSAMPLING * smallest_radius, min(fits, _OVERSAMPLING * max(height, width) / 3))
    if radii[0] >= radii[1]:
        raise ValueError(
            f"smallest_radius {smallest_radius} is too large: the sources allow at most {fits / _OVERSAMPLING}"
        )
    fine = _fine_picture(_OVERSAMPLING * height, _OVERSAMPLING * width, photographs, radii, generator)
    n = _OVERSAMPLING
    total = sum(fine[i::n, j::n].astype(np.uint16) for i in range(n) for j in range(n))
    return torch.from_numpy(np.rint(total / n**2).astype(np.uint8)).permute(2, 0, 1).contiguous()


def _fine_picture(
    height: int, width: int, photographs: list[np.ndarray], radii: tuple[float, float], generator: torch.Generator
) -> np.ndarray:
    """Disks front to back until every pixel is covered, uint8 ``(height, width, 3)``."""
    picture = np.zeros((height, width, 3), np.uint8)
    bare = np.ones((height, width), bool)
    smallest, largest = radii
    while bare.any():
        u = torch.rand(7, _BATCH, generator=generator, dtype=torch.float64).numpy()
        # inverse of the distribution function of r^-3 between the two radii
        radius = (smallest**-2 - u[0] * (smallest**-2 - largest**-2)) ** -0.5
        # centres as far outside as the largest disk reaches, so that the border is like the middle
        y = u[1] * (height + 2 * largest) - largest
        x = u[2] * (width + 2 * largest) - largest
        edges = _edges(y, x, radius, bare.shape)
        for k in np.flatnonzero(_bare_pixels(bare, edges)):
            disk, photograph = (y[k], x[k], radius[k]), photographs[int(u[3, k] * len(photographs))]
            _lay(picture, bare, disk, edges[:, k].tolist(), photograph, u[4:, k])
    return picture


def _edges(y: np.ndarray, x: np.ndarray, radius: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Top, bottom, left and right of each disk within the picture, ``(4, N)``; bottom and right are exclusive."""
    ends = [
        end.clip(0, side)
        for centre, side in ((y, shape[0]), (x, shape[1]))
        for end in (np.ceil(centre - radius), np.floor(centre + radius) + 1)
    ]
    return np.stack(ends).astype(np.int64)


def _bare_pixels(bare: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """How many pixels between the edges are bare, by summed areas; what is covered never becomes bare again."""
    areas = np.pad(bare.cumsum(0, dtype=np.int32).cumsum(1, dtype=np.int32), ((1, 0), (1, 0)))
    top, bottom, left, right = edges
    return np.asarray(areas[bottom, right] - areas[top, right] - areas[bottom, left] + areas[top, left])


def _lay(
    picture: np.ndarray,
    bare: np.ndarray,
    disk: tuple[float, float, float],
    edges: Sequence[int],
    photograph: np.ndarray,
    u: np.ndarray,
) -> None:
    """Put one disk (row, column, radius) where ``bare``; ``u`` are uniform: window (2), flat or textured."""
    (y, x, radius), (top, bottom, left, right) = disk, edges
    free = bare[top:bottom, left:right]
    if not free.any():
        return
    rows, columns = np.arange(top, bottom) - y, np.arange(left, right) - x
    leaf = free & (rows[:, None] ** 2 + columns**2 <= radius**2)
    i = int(u[0] * (photograph.shape[0] - (bottom - top)))
    j = int(u[1] * (photograph.shape[1] - (right - left)))
    window = photograph[i, j] if u[2] < _FLAT_SHARE else photograph[i : i + bottom - top, j : j + right - left]
    np.copyto(picture[top:bottom, left:right], window, where=leaf[..., None])
    free &= ~leaf
