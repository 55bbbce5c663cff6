"""Overexposed and retouched frames, against the formulas."""

from __future__ import annotations

import pytest
import torch
from skimage.color import rgb2gray

from rawaug.bayer import CFA
from rawaug.data.pairs import Pair
from rawaug.paper.metrics import overexposed, retouched


def grey(value: int) -> Pair:
    return Pair("g", torch.full((3, 2, 2), value, dtype=torch.uint8), torch.full((1, 2, 2), 0.3), CFA.RGGB)


def test_a_stop_doubles_the_light_of_raw_and_picture_up_to_white() -> None:
    pair = overexposed(grey(128))
    assert torch.equal(pair.raw, torch.full((1, 2, 2), 0.6))
    linear = ((128 / 255 + 0.055) / 1.055) ** 2.4  # IEC 61966-2-1
    expected = 255 * (1.055 * (2 * linear) ** (1 / 2.4) - 0.055)
    assert pair.srgb[0, 0, 0].item() == round(expected)
    bright = overexposed(overexposed(grey(200)))
    assert bright.srgb.min() == 255 and bright.raw.max() == 1.0


def test_retouching_leaves_the_raw_and_adds_contrast_and_colour() -> None:
    assert torch.equal(retouched(grey(128)).raw, grey(128).raw)
    assert retouched(grey(64)).srgb[0, 0, 0] < 64 and retouched(grey(192)).srgb[0, 0, 0] > 192
    x = 64 / 255
    assert retouched(grey(64)).srgb[1, 1, 1].item() == round(255 * (x + 0.5 * (3 * x**2 - 2 * x**3 - x)))
    colour = torch.tensor([140, 120, 110], dtype=torch.uint8).reshape(3, 1, 1).expand(3, 2, 2).contiguous()
    edited = retouched(Pair("c", colour, torch.zeros(1, 2, 2), CFA.RGGB)).srgb[:, 0, 0] / 255.0
    before = colour[:, 0, 0] / 255.0
    toned = before + 0.5 * (3 * before**2 - 2 * before**3 - before)
    luma = rgb2gray(toned.reshape(1, 1, 3).numpy()).item()  # BT.709 to four digits
    assert edited.tolist() == pytest.approx((luma + 1.3 * (toned - luma)).tolist(), abs=0.003)
