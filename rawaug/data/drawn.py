r"""Drawn pictures with the statistics of natural images: dead leaves, and shapes like those of man-made things.

    p(r) = C r^-3   for r_min <= r <= r_max,    centres uniform

With this law of sizes, pictures look alike at every scale, and have occlusion edges and a 1/f^2 power spectrum, as
photographs do. *Dead leaves* are disks that hide each other; each is a window of a photograph, or flat in one of its
colours. Seen from below, the first leaf is on top, so disks are laid front to back on the pixels that are still bare,
until none is left. This draws exactly from the stationary model. *Shapes* are boxes, ellipses, polygons, stripes and
lettering. Photographs of landscapes have few long straight edges and no text, and a denoiser trained on them alone is
weakest there.

Sources: A. B. Lee, D. Mumford, J. Huang, "Occlusion models for natural images: a statistical study of a scale-invariant
dead leaves model", IJCV 41, 2001; as training data for restoration: R. Achddou, Y. Gousseau, S. Ladjal, "Synthetic
images as a regularity prior for image restoration neural networks", SSVM 2021.
"""

from __future__ import annotations

import colorsys
import math
import string
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import Dataset

from rawaug.data.pairs import PICTURES
from rawaug.errors import extra
from rawaug.seeding import derive_seed

_OVERSAMPLING = 2
_FLAT_SHARE = 0.25
_BATCH = 4096
_LEAST_RADIUS = 4.0
"""The smallest radius of a leaf, in pixels of the picture."""


def dead_leaves(height: int, width: int, sources: Sequence[Tensor], generator: torch.Generator) -> Tensor:
    """Draw a dead-leaves picture, uint8 ``(3, height, width)``, anti-aliased (each pixel the mean of 2 x 2).

    Args:
        height, width: in pixels, at least 16. Radii range from 4 pixels to a third of the longer side, or to the
            largest that fits into a source.
        sources: photographs for colours and textures, uint8 ``(3, h, w)``, sides at least 32, used at half their scale.
        generator: the only source of randomness, on the CPU.

    Example:
        >>> source = torch.randint(0, 256, (3, 64, 64), dtype=torch.uint8)
        >>> dead_leaves(48, 64, [source], torch.Generator().manual_seed(0)).shape
        torch.Size([3, 48, 64])
    """
    for source in sources:
        if source.ndim != 3 or source.shape[0] != 3 or source.dtype != torch.uint8 or min(source.shape[1:]) < 32:
            got = f"{source.dtype} {tuple(source.shape)}"
            raise ValueError(f"a source must be uint8 (3, h, w) with sides of at least 32, got {got}")
    if not sources or min(height, width) < 16:
        raise ValueError(f"dead leaves need sources ({len(sources)}) and sides of at least 16 ({height} x {width})")
    n = _OVERSAMPLING
    photographs = []
    largest = n * max(height, width) / 3
    for source in sources:
        photographs.append(source.permute(1, 2, 0).contiguous().numpy())
        largest = min(largest, min(source.shape[1:]) / 2 - 1)
    fine = _fine_picture(n * height, n * width, photographs, (n * _LEAST_RADIUS, largest), generator)

    cells = fine.reshape(height, n, width, n, 3)
    mean = cells.sum(axis=(1, 3), dtype=np.uint16) / n**2
    return torch.from_numpy(np.rint(mean).astype(np.uint8)).permute(2, 0, 1).contiguous()


def _fine_picture(
    height: int, width: int, photographs: list[np.ndarray], radii: tuple[float, float], generator: torch.Generator
) -> np.ndarray:
    """Lay disks front to back until every pixel is covered, uint8 ``(height, width, 3)``."""
    picture = np.zeros((height, width, 3), np.uint8)
    bare = np.ones((height, width), bool)
    smallest, largest = radii
    while bare.any():
        u = torch.rand(7, _BATCH, generator=generator, dtype=torch.float64).numpy()

        # the inverse of the distribution function of r^-3 between the two radii
        radius = (smallest**-2 - u[0] * (smallest**-2 - largest**-2)) ** -0.5

        # some centres lie outside, as far as the largest disk reaches, so that the border resembles the middle
        y = u[1] * (height + 2 * largest) - largest
        x = u[2] * (width + 2 * largest) - largest

        edges = _edges(y, x, radius, bare.shape)
        for k in np.flatnonzero(_bare_pixels(bare, edges)):
            disk = (y[k], x[k], radius[k])
            photograph = photographs[int(u[3, k] * len(photographs))]
            _lay(picture, bare, disk, edges[:, k].tolist(), photograph, u[4:, k])
    return picture


