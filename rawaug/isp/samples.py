"""Pixels for the fit: what a pair of RAW and sRGB says, as small tensors, without the pictures.

Given its parameters the ISP is pointwise up to the mosaic, so a random subset of pixels stands for a frame. A mosaic
site knows its own colour alone: ``target`` holds its reading and ``known`` says in which channel. The 2 x 2 cell around
it, averaged, gives the forward pass all three colours. Pairs whose RAW and sRGB do not meet pixel for pixel (a camera's
own JPEG) are compared as averages over blocks instead, where every channel is known.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple, Protocol

import torch
import torch.nn.functional as F
from torch import Tensor

from rawaug import bayer
from rawaug.bayer import CFA
from rawaug.isp.stages import place_in_frame
from rawaug.seeding import keyed_generator

CLIPPED_SRGB = 0.98
CLIPPED_RAW = 0.98
BLOCK = 16
"""Side in pixels of the blocks over which unregistered pairs are averaged."""


class FramePair(Protocol):
    """What the fit needs of a pair; :class:`rawaug.data.Pair` is one."""

    @property
    def name(self) -> str: ...
    @property
    def srgb(self) -> Tensor: ...  # (3, H, W) uint8 or float
    @property
    def raw(self) -> Tensor: ...  # (1, H, W)
    @property
    def noisy(self) -> Tensor | None: ...  # (1, H, W)
    @property
    def cfa(self) -> CFA: ...
    @property
    def white_balance(self) -> tuple[float, float, float]: ...
    @property
    def registered(self) -> bool: ...


class PixelSamples(NamedTuple):
    """F frames of P pixels each.

    Args:
        srgb: ``(F, 3, 1, P)`` in [0, 1].
        target: ``(F, 3, 1, P)`` RAW readings where ``known``.
        known: ``(F, 3, 1, P)`` 1 where the reading is there and neither it nor the sRGB pixel is clipped, else 0.
        place: ``(F, 2, 1, P)`` coordinates in the full frame.
        cell_srgb, cell_raw: ``(F, 3, 1, P)`` averages over the cell.
        cell_weight: ``(F, 1, 1, P)`` low where the cell is not flat, 0 where it is clipped.
    """

    srgb: Tensor
    target: Tensor
    known: Tensor
    place: Tensor
    cell_srgb: Tensor
    cell_raw: Tensor
    cell_weight: Tensor

    def pick(self, index: Tensor) -> PixelSamples:
        """The pixels ``index`` of every frame."""
        return PixelSamples(*(value[..., index] for value in self))


def sample_pixels(pairs: Iterable[FramePair], pixels: int, seed: int, noisy: bool = False) -> PixelSamples:
    """Draw ``pixels`` a frame, keyed by ``seed`` and the frame's name.

    Args:
        pairs: frames; read one at a time.
        pixels: P; drawn with replacement.
        noisy: take the captured noisy RAW (and never the clean one).

    Raises:
        ValueError: if there is no pair, or a noisy RAW is asked for and absent.
    """
    frames = [_sample_frame(pair, pixels, seed, noisy) for pair in pairs]
    if not frames:
        raise ValueError("no RAW-sRGB pair to fit; give at least one RAW file")
    return PixelSamples(*(torch.stack(values) for values in zip(*frames, strict=True)))


def _sample_frame(pair: FramePair, pixels: int, seed: int, noisy: bool) -> PixelSamples:
    raw = pair.noisy if noisy else pair.raw
    if raw is None:
        raise ValueError(f"{pair.name}: has no noisy RAW; fit on clean frames or add noise first")
    generator = keyed_generator(seed, "pixels", pair.name)
    draw = _sites if pair.registered else _blocks
    return draw(pair.srgb, raw, pair.cfa, pixels, generator)


def _sites(srgb: Tensor, raw: Tensor, cfa: CFA, pixels: int, generator: torch.Generator) -> PixelSamples:
    """Mosaic sites with the one colour they have, and the cells around them."""
    height, width = raw.shape[-2:]
    row = torch.randint(height, (pixels,), generator=generator)
    column = torch.randint(width, (pixels,), generator=generator)
    scale = 255.0 if srgb.dtype == torch.uint8 else 1.0
    pixel = srgb[:, row, column].float() / scale
    reading = raw[0, row, column]
    own = F.one_hot(torch.tensor(cfa.channels)[row % 2, column % 2], 3).T.float()
    inside = (pixel.amax(0) < CLIPPED_SRGB) & (pixel.amin(0) > 0.0) & (reading < CLIPPED_RAW)

    top, left = row // 2 * 2, column // 2 * 2
    corners = torch.stack([srgb[:, top + i, left + j].float() / scale for i in (0, 1) for j in (0, 1)])
    sites = torch.stack([raw[0, top + i, left + j] for i, j in cfa.sites])
    cell_raw = torch.stack([sites[0], (sites[1] + sites[2]) / 2, sites[3]])
    spread = (corners.amax(0) - corners.amin(0)).amax(0)
    unclipped = (corners.amax((0, 1)) < CLIPPED_SRGB) & (cell_raw.amax(0) < CLIPPED_RAW)
    weight = unclipped / (1.0 + (spread * 32.0) ** 2)
    place = place_in_frame(height, width)[0, :, row, column]
    return _samples(pixel, reading * own, own * inside, place, corners.mean(0), cell_raw, weight)


def _blocks(srgb: Tensor, raw: Tensor, cfa: CFA, pixels: int, generator: torch.Generator) -> PixelSamples:
    """Averages over blocks, linear light: tolerant to a shift of a few pixels."""
    low_srgb, low_raw, clipped = block_averages(srgb, raw, cfa)
    height, width = low_raw.shape[-2:]
    index = torch.randint(height * width, (pixels,), generator=generator)
    pixel, reading = low_srgb.flatten(1)[:, index], low_raw.flatten(1)[:, index]
    inside = ~clipped.flatten()[index] & (pixel.amax(0) < CLIPPED_SRGB)
    place = place_in_frame(height, width)[0].flatten(1)[:, index]
    known = inside.expand(3, -1).float()
    return _samples(pixel, reading, known, place, pixel, reading, inside.float())


def block_averages(srgb: Tensor, raw: Tensor, cfa: CFA, block: int = BLOCK) -> tuple[Tensor, Tensor, Tensor]:
    """Average a pair over blocks: sRGB ``(3, h, w)`` (in linear light), RAW ``(3, h, w)``, any clipped ``(h, w)``."""
    scale = 255.0 if srgb.dtype == torch.uint8 else 1.0
    x = srgb.float() / scale
    low_srgb = F.avg_pool2d(x[None] ** 2.2, block)[0] ** (1 / 2.2)
    planes = F.avg_pool2d(bayer.pack(raw, cfa)[None], block // 2)[0]
    low_raw = torch.stack([planes[0], (planes[1] + planes[2]) / 2, planes[3]])
    clipped = F.max_pool2d((raw >= CLIPPED_RAW).float()[None], block)[0, 0] > 0
    return low_srgb, low_raw, clipped


def _samples(*values: Tensor) -> PixelSamples:
    """Rows ``(C, P)`` or ``(P,)`` as images ``(C, 1, P)``."""
    return PixelSamples(*(v.reshape(-1, 1, v.shape[-1]) for v in values))
