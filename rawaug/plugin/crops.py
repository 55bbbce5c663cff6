"""Crops and turns of pictures. They are drawn first, kept as :class:`rawaug.AugmentParams` does, and then cut out."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, SupportsIndex

import torch
from torch import Tensor
from torch.nn import functional as F

from rawaug import bayer
from rawaug.bayer.transforms import draw_corner
from rawaug.kernels.runtime import one_thread
from rawaug.plugin.pictures import to_rgb_tensor, trim_to_even


def crop_size(crop: int | Sequence[int] | None) -> tuple[int, int] | None:
    """Turn a crop that is given as one side or as both into (height, width); None means whole pictures.

    Raises:
        ValueError: if a side is odd, or ``crop`` is neither.
    """
    if crop is None:
        return None

    sides: tuple[Any, ...] = ()
    if isinstance(crop, SupportsIndex):
        sides = (crop, crop)
    elif isinstance(crop, Sequence):
        sides = tuple(crop)
    if len(sides) != 2 or not all(isinstance(side, SupportsIndex) for side in sides):
        raise ValueError(f"crop must be an even side or (height, width), got {crop!r}")

    height, width = sides
    return bayer.RandomCrop((int(height), int(width))).size


def draw_crop(
    frame: tuple[int, int],
    size: tuple[int, int] | None,
    views: bool,
    generator: torch.Generator,
    zoom: float = 1.0,
) -> Tensor:
    """Draw where a picture is cropped and how the crop is turned, as :class:`AugmentParams` keeps it.

    Args:
        frame: height and width of the picture, even.
        size: height and width of the crop; None for the whole picture.
        views: whether to draw flips and, for a square, quarter turns.
        generator: a generator on the CPU.
        zoom: half of the crops are enlarged by up to this factor.

    Returns:
        ``(5,)`` top, left, H, W, view; with a zoom ``(6,)``, where the last is the number of rows before enlarging.
    """
    height, width = frame
    region = size or (height, width)

    if size and zoom > 1.0:
        share, exponent = torch.rand(2, generator=generator).tolist()
        rows = size[0]
        if share >= 0.5:
            rows = math.ceil(size[0] / 2 * zoom**-exponent) * 2
        smaller = draw_crop(frame, _region(size, rows), views, generator)
        return torch.cat([smaller, torch.tensor([rows])])

    top, left = draw_corner(frame, region, generator)
    view = 0
    if views:
        count = bayer.N_VIEWS if region[0] == region[1] else bayer.N_VIEWS // 2  # quarter turns exchange the sides
        view = int(torch.randint(count, (), generator=generator))
    return torch.tensor([top, left, height, width, view])


def draw_patch(
    picture: Any,
    size: tuple[int, int] | None,
    views: bool,
    generator: torch.Generator,
    zoom: float = 1.0,
    bgr: bool = False,
) -> tuple[Tensor, Tensor]:
    """Draw a crop of a picture in any form, and cut it out.

    Args:
        picture: in any form that :mod:`rawaug.plugin.pictures` lists.
        size: height and width of the crop; None for the whole picture.
        views, generator, zoom: as for :func:`draw_crop`.
        bgr: whether the picture's channels are in the order B, G, R.

    Returns:
        The patch ``(3, *size)``, uint8 or float32, and its crop ``(5,)`` or ``(6,)``.
    """
    image = trim_to_even(to_rgb_tensor(picture, bgr))
    crop = draw_crop((image.shape[-2], image.shape[-1]), size, views, generator, zoom)
    return cut_patch(image, crop, size), crop


def read_patch(
    pictures: Any,
    index: int,
    size: tuple[int, int],
    views: bool,
    generator: torch.Generator,
    zoom: float = 1.0,
    bgr: bool = False,
) -> tuple[Tensor, Tensor]:
    """Draw a crop of a picture before it is read, and read no more of it than the crop needs.

    Args:
        pictures: a dataset with ``read_part``, such as :class:`rawaug.data.PictureFolder`.
        index: of the picture.
        size, views, generator, zoom, bgr: as for :func:`draw_patch`, which draws the same crop.
    """
    start = generator.get_state()
    crop, view = torch.empty(0), 0
    fault: ValueError | None = None

    def choose(height: int, width: int) -> tuple[int, int, int, int]:
        nonlocal crop, view, fault
        generator.set_state(start)  # another file may stand in for one that turns out to be damaged
        try:
            crop = draw_crop((height // 2 * 2, width // 2 * 2), size, views, generator, zoom)
        except ValueError as error:  # the crop is at fault, not the file
            fault = error
            return 0, 0, 2, 2
        top, left, _, _, view, rows = (*crop.tolist(), 0)[:6]
        return top, left, *_region(size, rows)

    region = pictures.read_part(index, choose)
    if fault is not None:
        raise fault
    return _turn(region.flip(-3) if bgr else region, view, size), crop


def cut_patch(picture: Tensor, crop: Tensor, size: tuple[int, int] | None) -> Tensor:
    """Cut the patch ``(3, *size)`` of a drawn crop ``(5,)`` or ``(6,)`` out of a whole picture ``(3, H, W)``.

    Raises:
        ValueError: if the crop was drawn for a picture of another size.
    """
    top, left, height, width, view, rows = (*crop.tolist(), 0)[:6]
    if picture.shape[-2:] != (height, width):
        raise ValueError(f"the parameters belong to a picture of {height} x {width}, got {tuple(picture.shape[-2:])}")
    region = (height, width) if size is None else _region(size, rows)
    return _turn(bayer.crop(picture, top, left, *region), view, size)


def _turn(region: Tensor, view: int, size: tuple[int, int] | None) -> Tensor:
    """Enlarge a region of a picture to the size of the crop, and turn it."""
    if size is not None and region.shape[-2:] != size:
        region = enlarge(region, size)
    return bayer.turn(region, view).contiguous()


def _region(size: tuple[int, int], rows: int) -> tuple[int, int]:
    """Even height and width of the region of ``rows`` that is enlarged to the crop; 0 rows mean the crop itself."""
    if not rows:
        return size
    return rows, math.ceil(size[1] * rows / size[0] / 2) * 2


def enlarge(patch: Tensor, size: tuple[int, int]) -> Tensor:
    """Enlarge a patch ``(3, h, w)`` to ``(3, *size)`` by bicubic interpolation; it keeps its type, uint8 or float."""
    with one_thread():  # the same bits everywhere
        larger = F.interpolate(patch[None].float(), size=size, mode="bicubic", align_corners=False)[0]

    if patch.dtype == torch.uint8:
        return larger.round_().clamp_(0, 255).to(torch.uint8)
    return larger.clamp_(0.0, 1.0).to(patch.dtype)
