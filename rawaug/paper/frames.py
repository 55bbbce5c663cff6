r"""Frames made for a comparison: of published cameras in many lights, and with pictures that the camera did not make.

*Synthetic* frames are photographs as scenes before the demo camera's lens and sensor, in the colour
``C = colour_matrix(M)`` and the balance ``wb(M, L)`` of a published camera M and a light L drawn as in
:mod:`rawaug.isp.cameras`. *Perturbed* frames are overexposed by s stops, RAW and picture clipped at white,

.. math:: y' = \min(2^s y, 1), \qquad x' = E(\min(2^s D(x), 1))

with the sRGB curve E and its inverse D; or retouched: the RAW stays, the picture is given an S curve,
``x + c (3 x^2 - 2 x^3 - x)``, and more saturated colour, ``Y + k (x - Y)`` with the luma Y of ITU-R BT.709.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import torch
import torch.nn.functional as F
from torch import Tensor

from rawaug import bayer
from rawaug.data import DemoCamera, Pair
from rawaug.data.demo import FRAME
from rawaug.io import decode_srgb, encode_srgb
from rawaug.isp.cameras import colour_matrix, published_cameras, sample_lights, white_balance
from rawaug.isp.dictionary import plausible
from rawaug.seeding import keyed_generator

LIGHTS_TRIED = 32
STOPS, CONTRAST, SATURATION = 1.0, 0.5, 1.3
LUMA = (0.2126, 0.7152, 0.0722)


def synthetic_frames(pictures: Sequence[Tensor], cameras: Sequence[str], seed: int, part: str) -> list[Pair]:
    """A frame of 288 x 448 of each picture, the cameras in turn, each in a light of its own."""
    matrices = published_cameras().named(cameras)
    frames = []
    for k, picture in enumerate(pictures):
        which = k % len(cameras)
        name = f"{part}_{k:03d}_{cameras[which].replace(' ', '-')}"
        frames.append(_frame(picture, matrices[which], keyed_generator(seed, "varied frame", part, k), name))
    return frames


def _frame(picture: Tensor, xyz_to_camera: Tensor, generator: torch.Generator, name: str) -> Pair:
    balances = white_balance(xyz_to_camera, torch.from_numpy(sample_lights(LIGHTS_TRIED, generator))).numpy()
    red, green, blue = balances[plausible(balances)][0].tolist()
    least = min(red, green, blue)
    to_srgb = torch.linalg.inv(colour_matrix(xyz_to_camera)).tolist()
    camera = DemoCamera(color_matrix=tuple((r, g, b) for r, g, b in to_srgb))
    shot = camera.sample(generator, iso=100)._replace(white_balance=(red / least, green / least, blue / least))
    return camera.apply(_scene(picture, generator, name), shot, name)


def _scene(picture: Tensor, generator: torch.Generator, name: str) -> Tensor:
    """A crop of the picture at the largest whole reduction that still holds a frame."""
    factor = min(side // size for side, size in zip(picture.shape[-2:], FRAME, strict=True))
    if not factor:
        raise ValueError(
            f"{name}: a picture must be {FRAME[0]} x {FRAME[1]} or larger, got {tuple(picture.shape[-2:])}"
        )
    small = F.avg_pool2d(picture[None].float(), factor)[0].round().to(torch.uint8)
    scene: Tensor = bayer.RandomCrop(FRAME)(small, generator)
    return scene


def overexposed(pair: Pair) -> Pair:
    factor = 2.0**STOPS
    picture = encode_srgb((factor * decode_srgb(pair.srgb.float() / 255.0)).clamp(max=1.0))
    return replace(pair, srgb=_as_8_bits(picture), raw=(factor * pair.raw).clamp(max=1.0))


def retouched(pair: Pair) -> Pair:
    x = pair.srgb.float() / 255.0
    x = x + CONTRAST * (3.0 * x**2 - 2.0 * x**3 - x)
    luma = (torch.tensor(LUMA).reshape(3, 1, 1) * x).sum(0, keepdim=True)
    return replace(pair, srgb=_as_8_bits((luma + SATURATION * (x - luma)).clamp(0.0, 1.0)))


PERTURBED: dict[str, Callable[[Pair], Pair]] = {"overexposed": overexposed, "retouched": retouched}


def _as_8_bits(picture: Tensor) -> Tensor:
    return (255.0 * picture).round().to(torch.uint8)
