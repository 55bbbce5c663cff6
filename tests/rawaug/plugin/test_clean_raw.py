"""Pairs of clean RAW: noise alone, at the levels that are asked for, on whole cells of every pattern."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.utils.data import DataLoader

import rawaug
from rawaug.bayer import pack, pattern
from rawaug.data.pairs import Pair
from rawaug.io import RawFrame
from rawaug.noise import RowNoise
from rawaug.plugin.clean_raw import RawNoise
from rawaug.plugin.dataset import RawPairs
from rawaug.plugin.stream import RawPairStream
from rawaug.plugin.wrapped import wrap

LEVELS = (1e-3, 1e-5)


@pytest.fixture
def sites() -> Tensor:
    """A mosaic of a GBRG sensor whose colours are 0.1 (R), 0.2 (Gr), 0.3 (Gb) and 0.4 (B)."""
    cell = torch.tensor([[0.3, 0.4], [0.1, 0.2]])
    return cell.repeat(20, 24)[None]


COLOURS = torch.tensor([0.1, 0.2, 0.3, 0.4])
TURNED = torch.tensor([0.1, 0.3, 0.2, 0.4])
"""With rows and columns exchanged the greens change places."""


def is_whole(clean: Tensor) -> bool:
    """Whether each plane holds one colour."""
    means = clean.mean((1, 2))
    constant = torch.allclose(clean, means[:, None, None].expand_as(clean))
    return constant and any(torch.allclose(means, colours) for colours in (COLOURS, TURNED))


def test_crops_and_turns_keep_the_pattern(sites: Tensor) -> None:
    pairs = RawPairs([sites], RawNoise((0.0, 0.0), cfa="GBRG"), crop=16)
    views = set()
    for epoch in range(40):
        pairs.set_epoch(epoch)
        noisy, clean, _, params = pairs[0]
        assert clean.shape == (4, 8, 8) and is_whole(clean) and torch.equal(noisy, clean)
        views.add(int(params.crop[4]))
    assert views == set(range(8))


def test_a_crop_that_fills_its_frame_is_not_turned(sites: Tensor) -> None:
    pairs = RawPairs([sites[:, :16, :16]], RawNoise((0.0, 0.0), cfa="GBRG"), crop=16)
    for epoch in range(4):
        pairs.set_epoch(epoch)
        assert torch.equal(pairs[0].clean, pack(sites[:, :16, :16], "GBRG"))


def test_the_noise_is_that_which_was_asked_for() -> None:
    clean = torch.tensor([0.05, 0.2, 0.4, 0.6])[:, None, None].expand(4, 256, 256)
    noisy, same, variance, _ = RawPairs([clean], RawNoise(LEVELS), crop=None, views=False)[0]
    assert torch.equal(same, clean) and variance.shape == clean.shape
    expected = LEVELS[0] * clean.mean((1, 2)) + LEVELS[1]
    assert ((noisy - clean).var((1, 2)) / expected - 1).abs().max() < 0.03


def test_every_form_of_a_frame_is_the_same_raw(sites: Tensor) -> None:
    packed = pack(sites, "GBRG")
    srgb = torch.zeros(3, *sites.shape[-2:], dtype=torch.uint8)
    frames: list[Any] = [
        packed,
        packed.double().numpy(),
        sites,
        sites[0].numpy(),
        RawFrame(sites, "GBRG"),
        Pair("shot", RawFrame(sites, "GBRG"), srgb),
    ]
    noise = RawNoise(LEVELS, cfa="GBRG")
    expected = noise.apply(packed, noise.sample(packed, torch.Generator().manual_seed(0)))
    for frame in frames:
        pair = noise(frame, torch.Generator().manual_seed(0))
        assert torch.allclose(pair.clean, packed) and torch.allclose(pair.noisy, expected.noisy)


def test_other_patterns_stay_mosaics() -> None:
    colours = torch.tensor([0.1, 0.2, 0.3])[:, None, None].expand(3, 48, 48)
    for name in ("XTRANS", "QUAD-RGGB"):
        mosaic = pattern(name).mosaic(colours[None])[0]
        pairs = RawPairs([mosaic], RawNoise((0.0, 0.0), cfa=name), crop=24)
        for epoch in range(12):
            pairs.set_epoch(epoch)
            assert torch.allclose(pairs[0].clean, mosaic[:, :24, :24])
        with pytest.raises(ValueError, match="planes"):
            RawPairs(
                [mosaic],
                RawNoise({"name": "SensorNoise", "settings": {"levels": "upi", "green_imbalance": 0.1}}, cfa=name),
                crop=24,
            )[0]


def test_pairs_replay_and_wrap_has_the_same_face(sites: Tensor) -> None:
    noise = RawNoise("cycleisp_sidd", cfa="GBRG")
    pairs = RawPairs([sites, sites + 0.1], noise, crop=16, seed=3)
    noisy, clean, _, params = pairs[1]
    again = pairs.replay(1, params)
    assert torch.equal(again.noisy, noisy) and torch.equal(again.clean, clean)

    loader = wrap(DataLoader([sites, sites + 0.1], batch_size=2), noise, crop=(8, 16), fields=("noisy", "clean"))  # type: ignore[arg-type]
    ((batch, target),) = loader
    assert batch.shape == target.shape == (2, 4, 4, 8)
    (whole,) = wrap([pack(sites, "GBRG")[None]], noise)
    assert whole.noisy.shape == (1, 4, 20, 24)
    (sample,) = RawPairStream([{"raw": sites, "iso": 100}], noise, crop=16, key="raw", keys=("lq", "gt"))
    assert sample["lq"].shape == (4, 8, 8) and sample["iso"] == 100


def test_a_folder_of_raw_files_needs_no_reader(tmp_path: Path) -> None:
    from rawaug.io.dng import write_dng

    mosaic = (torch.rand(1, 64, 80, generator=torch.Generator().manual_seed(0)) * 0.5 * 1023).round() / 1023
    frame = RawFrame(mosaic, "GRBG", white=1023.0)
    write_dng(tmp_path / "shot.dng", frame)
    pairs = RawPairs(tmp_path, RawNoise(LEVELS), crop=32, keys={"lq": "noisy", "gt": "clean", "lq_path": "name"})
    sample = pairs[0]
    assert len(pairs) == 1 and sample["lq"].shape == (4, 16, 16) and sample["lq_path"].endswith("shot.dng")
    assert RawPairs("demo:train", RawNoise(LEVELS), crop=32)[0].noisy.shape == (4, 16, 16)


@pytest.mark.parametrize(
    ("frame", "settings", "word"),
    [
        (torch.rand(1, 8, 8), {}, "cfa"),
        (torch.randint(1023, (4, 8, 8)), {}, "floating point"),
        (torch.rand(4, 8, 8) * 1023, {}, "white at 1"),
        (torch.full((4, 8, 8), torch.nan), {}, "finite"),
        (torch.rand(3, 8, 8), {}, "packed"),
        ("shot.dng", {}, "RawFrame"),
        (torch.rand(4, 4, 4), {"crop": 16}, "crop"),
        (torch.rand(4, 8, 8), {"bgr": True}, "bgr"),
        (torch.rand(4, 8, 8), {"zoom": 2.0, "crop": 4}, "zoom"),
    ],
)
def test_what_is_no_clean_raw_is_refused(frame: Any, settings: dict[str, Any], word: str) -> None:
    with pytest.raises(ValueError, match=word):
        RawPairs([frame], RawNoise(LEVELS), **{"crop": 8, **settings})[0]


def test_its_own_draws_differ_and_can_be_repeated() -> None:
    frames = torch.rand(2, 4, 8, 8)
    first, second = RawNoise("upi"), RawNoise("upi")
    drawn = first(frames)
    assert torch.equal(drawn.noisy, second(frames).noisy)
    assert not torch.equal(drawn.noisy, first(frames).noisy)
    assert rawaug.RawNoise is RawNoise and "upi" not in repr(RawNoise(RowNoise(1e-6)))
    assert np.isfinite(drawn.variance.numpy()).all()


def test_only_the_parameters_of_a_pair_are_applied() -> None:
    noise = RawNoise("upi")
    frames = torch.full((2, 4, 8, 8), 0.5)
    params = noise.sample(frames)
    with pytest.raises(ValueError, match="params"):
        noise.apply(frames, params.tensors())  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="batch of 2"):
        noise.apply(frames[:1], params)
