"""The loss of a JPEG as a transform: libjpeg's codes, at any quality and subsampling, in a batch and alone."""

from __future__ import annotations

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from rawaug.io.pictures import recode_jpeg
from rawaug.plugin.jpeg import compress_jpeg, transform_jpeg


def pictures(height: int, width: int) -> Tensor:
    """Something smooth, noise, and columns and rows of one pixel, whose chroma is large: uint8 ``(3, 3, H, W)``."""
    generator = torch.Generator().manual_seed(0)
    smooth = F.interpolate(torch.rand(1, 3, 4, 5, generator=generator), (height, width), mode="bicubic").clamp(0, 1)
    stripes = torch.zeros(1, 3, height, width)
    stripes[:, 0, :, ::2], stripes[:, 1, ::2] = 0.8, 0.4
    both = torch.cat([smooth, torch.rand(1, 3, height, width, generator=generator), stripes])
    return both.mul(255).round().to(torch.uint8)


@pytest.mark.parametrize("subsampling", ["4:4:4", "4:2:2", "4:2:0"])
@pytest.mark.parametrize("quality", [3, 49, 50, 88, 97, 100])
def test_the_codes_are_those_of_libjpeg(quality: int, subsampling: str) -> None:
    srgb = pictures(38, 52)  # no whole blocks
    expected = torch.stack([recode_jpeg(picture, quality, subsampling) for picture in srgb])
    ours = transform_jpeg(srgb.float(), torch.full((len(srgb),), quality), [subsampling] * len(srgb))
    assert torch.equal(ours, expected.double())


def test_each_picture_of_a_batch_has_its_own_quality_and_subsampling() -> None:
    srgb, quality, kinds = pictures(32, 48), torch.tensor([95, 20, 70]), ["4:2:0", "4:4:4", "4:2:2"]
    together = transform_jpeg(srgb.float(), quality, kinds)
    for k in range(len(srgb)):
        assert torch.equal(
            transform_jpeg(srgb[k : k + 1].float(), quality[k : k + 1], kinds[k : k + 1])[0], together[k]
        )

    halved = torch.tensor([True, False, True])
    by_codec = compress_jpeg(srgb / 255.0, quality, halved)
    ours = transform_jpeg(srgb.float(), quality, ["4:2:0" if half else "4:4:4" for half in halved])
    assert torch.equal(by_codec, ours.float() / 255.0)
