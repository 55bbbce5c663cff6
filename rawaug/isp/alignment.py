r"""Alignment of a handheld bracket: how far each exposure moved, and what moved within the scene.

A tile of an exposure is displaced by the d that maximises its phase correlation with the same tile of the reference
(Guizar-Sicairos, Thurman, Fienup, Optics Letters 2008), computed on ``log E`` above a spatial frequency, in which an
exposure is a constant. A camera in a hand turns and shifts a little, so all tiles follow

    d(p) = A p + b

up to a pixel. RANSAC (Fischler, Bolles 1981) finds A and b although people and leaves move by themselves; if fewer than
half of the tiles follow, the scene has moved in parts and no such map exists. After the alignment, exposures k and
reference 0 differ in places where ``|E_k - E_0|``, averaged over 5 x 5 pixels, exceeds three times its usual size at
this brightness, which noise explains, and a tenth of the light: something was there in one of them only.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from scipy import ndimage
from torch import Tensor

from rawaug.errors import extra

TILE, LEAST_TILE = 256, 32
"""Sides of a tile in pixels: about the first, a quarter of the side of a small picture, but never below the second."""

_COARSE = 1024
"""The shift of the whole frame is first found with at most this many pixels a side."""

_FOLLOWS = 1.0
"""A tile follows the frame's motion if it is at most this many pixels away from it."""

_LIKENESS = 0.3
"""Minimum correlation of a tile with its reference after it was moved; below it there is too little to see."""

_DARK = 0.004
"""Light, white = 1, at which noise hides as much as it shows."""


class Motion(NamedTuple):
    """The motion of an exposure against the reference.

    Args:
        matrix: ``(2, 3)``: the pixel (y, x) of the reference lies at ``matrix @ (y, x, 1)`` in the exposure.
        pixels: the largest distance that a corner has moved.
        tiles: number of tiles with enough detail to follow.
        astray: number of those that moved otherwise, by more than a pixel.
    """

    matrix: np.ndarray
    pixels: float
    tiles: int
    astray: int


