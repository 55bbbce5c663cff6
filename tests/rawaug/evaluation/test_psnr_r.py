"""PSNR_r of an ISP."""

from __future__ import annotations

from typing import Any, cast

import pytest
import torch

from rawaug.data import demo_pairs
from rawaug.evaluation.psnr_r import block_psnr, mosaic_of, psnr_r
from rawaug.isp.config import ISPConfig
from rawaug.isp.model import DictionaryISP


def test_strips_give_the_whole_mosaic() -> None:
    pair = demo_pairs("validation", count=1)[0]
    isp = DictionaryISP(ISPConfig(cfa="GRBG"))
    cast(Any, isp.stages["shading"]).mask.set(torch.zeros(2), torch.eye(2))
    assert pair.raw.shape[-2] >= 256
    tall = type(pair)(**{**vars(pair), **{k: torch.cat([getattr(pair, k)] * 2, 1) for k in ("srgb", "raw", "noisy")}})
    with torch.no_grad():
        whole = isp.reverse(tall.srgb[None])
        torch.testing.assert_close(mosaic_of(isp, tall, whole.params), whole.raw.clamp(0.0, 1.0))
    assert psnr_r(isp, tall) > 5.0
    assert abs(psnr_r(isp, tall, patches=10**6) - psnr_r(isp, tall)) < 1e-3


def test_a_clipped_block_is_left_out() -> None:
    raw, clipped = torch.full((3, 4, 4), 0.5), torch.zeros(4, 4, dtype=torch.bool)
    made = raw + 0.01
    made[:, 1, 2], clipped[1, 2] = 0.0, True
    assert block_psnr(made, raw, clipped) == pytest.approx(40.0, abs=1e-3)
