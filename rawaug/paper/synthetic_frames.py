r"""Frames of several published cameras in many lights: photographs as scenes before the demo camera's lens and sensor.

A frame's colour is ``C = colour_matrix(M)`` and ``wb(M, L)`` of :mod:`rawaug.isp.cameras` for a camera's published
matrix M and a light L drawn as there; blur, shading, exposure, converter and rendering are those of
:class:`rawaug.data.DemoCamera`, which shares no code with the ISPs that are fitted to its frames.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
import torch.nn.functional as F
from torch import Tensor

from rawaug import bayer
from rawaug.data import DemoCamera, Pair
from rawaug.data.demo.pairs import FRAME
from rawaug.isp.cameras import colour_matrix, published_cameras, sample_lights, white_balance
from rawaug.isp.dictionary import plausible
from rawaug.seeding import keyed_generator

LIGHTS_TRIED = 32


def varied_frames(pictures: Sequence[Tensor], cameras: Sequence[str], seed: int, part: str) -> list[Pair]:
    """A frame of 288 x 448 of each picture, the cameras in turn, each in a light of its own.

    Args:
        pictures: uint8 ``(3, H, W)``, at least as large as a frame; larger ones are averaged down.
        cameras: names, as :func:`rawaug.isp.cameras.published_cameras` has them.
        seed: of lights, exposures and crops.
        part: begins the frames' names, and keys their draws.

    Raises:
        ValueError: if a camera is not published, or a picture is smaller than a frame.
    """
    published = published_cameras()
    matrices = published.named(cameras)
    frames = []
    for k, picture in enumerate(pictures):
        generator = keyed_generator(seed, "varied frame", part, k)
        which = k % len(cameras)
        name = f"{part}_{k:03d}_{cameras[which].replace(' ', '-')}"
        frames.append(_frame(picture, matrices[which], generator, name))
    return frames


def _frame(picture: Tensor, xyz_to_camera: Tensor, generator: torch.Generator, name: str) -> Pair:
    balances = white_balance(xyz_to_camera, torch.from_numpy(sample_lights(LIGHTS_TRIED, generator))).numpy()
    red, green, blue = balances[plausible(balances)][0].tolist()
    least = min(red, green, blue)
    to_srgb = torch.linalg.inv(colour_matrix(xyz_to_camera)).tolist()
    camera = DemoCamera(color_matrix=tuple((r, g, b) for r, g, b in to_srgb))
    shot = replace(camera.sample(generator, iso=100), white_balance=(red / least, green / least, blue / least))
    return camera.apply(_scene(picture, generator, name), shot, name)


def _scene(picture: Tensor, generator: torch.Generator, name: str) -> Tensor:
    """A crop of the picture at the largest whole reduction that still holds a frame."""
    factor = min(side // size for side, size in zip(picture.shape[-2:], FRAME, strict=True))
    if not factor:
        raise ValueError(
            f"{name}: a picture must be {FRAME[0]} x {FRAME[1]} or larger, got {tuple(picture.shape[-2:])}"
        )
    small = F.avg_pool2d(picture[None].float(), factor)[0].round().to(torch.uint8)
    top, left = (
        int(torch.randint(side - size + 1, (), generator=generator))
        for side, size in zip(small.shape[-2:], FRAME, strict=True)
    )
    return bayer.crop(small, top // 2 * 2, left // 2 * 2, *FRAME)
