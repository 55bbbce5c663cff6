"""Random pixels of RAW-sRGB pairs, on which an ISP is fitted.

Given its parameters the ISP is pointwise up to the mosaic, so a random subset of pixels represents a frame. A mosaic
site has one colour: ``target`` holds its reading and ``known`` says in which channel. The 2 x 2 cell around it,
averaged, gives the forward pass all three colours. Pairs that are not registered pixel by pixel (a camera's own JPEG)
are compared as averages over blocks instead, where every channel is known.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple, Protocol

import torch
import torch.nn.functional as F
from torch import Tensor

from rawaug import bayer
from rawaug.bayer import CFA
from rawaug.errors import extra
from rawaug.isp.encoders import thumbnail
from rawaug.isp.functional import as_float, frame_coordinates
from rawaug.seeding import keyed_generator

_CLIPPED_SRGB = 0.98
"""The value from which a picture counts as clipped."""
CLIPPED_RAW = 0.98
"""The value from which a reading counts as clipped."""
LEAST_LIKENESS = 0.8
"""Minimum correlation of the greens of an unregistered pair, after the shift is removed."""
BLOCK = 16
"""Side in pixels of the blocks over which unregistered pairs are averaged."""


class Frame(Protocol):
    """A mosaic and its colours; :class:`rawaug.io.RawFrame` is one."""

    @property
    def mosaic(self) -> Tensor:
        """The readings ``(1, H, W)``, black 0 and white 1."""

    @property
    def white_balance(self) -> tuple[float, float, float]:
        """The as-shot multipliers of R, G and B."""

    @property
    def camera(self) -> str:
        """Maker and model."""

    @property
    def color_known(self) -> bool:
        """Whether the white balance and the colour matrix are the camera's own."""


class FramePair(Protocol):
    """A frame that a fit accepts; :class:`rawaug.data.Pair` is one."""

    @property
    def name(self) -> str:
        """The name of the frame, which keys the pixels that are drawn."""

    @property
    def srgb(self) -> Tensor:
        """The developed picture ``(3, H, W)``, uint8 or float in [0, 1]."""

    @property
    def clean(self) -> Frame:
        """The clean frame."""

    @property
    def balance_known(self) -> bool:
        """Whether the frame states its white balance."""

    @property
    def noisy(self) -> Frame | None:
        """The captured noisy frame, if there is one."""

    @property
    def cfa(self) -> CFA:
        """The pattern of both."""

    @property
    def registered(self) -> bool:
        """Whether picture and mosaic agree pixel by pixel."""


class FrameSummary(NamedTuple):
    """What a fit keeps of a frame besides its pixels.

    Args:
        name: name of the frame.
        camera: maker and model.
        cfa: pattern of its mosaic.
        white_balance: as-shot multipliers of R, G and B.
        srgb: thumbnail of the picture, ``(1, 3, h, w)``.
        raw: thumbnail of the mosaic's colours, ``(1, 3, h', w')``.
        registered: whether picture and mosaic agree pixel by pixel.
    """

    name: str
    camera: str
    cfa: CFA
    white_balance: tuple[float, float, float]
    srgb: Tensor
    raw: Tensor
    registered: bool


class PixelSamples(NamedTuple):
    """P pixels of each of F frames, as images of one row.

    Args:
        srgb: the picture, ``(F, 3, 1, P)``.
        target: the reading in the channel of the site, 0 in the others, ``(F, 3, 1, P)``.
        site: 1 in the channel of the site, ``(F, 3, 1, P)``.
        known: the same, but 0 where the reading or the picture is clipped.
        coordinates: coordinates of the pixels in the full frame, ``(F, 2, 1, P)``.
        cell_srgb: the picture averaged over the 2 x 2 cell, ``(F, 3, 1, P)``.
        cell_raw: the three colours of the cell, ``(F, 3, 1, P)``.
        cell_weight: weight of the cell, less on edges and 0 if it is clipped, ``(F, 1, 1, P)``.
    """

    srgb: Tensor
    target: Tensor
    site: Tensor
    known: Tensor
    coordinates: Tensor
    cell_srgb: Tensor
    cell_raw: Tensor
    cell_weight: Tensor

    def of_frames(self, index: Tensor | slice) -> PixelSamples:
        """Take the pixels of the frames of an index ``(f,)`` or a slice."""
        return PixelSamples(*[tensor[index] for tensor in self])

    def pick(self, index: Tensor, frames: Tensor | slice = slice(None)) -> PixelSamples:
        """Pick the pixels of an index ``(p,)`` from every frame, or from those of an index ``(f,)``."""
        return PixelSamples(*[tensor[frames].index_select(-1, index) for tensor in self])