def find_motion(reference: Tensor, light: Tensor, clear: Tensor) -> Motion:
    """Find how an exposure moved against the reference.

    Args:
        reference: scene light ``(H, W)`` of the reference, exposure divided out.
        light: the same of the exposure.
        clear: ``(H, W)`` in [0, 1], 0 where one of the two is clipped.

    Returns:
        The motion; with no tile that has enough detail, no motion.

    Raises:
        ValueError: if fewer than half of the tiles follow one motion.

    Example:
        >>> scene = torch.rand(256, 256, generator=torch.Generator().manual_seed(0))
        >>> motion = find_motion(scene, scene.roll((2, 5), (0, 1)), torch.ones(256, 256))
        >>> [round(float(shift)) for shift in motion.matrix[:, 2]]
        [2, 5]
    """
    with extra("raw"):
        from skimage.measure import ransac
        from skimage.transform import AffineTransform

    first, second = _details(reference, clear), _details(light, clear)
    height, width = first.shape

    # The shift of the whole frame, on a smaller copy.
    step = max(1, math.ceil(max(height, width) / _COARSE))
    shift, _ = _displacement(first[::step, ::step], second[::step, ::step], upsampled=1)
    shift = np.round(shift * step).astype(int)

    # The displacements of its tiles, each looked for where the shift leads.
    tile = []
    for side in (height, width):
        tiles_across = max(4, round(side / TILE))
        tile.append(max(LEAST_TILE, side // tiles_across))
    centres, places = [], []
    for top in range(0, height - tile[0] + 1, tile[0]):
        for left in range(0, width - tile[1] + 1, tile[1]):
            y, x = top + shift[0], left + shift[1]
            if min(y, x) < 0 or y + tile[0] > height or x + tile[1] > width:
                continue
            here = first[top : top + tile[0], left : left + tile[1]]
            there = second[y : y + tile[0], x : x + tile[1]]
            displacement, likeness = _displacement(here, there)
            if likeness < _LIKENESS or np.abs(displacement).max() > min(tile) / 4:
                continue
            centre = np.array([top + tile[0] / 2, left + tile[1] / 2])
            centres.append(centre)
            places.append(centre + shift + displacement)
    if not centres:
        return Motion(np.eye(2, 3), 0.0, 0, 0)

    # One motion for all: a shift, or with enough tiles an affine map.
    source, target = np.array(centres), np.array(places)
    matrix = np.eye(2, 3)
    matrix[:, 2] = np.median(target - source, axis=0)
    follows = _distances(matrix, source, target) <= _FOLLOWS
    if len(centres) >= 8:
        model, follows = ransac(
            (source, target), AffineTransform, min_samples=3, residual_threshold=_FOLLOWS, max_trials=200, rng=0
        )
        matrix = model.params[:2]
    if follows.sum() * 2 < len(centres):
        moved = np.ptp(target - source, axis=0).max()
        raise ValueError(
            f"{len(centres) - follows.sum()} of {len(centres)} parts moved otherwise than the frame, by up to "
            f"{moved:.0f} pixels, so no single motion aligns it; use a tripod, or leave this exposure out"
        )

    corners = np.array([[0, 0], [0, width], [height, 0], [height, width]], float)
    pixels = float(_distances(matrix, corners, corners).max())
    return Motion(matrix, pixels, len(centres), int(len(centres) - follows.sum()))


def move_back(image: Tensor, motion: Motion) -> Tensor:
    """Bring an image ``(1, C, H, W)`` of an exposure to the reference's pixels, bicubically; zero lies beyond it."""
    height, width = image.shape[-2:]
    matrix = torch.from_numpy(motion.matrix).float()
    y, x = torch.arange(height).float()[:, None], torch.arange(width).float()
    source_y = matrix[0, 0] * y + matrix[0, 1] * x + matrix[0, 2]
    source_x = matrix[1, 0] * y + matrix[1, 1] * x + matrix[1, 2]
    grid = torch.stack(((2 * source_x + 1) / width - 1, (2 * source_y + 1) / height - 1), dim=-1)
    return F.grid_sample(image, grid[None], mode="bicubic", align_corners=False)


def find_contradictions(reference: Tensor, light: Tensor, clear: Tensor) -> Tensor:
    """Find where an aligned exposure shows something else than the reference.

    Args:
        reference, light: scene light ``(1, 3, H, W)``, exposure divided out.
        clear: ``(1, 1, H, W)`` in [0, 1], 0 where one of the two is clipped, or not seen at all.

    Returns:
        ``(1, 1, H, W)`` in [0, 1]: 1 where it contradicts.
    """
    difference = F.avg_pool2d((light - reference) * clear, 5, stride=1, padding=2).abs().amax(1, keepdim=True)
    brightness = F.avg_pool2d(reference.amax(1, keepdim=True), 5, stride=1, padding=2)

    # The usual difference by brightness, from sixteen equally filled bins of every tenth pixel.
    seen = clear > 0.5
    values, levels = difference[seen][::10].numpy(), brightness[seen][::10].numpy()
    if not len(values):
        return torch.zeros_like(clear)
    edges = np.quantile(levels, np.linspace(0, 1, 17))[1:-1]
    numbers = np.searchsorted(edges, levels)
    usual = np.zeros(16, np.float32)
    for number in np.unique(numbers):
        usual[number] = np.median(values[numbers == number])

    bins = torch.bucketize(brightness, torch.from_numpy(edges).float())
    limit = 3 * torch.from_numpy(usual)[bins] + 0.1 * brightness
    contradicts = ((difference > limit) & seen).float()
    contradicts = F.max_pool2d(F.avg_pool2d(contradicts, 5, stride=1, padding=2).gt(0.5).float(), 9, 1, 4)
    return F.avg_pool2d(contradicts, 9, stride=1, padding=4)


def _details(light: Tensor, clear: Tensor) -> np.ndarray:
    """Compute log light above a spatial frequency, ``(H, W)``, faded out where it is dark or clipped."""
    linear = light.numpy().clip(0)
    logarithm = np.log(linear + _DARK)
    details: np.ndarray = (logarithm - ndimage.gaussian_filter(logarithm, 8.0)) * clear.numpy()
    return details * (linear / (linear + _DARK))


def _displacement(here: np.ndarray, there: np.ndarray, upsampled: int = 20) -> tuple[np.ndarray, float]:
    """Find the displacement (y, x) of a tile, and the correlation of the two tiles after it was undone."""
    with extra("raw"):
        from skimage.registration import phase_cross_correlation

    window = np.outer(np.hanning(here.shape[0]), np.hanning(here.shape[1]))
    here, faded = here * window, there * window
    if min(np.linalg.norm(here), np.linalg.norm(faded)) < 1e-6:
        return np.zeros(2), 0.0

    shift, _, _ = phase_cross_correlation(here, faded, upsample_factor=upsampled)
    undone = ndimage.shift(there, shift, order=1) * window
    likeness = (here * undone).sum() / (np.linalg.norm(here) * np.linalg.norm(undone) + 1e-12)
    return -np.asarray(shift), float(likeness)


def _distances(matrix: np.ndarray, source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Compute the distances ``(N,)`` of points ``(N, 2)`` from where the map takes their sources."""
    return np.linalg.norm(source @ matrix[:, :2].T + matrix[:, 2] - target, axis=1)
