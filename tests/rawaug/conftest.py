"""Bayer DNGs for the tests to read."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile

import denoisers

XYZ_TO_CAMERA = ((0.80, -0.20, -0.10), (-0.40, 1.20, 0.20), (-0.05, 0.15, 0.60))


def _rationals(values: Sequence[float], denominator: int = 10000) -> tuple[int, ...]:
    return tuple(number for value in values for number in (round(value * denominator), denominator))


def write_dng(
    path: Path,
    numbers: np.ndarray,
    cfa: str | None = "RGGB",
    black: Sequence[int] | None = (0,),
    white: int = 4095,
    white_balance: Sequence[float] = (2.0, 1.0, 1.6),
    color_matrix: Sequence[Sequence[float]] | None = XYZ_TO_CAMERA,
    orientation: int = 1,
    noise_profile: Sequence[float] | None = None,
    extra: Sequence[tuple[Any, ...]] = (),
    **layout: Any,
) -> Path:
    """Write uint16 ``(H, W)`` as a Bayer DNG, ``(H, W, 3)`` as a linear one; ``black`` is one level, one a
    site, or None where ``extra`` states it.

    ``layout`` is tifffile's: strips, tiles, byte order.
    """
    byte, text, short, rational, srational, double = 1, 2, 3, 5, 10, 12
    tags: list[tuple[Any, ...]] = [
        (271, text, 0, "Maker", True),
        (272, text, 0, "Model 1", True),
        (274, short, 1, orientation, True),
        (50706, byte, 4, bytes((1, 4, 0, 0)), True),
        (50708, text, 0, "Maker Model 1", True),
        (50717, short, 1, white, True),
        (50728, rational, 3, _rationals([1 / gain for gain in white_balance], 10**6), True),
    ]
    if cfa is not None:
        tags += [(33421, short, 2, (2, 2), True), (33422, byte, 4, bytes("RGB".index(c) for c in cfa), True)]
    if black is not None:
        tags.append((50714, short, len(black), tuple(black), True))
    if black is not None and len(black) == 4:
        tags.append((50713, short, 2, (2, 2), True))
    if color_matrix is not None:
        tags += [(50721, srational, 9, _rationals(np.ravel(color_matrix).tolist()), True), (50778, short, 1, 21, True)]
    if noise_profile is not None:
        tags.append((51041, double, len(noise_profile), tuple(noise_profile), True))
    photometric = 32803 if numbers.ndim == 2 else 34892
    tifffile.imwrite(path, numbers, photometric=photometric, extratags=sorted([*tags, *extra]), metadata=None, **layout)
    return path


@pytest.fixture(scope="session")
def bayer_dng() -> Callable[..., Path]:
    return write_dng


@pytest.fixture(scope="session")
def identity(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The weights of a network that changes nothing."""
    path = tmp_path_factory.mktemp("weights") / "identity.safetensors"
    denoisers.save(denoisers.UNet(width=4, scales=2), path, {"cfa": "GRBG", "noise": "cycleisp_sidd"})
    return path