class FitFrames(NamedTuple):
    """The frames of a fit: their drawn pixels, and a summary of each."""

    pixels: PixelSamples
    shots: list[FrameSummary]

    def some(self, frames: Sequence[int]) -> FitFrames:
        """Take some of the frames by their numbers."""
        shots = [self.shots[k] for k in frames]
        return FitFrames(self.pixels.of_frames(torch.tensor(frames)), shots)

    def split(self, frames: Sequence[int]) -> tuple[FitFrames, FitFrames]:
        """Take some of the frames by their numbers, and all others."""
        remaining = [number for number in range(len(self.shots)) if number not in frames]
        return self.some(frames), self.some(remaining)

    @property
    def as_shot(self) -> Tensor:
        """The as-shot multipliers of R, G and B of each frame, ``(F, 3)``."""
        return torch.tensor([shot.white_balance for shot in self.shots])


def sample_pixels(pairs: Iterable[FramePair], pixels: int, seed: int, noisy: bool = False) -> FitFrames:
    """Draw random pixels from every frame, with replacement; the frames are read once.

    Args:
        pairs: the frames.
        pixels: number of pixels to draw from each frame.
        seed: keys the draws, with the name of the frame.
        noisy: take the captured noisy RAW in place of the clean one.

    Raises:
        ValueError: if there is no frame, or one lacks its colours or its noisy RAW.
    """
    frames = []
    shots = []
    for pair in pairs:
        if not (pair.clean.color_known or pair.balance_known):
            unknown = "its white balance and colour matrix are unknown"
            raise ValueError(f"{pair.name}: {unknown}; use an ISP such as universal")
        frame = pair.noisy if noisy else pair.clean
        if frame is None:
            raise ValueError(f"{pair.name}: has no noisy RAW; fit on clean frames or add noise first")

        generator = keyed_generator(seed, "pixels", pair.name)
        draw = _draw_sites if pair.registered else _draw_blocks
        try:
            frames.append(draw(pair.srgb, frame.mosaic, pair.cfa, pixels, generator))
        except ValueError as error:
            raise ValueError(f"{pair.name}: {error}") from None

        shot = FrameSummary(
            name=pair.name,
            camera=pair.clean.camera,
            cfa=pair.cfa,
            white_balance=pair.clean.white_balance,
            srgb=thumbnail(as_float(pair.srgb[None])),
            raw=thumbnail(_colours(frame.mosaic, pair.cfa)[None]),
            registered=pair.registered,
        )
        shots.append(shot)
    if not frames:
        raise ValueError("no RAW-sRGB pair to fit; give at least one RAW file")

    stacked = map(torch.stack, zip(*frames, strict=True))
    return FitFrames(PixelSamples(*stacked), shots)


def _draw_sites(srgb: Tensor, raw: Tensor, cfa: CFA, pixels: int, generator: torch.Generator) -> PixelSamples:
    """Draw mosaic sites with the one colour that they have, and the cells around them."""
    height, width = raw.shape[-2:]
    row = torch.randint(height, (pixels,), generator=generator)
    column = torch.randint(width, (pixels,), generator=generator)

    scale = 255.0 if srgb.dtype == torch.uint8 else 1.0
    pixel = srgb[:, row, column].float() / scale
    reading = raw[0, row, column]
    site = F.one_hot(torch.tensor(cfa.channels)[row % 2, column % 2], 3).T.float()
    inside = (pixel.amax(0) < _CLIPPED_SRGB) & (pixel.amin(0) > 0.0) & (reading < CLIPPED_RAW)

    top, left = row // 2 * 2, column // 2 * 2
    corners = []
    for i, j in ((0, 0), (0, 1), (1, 0), (1, 1)):
        corners.append(srgb[:, top + i, left + j].float() / scale)
    cell_srgb = torch.stack(corners)
    red, green_r, green_b, blue = [raw[0, top + i, left + j] for i, j in cfa.sites]
    cell_raw = torch.stack([red, (green_r + green_b) / 2, blue])

    spread = (cell_srgb.amax(0) - cell_srgb.amin(0)).amax(0)
    is_unclipped = (cell_srgb.amax((0, 1)) < _CLIPPED_SRGB) & (cell_raw.amax(0) < CLIPPED_RAW)
    weight = is_unclipped / (1.0 + (spread * 32.0) ** 2)

    coordinates = frame_coordinates(height, width)[0, :, row, column]
    return _samples(pixel, reading * site, site, site * inside, coordinates, cell_srgb.mean(0), cell_raw, weight)


