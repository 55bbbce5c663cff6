from __future__ import annotations

import io

import numpy as np
import pytest
import torch
from PIL import Image

from rawaug.io.pictures import through_jpeg


def test_it_is_what_a_file_of_that_quality_holds_with_colour_at_half_the_width() -> None:
    generator = torch.Generator().manual_seed(0)
    coarse = torch.rand(1, 3, 6, 8, generator=generator)
    picture = (255 * torch.nn.functional.interpolate(coarse, (48, 64), mode="bilinear")[0]).to(torch.uint8)
    expected = io.BytesIO()
    Image.fromarray(picture.permute(1, 2, 0).numpy()).save(expected, "JPEG", quality=90, subsampling="4:2:2")
    assert np.array_equal(through_jpeg(picture, 90).permute(1, 2, 0).numpy(), np.array(Image.open(expected)))
    errors = [(through_jpeg(picture, quality).float() - picture).square().mean() for quality in (30, 90)]
    assert errors[0] > errors[1] > 0
    stripes = torch.tensor([[255, 0], [0, 0], [0, 255]], dtype=torch.uint8)[:, None].repeat(1, 32, 16)
    fine, turned = (through_jpeg(x, 90).float() - x for x in (stripes, stripes.mT))
    assert fine.square().mean() > 2 * turned.square().mean(), "columns of colour are lost, rows are not"


def test_what_is_no_picture_or_quality_is_refused() -> None:
    with pytest.raises(ValueError, match=r"uint8 \(3, H, W\), got torch.float32"):
        through_jpeg(torch.zeros(3, 8, 8), 90)
    with pytest.raises(ValueError, match="quality must be 1 to 100, got 0"):
        through_jpeg(torch.zeros(3, 8, 8, dtype=torch.uint8), 0)