def _edges(y: np.ndarray, x: np.ndarray, radius: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Top, bottom, left and right of each disk within the picture, ``(4, N)``; bottom and right are exclusive."""
    top = np.ceil(y - radius).clip(0, shape[0])
    bottom = (np.floor(y + radius) + 1).clip(0, shape[0])
    left = np.ceil(x - radius).clip(0, shape[1])
    right = (np.floor(x + radius) + 1).clip(0, shape[1])
    return np.stack([top, bottom, left, right]).astype(np.int64)


def _bare_pixels(bare: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Count the bare pixels between the edges by summed areas; covered pixels never become bare again."""
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
    """Draw the bare part of a disk (row, column, radius), flat or textured by a window of a photograph.

    The uniform numbers ``u`` choose the place of the window (two) and whether the disk is flat.
    """
    y, x, radius = disk
    top, bottom, left, right = edges
    free = bare[top:bottom, left:right]
    if not free.any():
        return

    rows = np.arange(top, bottom) - y
    columns = np.arange(left, right) - x
    leaf = free & (rows[:, None] ** 2 + columns**2 <= radius**2)

    height, width = bottom - top, right - left
    i = int(u[0] * (photograph.shape[0] - height))
    j = int(u[1] * (photograph.shape[1] - width))
    window = photograph[i : i + height, j : j + width]
    if u[2] < _FLAT_SHARE:
        window = photograph[i, j]
    np.copyto(picture[top:bottom, left:right], window, where=leaf[..., None])
    free &= ~leaf


SIDE = 640

_SMALLEST = (4.0, 8.0, 16.0)
_LARGEST = (80.0, 160.0, 300.0)
_COVER = (1.5, 3.0, 6.0)
"""Total area of the shapes, relative to the picture's area."""
_BLUR = (0.0, 0.0, 0.5, 0.8, 1.2)
"""Limits of the blur's standard deviation, in pixels."""
_FONT = (16.0, 160.0)
"""Smallest and largest size of letters, in pixels of the oversampled picture."""
_LETTERS = string.ascii_letters + string.digits + "   .,-"

Colour = tuple[int, int, int]
Rng = np.random.Generator


class Shapes(Dataset[Tensor]):
    """A Dataset of ``count`` different pictures, uint8 ``(3, side, side)``, drawn on access in half a second each.

    Picture i depends on (seed, i) alone.

    Example:
        >>> Shapes(2, side=64)[1].shape
        torch.Size([3, 64, 64])
    """

    def __init__(self, count: int, side: int = SIDE, seed: int = 0) -> None:
        if count < 1 or side < 32:
            raise ValueError(f"shapes: needs a count of at least 1 and a side of at least 32, got {count} and {side}")
        self.count, self.side, self.seed = count, side, seed

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, index: int) -> Tensor:
        number = range(self.count)[index]
        return draw_shapes(self.side, np.random.default_rng(derive_seed(self.seed, "shapes", number)))


@PICTURES.register("shapes")
def open_shapes(path: str = "", min_side: int = 2) -> Shapes:
    """Open ``shapes:100``, a hundred pictures with sides of :data:`SIDE`, or of ``min_side`` if it is larger."""
    if not path.isdecimal():
        raise ValueError(f"shapes:{path}: write the number of pictures, such as shapes:100")
    return Shapes(int(path), max(SIDE, min_side))


def draw_shapes(side: int, rng: Rng) -> Tensor:
    """Draw a picture, uint8 ``(3, side, side)``: anti-aliased shapes of two to six kinds, shaded, some out of focus."""
    with extra("train"):
        from PIL import Image, ImageFilter

    fine = side * _OVERSAMPLING
    picture = Image.new("RGB", (fine, fine), _colour(rng))
    smallest = _OVERSAMPLING * rng.choice(_SMALLEST)
    largest = _OVERSAMPLING * rng.choice(_LARGEST)
    kinds = rng.permutation(list(KINDS))[: rng.integers(2, len(KINDS) + 1)]

    area = rng.choice(_COVER) * fine**2
    while area > 0:
        u = rng.random()
        radius = ((1 - u) * smallest**-2 + u * largest**-2) ** -0.5  # inverse of the distribution function of R^-3
        centre = rng.random(2) * fine
        draw = KINDS[str(rng.choice(kinds))]
        draw(picture, centre, radius, rng)
        area -= 3 * radius**2

    picture = picture.resize((side, side), Image.Resampling.BOX)
    blur = float(rng.choice(_BLUR))
    if blur:
        picture = picture.filter(ImageFilter.GaussianBlur(blur))
    return _shaded(np.asarray(picture, np.float32), rng)