def _draw_blocks(srgb: Tensor, raw: Tensor, cfa: CFA, pixels: int, generator: torch.Generator) -> PixelSamples:
    """Draw averages over blocks in linear light, which tolerate a shift of a few pixels."""
    low_srgb, low_raw, clipped, places = block_averages(srgb, raw, cfa)
    greens = torch.stack([low_srgb[1], low_raw[1].clamp_min(0.0).sqrt()])[:, ~clipped]
    likeness = float(torch.corrcoef(greens)[0, 1])
    if likeness < LEAST_LIKENESS:
        raise ValueError(f"sRGB and RAW hardly correlate ({likeness:.2f}); are they from the same shot?")

    index = torch.randint(clipped.numel(), (pixels,), generator=generator)
    pixel, reading = low_srgb.flatten(1)[:, index], low_raw.flatten(1)[:, index]
    inside = ~clipped.flatten()[index] & (pixel.amax(0) < _CLIPPED_SRGB)
    coordinates = places[0].flatten(1)[:, index]
    usable = inside.expand(3, -1).float()
    return _samples(pixel, reading, torch.ones_like(usable), usable, coordinates, pixel, reading, inside.float())


def block_averages(srgb: Tensor, raw: Tensor, cfa: CFA) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Average an unregistered pair over corresponding blocks, with the shift between the two removed.

    Args:
        srgb: ``(3, H, W)``, averaged in linear light.
        raw: ``(1, H, W)``.
        cfa: the pattern of ``raw``.

    Returns:
        sRGB and RAW ``(3, h, w)``; whether any site of a block is clipped, ``(h, w)``; and the blocks' coordinates in
        the full frame, ``(1, 2, h, w)``.
    """
    height, width = raw.shape[-2:]
    dy, dx = find_shift(srgb, raw, cfa)
    top, left = -(min(dy, 0) // 2) * 2, -(min(dx, 0) // 2) * 2
    rows = (height - top - max(dy, 0)) // BLOCK * BLOCK
    columns = (width - left - max(dx, 0)) // BLOCK * BLOCK

    window = raw[:, top : top + rows, left : left + columns]
    x = as_float(srgb[:, top + dy : top + dy + rows, left + dx : left + dx + columns])
    low_srgb = F.avg_pool2d(x[None] ** 2.2, BLOCK)[0] ** (1 / 2.2)
    low_raw = F.avg_pool2d(_colours(window, cfa)[None], BLOCK // 2)[0]

    clipped = F.max_pool2d((window >= CLIPPED_RAW).float()[None], BLOCK)[0, 0] > 0
    coordinates = frame_coordinates(rows, columns, (top, left), (height, width))
    return low_srgb, low_raw, clipped, F.avg_pool2d(coordinates, BLOCK)


def find_shift(srgb: Tensor, raw: Tensor, cfa: CFA) -> tuple[int, int]:
    """Find how many pixels a picture ``(3, H, W)`` is shifted down and right from its mosaic ``(1, H, W)``."""
    with extra("raw"):
        from skimage.registration import phase_cross_correlation

    green = _colours(raw, cfa)[1].clamp_min(0.0).sqrt()
    height, width = green.shape
    picture = F.avg_pool2d(as_float(srgb[1:2, : 2 * height, : 2 * width])[None], 2)[0, 0]
    shift, _, _ = phase_cross_correlation(picture.numpy(), green.numpy(), upsample_factor=4)
    return round(2 * float(shift[0])), round(2 * float(shift[1]))


def _colours(raw: Tensor, cfa: CFA) -> Tensor:
    """Average a mosaic ``(1, H, W)`` to the colours of its cells ``(3, H/2, W/2)``."""
    planes = bayer.pack(raw, cfa)
    return torch.stack([planes[0], (planes[1] + planes[2]) / 2, planes[3]])


def _samples(*values: Tensor) -> PixelSamples:
    """Shape rows ``(C, P)`` or ``(P,)`` as images ``(C, 1, P)``."""
    return PixelSamples(*(v.reshape(-1, 1, v.shape[-1]) for v in values))
