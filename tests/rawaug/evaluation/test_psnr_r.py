"""PSNR_r of an ISP."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, cast

import pytest
import torch

from rawaug.data import demo_pairs
from rawaug.data.pairs import Pair
from rawaug.evaluation.psnr_r import block_psnr, psnr_r
from rawaug.isp.config import ISPConfig
from rawaug.isp.model import DictionaryISP
from rawaug.metrics import patch_psnr


def test_patch_by_patch_it_is_that_of_the_whole_mosaic() -> None:
    pair = demo_pairs("validation", count=1)[0]
    isp = DictionaryISP(ISPConfig(cfa="GRBG"))
    cast(Any, isp.stages["shading"]).mask.set(torch.zeros(2), torch.eye(2))
    mosaic = torch.cat([pair.clean.mosaic] * 2, 1)
    tall = Pair("tall", replace(pair.clean, mosaic=mosaic), torch.cat([pair.srgb] * 2, 1))
    with torch.no_grad():
        whole = isp.reverse(tall.srgb[None]).raw.clamp(0.0, 1.0)
    assert psnr_r(isp, tall) == pytest.approx(patch_psnr(whole, tall.clean.mosaic[None]).item(), abs=1e-5)


def test_a_clipped_block_is_left_out() -> None:
    raw, clipped = torch.full((3, 4, 4), 0.5), torch.zeros(4, 4, dtype=torch.bool)
    made = raw + 0.01
    made[:, 1, 2], clipped[1, 2] = 0.0, True
    assert block_psnr(made, raw, clipped) == pytest.approx(40.0, abs=1e-3)
