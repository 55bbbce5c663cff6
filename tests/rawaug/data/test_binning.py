"""Binning by colour site: colours stay apart, and noise falls by the number of sites."""

from __future__ import annotations

import pytest
import torch

from rawaug.bayer import CFA, bin_mosaic, mosaic
from rawaug.data import Binned, Pair, demo_pairs, open_pairs
from rawaug.data.folders import Readable
from rawaug.data.pairs import captured_noise, shared_frame, stamps

COLOURS = torch.tensor([0.2, 0.5, 0.8]).reshape(3, 1, 1)


@pytest.mark.parametrize("cfa", list(CFA))
def test_a_site_is_the_mean_of_its_own_colour(cfa: CFA) -> None:
    rgb = COLOURS.expand(3, 24, 32)
    assert torch.allclose(bin_mosaic(mosaic(rgb, cfa), cfa, 4), mosaic(rgb[:, :6, :8], cfa))
    raw = torch.rand(1, 16, 24, generator=torch.Generator().manual_seed(0))
    binned = bin_mosaic(raw, cfa, 2)
    assert binned[0, 3, 4].item() == pytest.approx(raw[0, [5, 5, 7, 7], [8, 10, 8, 10]].mean().item())
    assert torch.equal(bin_mosaic(raw, cfa, 1), raw)


@pytest.mark.parametrize("cfa", ["XTRANS", "RGBW"])
def test_other_patterns_are_refused(cfa: str) -> None:
    with pytest.raises(ValueError, match=f"CFA '{cfa}' is not a Bayer pattern"):
        bin_mosaic(torch.zeros(1, 24, 24), cfa, 2)
    with pytest.raises(ValueError, match=r"\(24, 24\) cannot be binned by 5"):
        bin_mosaic(torch.zeros(1, 24, 24), "RGGB", 5)


def test_noise_falls_by_the_number_of_sites() -> None:
    generator = torch.Generator().manual_seed(0)
    raw = torch.rand(1, 1, 48, generator=generator).repeat_interleave(16, 2).expand(1, 768, 768)
    noisy = raw + torch.randn(raw.shape, generator=generator) * (4e-3 * raw + 1e-4) ** 0.5
    srgb = torch.zeros(3, 768, 768, dtype=torch.uint8)
    pair = Pair("a", srgb, raw.contiguous(), CFA.RGGB, noisy=noisy, shot_var=4e-3, read_var=1e-4).binned(4)
    assert pair.noisy is not None and (pair.shot_var, pair.read_var) == pytest.approx((2.5e-4, 6.25e-6))
    measured = captured_noise(pair.raw.numpy(), pair.noisy.numpy())
    assert measured[0] * 0.5 + measured[1] == pytest.approx(2.5e-4 * 0.5 + 6.25e-6, rel=0.05)


def test_pairs_are_opened_binned() -> None:
    whole, binned = open_pairs("demo:test"), open_pairs("demo:test", bin=4)
    assert isinstance(binned, Binned) and binned.names == [pair.name for pair in whole]
    pair = binned[0]
    assert pair.raw.shape == (1, 72, 112) and pair.srgb.shape == (3, 72, 112) and pair.cfa == whole[0].cfa
    assert pair.raw.mean().item() == pytest.approx(whole[0].raw.mean().item(), rel=1e-5)
    assert shared_frame(whole, binned) is not None and stamps(whole) != stamps(binned)
    readable = Readable(binned)
    readable.broken[0] = "damaged"
    assert readable.kept()[0].raw.shape == (1, 72, 112)
    with pytest.raises(ValueError, match="bin must be at least 1, got 0"):
        open_pairs("demo:test", bin=0)
    with pytest.raises(ValueError, match="too small to be binned by 200"):
        demo_pairs("test", count=1)[0].binned(200)
