"""PSNR_d and its crops: one seed one figure, whatever the method; the pattern is kept, and every draw is replayed."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from rawaug import bayer
from rawaug.bayer import CFA
from rawaug.data.pairs import Pair
from rawaug.evaluation.trials import make_trial
from rawaug.isp.config import ISPConfig
from rawaug.isp.model import DictionaryISP
from rawaug.noise import NoiseModel, noise_model
from rawaug.paper import downstream
from rawaug.paper.baselines import UPI
from rawaug.paper.baselines.unet import UNetISP
from rawaug.paper.downstream import DownstreamConfig, MadeCrops, psnr_d
from rawaug.training.config import DenoiserConfig

SILENT = noise_model((0.0, 0.0))
TINY = DownstreamConfig(test=["given:"], denoiser=DenoiserConfig("UNet", {"width": 4, "scales": 2})).shortest()
TINY = replace(TINY, test_count=None, train=replace(TINY.train, crop=32))


def seeded(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def made(
    pictures: Sequence[Tensor], cfa: CFA = CFA.GRBG, noise: NoiseModel = SILENT, gain: float = 1.0, crop: int = 16
) -> MadeCrops:
    return MadeCrops(pictures, lambda x, g: bayer.mosaic(gain * x, cfa), cfa, noise, crop)


@pytest.mark.parametrize("cfa", list(CFA))
def test_crops_keep_the_pattern_in_every_turn(cfa: CFA) -> None:
    colours = torch.tensor([51, 102, 204], dtype=torch.uint8)[:, None, None].expand(3, 40, 48)
    expected = (torch.tensor([51.0, 102.0, 102.0, 204.0]) / 255.0)[:, None, None].expand(4, 8, 8)
    for seed in range(16):
        sample = made([colours], cfa).draw(seeded(seed))
        assert torch.equal(sample.clean, expected) and torch.equal(sample.noisy, expected)
        assert sample.variance.abs().max() == 0.0


@pytest.fixture
def scored(monkeypatch: pytest.MonkeyPatch, given: list[Pair], frame_of: Callable[..., Pair]) -> list[Pair]:
    """The test frames of :func:`psnr_d`, two small ones a call; one is measured whole and one in part."""
    seen: list[Pair] = []

    def trial(pair: Pair, *rest: Any) -> Any:
        seen.append(pair)
        return make_trial(pair, *rest)

    given.extend([frame_of("small", size=(64, 64)), frame_of("large", size=(96, 130))])
    monkeypatch.setattr(downstream, "make_trial", trial)
    return seen


PICTURES = [torch.randint(0, 256, (3, 40, 48), generator=seeded(k), dtype=torch.uint8) for k in range(3)]
MODELS: dict[str, Callable[[], Any]] = {
    "dictionary": lambda: DictionaryISP(ISPConfig(cfa="GRBG")),
    "upi": lambda: UPI("GRBG"),
    "network": lambda: UNetISP("GRBG", width=4).eval(),
}


@pytest.mark.parametrize("family", list(MODELS))
def test_psnr_d_depends_on_the_seed_alone(family: str, scored: list[Pair], tmp_path: Path) -> None:
    torch.manual_seed(0)
    once = psnr_d(MODELS[family](), PICTURES, TINY, tmp_path / "a", 3)
    log = tmp_path / "a" / "seed3" / "log.csv"
    steps = log.read_text()
    torch.manual_seed(1)
    assert psnr_d(MODELS[family](), PICTURES, TINY, tmp_path / "a", 3) == once
    assert log.read_text() == steps  # from its checkpoint, not trained again
    if family != "upi":
        return
    torch.manual_seed(2)
    assert psnr_d(MODELS[family](), PICTURES, TINY, tmp_path / "b", 3) == once
    assert psnr_d(MODELS[family](), PICTURES, TINY, tmp_path / "a", 4) != once
    assert 5.0 < once < 60.0


def test_the_piece_at_the_centre_is_scored_in_its_pattern(scored: list[Pair], tmp_path: Path) -> None:
    for side in (None, 66):
        psnr_d(MODELS["upi"](), PICTURES, replace(TINY, test_crop=side), tmp_path, 0)
    small, large, same, piece = scored
    assert (
        torch.equal(same.clean.mosaic, small.clean.mosaic)
        and piece.clean.mosaic.shape == (1, 66, 66)
        and piece.srgb.shape == (3, 66, 66)
    )
    assert piece.cfa == large.cfa
    assert torch.equal(piece.clean.mosaic, large.clean.mosaic[:, 14:80, 32:98])
    assert torch.equal(piece.srgb, large.srgb[:, 14:80, 32:98])
