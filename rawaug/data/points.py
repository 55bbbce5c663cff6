r"""Points of light on pictures: stars, street lamps, the glint of water and chrome.

    y = s x + sum_k a_k c_k integral over the pixel of N(p - p_k; spread)

in linear light, where x is a picture made darker by s, and a_k, c_k and p_k are the flux, colour and place of light k.
A lens and its sensor spread a point over at least a pixel: a light with a spread of 0.4 pixels, which is as sharp as
cameras are, keeps an eighth of its peak in each of the four pixels beside it. A hot pixel keeps none. Denoisers learn
the difference only if their training pictures have points of light, and photographs scaled down to be clean have few.
"""

from __future__ import annotations

import colorsys
import math

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import Dataset

from rawaug.data.opening import open_pictures
from rawaug.data.pairs import PICTURES
from rawaug.seeding import derive_seed

SPREAD = (0.4, 1.2)
"""Limits of the standard deviation of a light, in pixels; one lens has one, and each light is within a tenth of it."""
DENSITY = (1e-4, 6e-3)
"""Limits of the number of lights per pixel: from a street to a field of stars."""
FLUX = (0.03, 6.0)
"""Limits of the flux of a light, where 1 is a pixel at white; the brightest are clipped, as lamps are."""
DARKEST = 6.0
"""A picture is made darker by up to this many stops, half of the time; otherwise it keeps its light."""

_REACH = 5
_GAMMA = 2.2


class Lights(Dataset[Tensor]):
    """The pictures of a Dataset, uint8 ``(3, H, W)``, with points of light on them; picture i has the same every time.

    Example:
        >>> from rawaug.data.drawn import Shapes
        >>> Lights(Shapes(2, side=64))[1].shape
        torch.Size([3, 64, 64])
    """

    def __init__(self, pictures: Dataset[Tensor], seed: int = 0) -> None:
        self.pictures, self.seed = pictures, seed

    def __len__(self) -> int:
        return len(self.pictures)  # type: ignore[arg-type]

    def __getitem__(self, index: int) -> Tensor:
        return draw_lights(self.pictures[index], np.random.default_rng(derive_seed(self.seed, "lights", index)))


@PICTURES.register("lights")
def open_lights(path: str, min_side: int = 2) -> Lights:
    """Open ``lights:PICTURES``, where PICTURES is a folder or a kind, such as ``lights:shapes:100``."""
    return Lights(open_pictures(path, min_side))


def draw_lights(picture: Tensor, rng: np.random.Generator) -> Tensor:
    """Draw points of light on a picture, uint8 ``(3, H, W)``, of which half are made dark first."""
    height, width = picture.shape[-2:]
    linear = (picture.numpy() / 255.0) ** _GAMMA
    if rng.random() < 0.5:
        linear = linear * 2.0 ** -rng.uniform(0.0, DARKEST)

    density = _log_uniform(DENSITY, rng)
    number = 1 + int(rng.poisson(density * height * width))
    spreads = rng.uniform(*SPREAD) * rng.uniform(0.9, 1.1, number)
    fluxes = _log_uniform(FLUX, rng, number)
    rows, columns = rng.uniform(0, height, number), rng.uniform(0, width, number)

    margin = 2 * _REACH
    canvas = np.pad(linear, ((0, 0), (margin, margin), (margin, margin)))
    for spread, flux, row, column in zip(spreads, fluxes, rows, columns, strict=True):
        top, left = int(row) - _REACH, int(column) - _REACH
        profile = np.outer(_profile(row - top, spread), _profile(column - left, spread))
        window = np.s_[:, top + margin : top + margin + len(profile), left + margin : left + margin + len(profile)]
        canvas[window] += flux * _colour(rng)[:, None, None] * profile

    lit = canvas[:, margin : margin + height, margin : margin + width]
    return torch.from_numpy(np.rint(255.0 * lit.clip(0.0, 1.0) ** (1.0 / _GAMMA)).astype(np.uint8))


def _profile(centre: float, spread: float) -> np.ndarray:
    """Integrate a Gaussian around ``centre`` over each of ``2 _REACH + 1`` pixels, whose edges are whole numbers."""
    edges = [math.erf((edge - centre) / (math.sqrt(2.0) * spread)) for edge in range(2 * _REACH + 2)]
    return np.diff(edges) / 2.0


def _colour(rng: np.random.Generator) -> np.ndarray:
    """Draw the colour of a light, linear ``(3,)``: white half of the time, otherwise of any hue and saturation."""
    if rng.random() < 0.5:
        return np.ones(3)
    return np.array(colorsys.hsv_to_rgb(rng.random(), rng.random(), 1.0))


def _log_uniform(limits: tuple[float, float], rng: np.random.Generator, size: int | None = None) -> np.ndarray:
    return np.exp(rng.uniform(math.log(limits[0]), math.log(limits[1]), size))
