from __future__ import annotations

import pytest
import torch

from rawaug.bayer import CFA, demosaic, mosaic
from rawaug.data import demo_photographs
from rawaug.data.development import demosaic_malvar


@pytest.mark.parametrize("cfa", list(CFA))
def test_planes_are_exact_inside(cfa: CFA) -> None:
    y, x = torch.meshgrid(torch.arange(20.0), torch.arange(24.0), indexing="ij")
    rgb = torch.stack([0.2 + 0.01 * x, 0.5 - 0.01 * y, 0.1 + 0.01 * x + 0.02 * y])
    error = demosaic_malvar(mosaic(rgb, cfa), cfa) - rgb
    assert error[:, 2:-2, 2:-2].abs().max() < 1e-6


@pytest.mark.parametrize("cfa", list(CFA))
def test_known_sites_are_kept_and_constants_too(cfa: CFA) -> None:
    raw = torch.rand(1, 12, 14, generator=torch.Generator().manual_seed(0))
    assert torch.equal(mosaic(demosaic_malvar(raw, cfa), cfa), raw)
    colour = torch.tensor([0.3, 0.6, 0.1]).reshape(3, 1, 1).expand(3, 12, 14)
    assert torch.allclose(demosaic_malvar(mosaic(colour, cfa), cfa), colour, atol=1e-6)


def test_it_is_far_better_than_bilinear() -> None:
    """By 3 dB at least, on a photograph, as the authors report (5.5 dB on average on their set)."""
    rgb = demo_photographs("test")["coffee"][:, :400, :600].float() / 255
    raw = mosaic(rgb, "RGGB")

    def psnr(estimate: torch.Tensor) -> float:
        return -10 * torch.log10((estimate - rgb)[:, 4:-4, 4:-4].square().mean()).item()

    assert psnr(demosaic_malvar(raw, "RGGB")) > psnr(demosaic(raw[None], "RGGB")[0]) + 3