def _shaded(picture: np.ndarray, rng: Rng) -> Tensor:
    """Light a picture ``(side, side, 3)`` from one side; returns uint8 ``(3, side, side)``."""
    distance = np.linspace(-0.5, 0.5, len(picture), dtype=np.float32)
    down, right = rng.normal(0.0, 0.35, 2).astype(np.float32)
    lit = picture * np.exp(down * distance[:, None] + right * distance)[..., None]
    return torch.from_numpy(lit.clip(0, 255).round().astype(np.uint8)).permute(2, 0, 1).contiguous()


def _colour(rng: Rng) -> Colour:
    """Draw a colour of any hue, mostly pale; its value is uniform except for rare extremes."""
    hue = rng.random()
    saturation = min(1.0, abs(rng.normal(0.0, 0.35)))
    value = rng.beta(1.2, 1.2)
    red, green, blue = colorsys.hsv_to_rgb(hue, saturation, value)
    return int(255 * red), int(255 * green), int(255 * blue)


def _ellipse(picture: Any, centre: np.ndarray, radius: float, rng: Rng) -> None:
    half = radius * np.exp(rng.normal(0.0, 0.3, 2))
    _brush(picture).ellipse([*(centre - half), *(centre + half)], fill=_colour(rng))


def _boxes(picture: Any, centre: np.ndarray, radius: float, rng: Rng, angle: float, stripes: int = 0) -> None:
    """Draw a box, and as many stripes of another colour across it."""
    half_width, half_height = radius * np.exp(rng.normal(0.0, 0.6, 2))
    cosine, sine = math.cos(angle), math.sin(angle)

    def lay(left: float, right: float, colour: Colour) -> None:
        points = []
        for x, y in ((left, -half_height), (right, -half_height), (right, half_height), (left, half_height)):
            turned_x, turned_y = cosine * x - sine * y, sine * x + cosine * y
            points.append((centre[0] + turned_x, centre[1] + turned_y))
        _brush(picture).polygon(points, fill=colour)

    lay(-half_width, half_width, _colour(rng))
    if stripes:
        background, width = _colour(rng), max(2.0 * _OVERSAMPLING, half_width / stripes)
        for left in np.arange(-half_width, half_width, 2 * width):
            lay(left, min(half_width, left + width), background)


def _polygon(picture: Any, centre: np.ndarray, radius: float, rng: Rng) -> None:
    angles = np.sort(rng.random(rng.integers(3, 8))) * 2 * math.pi
    radii = radius * rng.uniform(0.5, 1.2, len(angles))
    corners = zip(centre[0] + radii * np.cos(angles), centre[1] + radii * np.sin(angles), strict=True)
    _brush(picture).polygon(list(corners), fill=_colour(rng))


def _lettering(picture: Any, centre: np.ndarray, radius: float, rng: Rng) -> None:
    from PIL import Image, ImageFont

    font = ImageFont.load_default(min(max(radius / 2, _FONT[0]), _FONT[1]))
    text = "".join(rng.choice(list(_LETTERS), rng.integers(3, 24)))
    _, _, right, bottom = _brush(picture).textbbox((0, 0), text, font=font)
    label = Image.new("L", (int(right) + 4, int(bottom) + 4), 0)
    _brush(label).text((2, 2), text, fill=255, font=font)
    angle = float(rng.choice([0.0, 0.0, 90.0, 270.0, rng.random() * 360.0]))
    label = label.rotate(angle, expand=True, resample=Image.Resampling.BICUBIC)
    corner = (int(centre[0]) - label.width // 2, int(centre[1]) - label.height // 2)
    picture.paste(_colour(rng), corner, label)


def _brush(picture: Any) -> Any:
    from PIL import ImageDraw

    return ImageDraw.Draw(picture)


KINDS: dict[str, Callable[[Any, np.ndarray, float, Rng], None]] = {
    "ellipse": _ellipse,
    "box": lambda picture, at, radius, rng: _boxes(picture, at, radius, rng, rng.random() * math.pi),
    "upright box": lambda picture, at, radius, rng: _boxes(picture, at, radius, rng, rng.normal(0.0, 0.03)),
    "polygon": _polygon,
    "stripes": lambda picture, at, radius, rng: _boxes(
        picture, at, radius, rng, rng.random() * math.pi, stripes=int(rng.integers(2, 20))
    ),
    "lettering": _lettering,
}
"""The functions that draw each kind of shape: ``draw(PIL picture, centre, radius, rng)``, in oversampled pixels."""
