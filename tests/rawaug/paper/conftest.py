"""A camera of which every number is known, and frames that it made."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, cast

import pytest
import torch

from rawaug.bayer import CFA
from rawaug.data.pairs import Pair
from rawaug.io import RawFrame
from rawaug.isp.config import ISPConfig
from rawaug.isp.model import DictionaryISP

LIGHTS = ((2.0, 1.0, 1.5), (1.2, 1.0, 2.6))
"""The camera's two atoms of gains, digital gain 1: daylight and lamps."""
MATRIX = ((0.6, 0.3, 0.1), (0.05, 0.75, 0.2), (0.02, 0.23, 0.75))
LEVELS = 4095

FrameOf = Callable[..., Pair]


@pytest.fixture
def known_camera() -> DictionaryISP:
    """Gamma, one matrix, two lights of which it takes the first for granted, and fall-off; it leaves the tone alone."""
    isp = DictionaryISP(ISPConfig(colour_atoms=1, gain_atoms=2, encoder_widths=(4, 4, 4), cfa="GRBG", attention=False))
    with torch.no_grad():
        isp.colour.matrices.copy_(torch.tensor(MATRIX)[None])
        isp.gain.log_gains.copy_(torch.tensor([[1.0, red, blue] for red, _, blue in LIGHTS]).log())
        isp.reverse_encoders.gain.set_prior(torch.tensor([1.0, 0.0]))
        cast(Any, isp.stages["shading"]).mask.set(torch.zeros(2), 1.5 * torch.eye(2))
    return isp.requires_grad_(False).eval()


@pytest.fixture
def frame_of(known_camera: DictionaryISP) -> FrameOf:
    """Makes a frame of coarse random colours: ``frame_of(name, light, size)``; RAW of 12 bits by the known camera."""

    def make(name: str, light: tuple[float, float, float] = LIGHTS[0], size: tuple[int, int] = (256, 256)) -> Pair:
        generator = torch.Generator().manual_seed(sum(name.encode()))
        coarse = torch.rand(1, 3, 12, 12, generator=generator)
        picture = torch.nn.functional.interpolate(coarse, size, mode="bilinear")[0].mul(0.8).add(0.08)
        srgb = (picture * 255).round().to(torch.uint8)
        with torch.no_grad():
            raw = known_camera.reverse(srgb[None], white_balance=light).raw[0]
        raw = (raw * LEVELS).round() / LEVELS
        matrix = torch.linalg.inv(torch.tensor(MATRIX))
        clean = RawFrame(raw, CFA.GRBG, white_balance=light, color_matrix=matrix, camera="known")
        return Pair(name, clean, srgb)

    return make


@pytest.fixture
def exact_pairs(known_camera: DictionaryISP, frame_of: FrameOf) -> list[Pair]:
    """Three small frames without fall-off, each in a light of its own."""
    cast(Any, known_camera.stages["shading"]).mask.set(torch.zeros(2), torch.zeros(2, 2))
    lights = ((1.6, 1.0, 1.5), (2.0, 1.0, 1.2), (1.8, 1.0, 1.9))
    return [frame_of(f"shot{k}", light, (96, 128)) for k, light in enumerate(lights)]
