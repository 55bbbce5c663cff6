"""Pairs: what they hold, which are chosen, binned frames, and the noise of a capture."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from rawaug.bayer import CFA, bin_mosaic, bin_mosaic_variance, mosaic
from rawaug.data import demo_pairs, open_pairs
from rawaug.data.frames import FrameLabel, Frames, Readable, as_frames, shared_frame
from rawaug.data.noise_levels import measure_noise
from rawaug.data.pairs import Pair
from rawaug.data.selection import one_a_phone, select_pairs, whole_scenes
from rawaug.experiment.data import open_frames
from rawaug.experiment.settings import ArmConfig, DataConfig, Recipe
from rawaug.io import RawFrame


def pair(**changes: Any) -> Pair:
    fields: dict[str, Any] = {
        "name": "shot",
        "clean": RawFrame(torch.zeros(1, 6, 8), CFA.RGGB, white_balance=(2.0, 1.0, 1.5)),
        "srgb": torch.zeros(3, 6, 8, dtype=torch.uint8),
    }
    return Pair(**{**fields, **changes})


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"srgb": torch.zeros(3, 6, 8)},
            r"shot: srgb .*uint8",
        ),
        ({"srgb": torch.zeros(3, 6, 6, dtype=torch.uint8)}, r"srgb .*\(3, 6, 6\)"),
        ({"clean": RawFrame(torch.zeros(6, 8), "RGGB")}, r"clean .*float32"),
        ({"clean": RawFrame(torch.zeros(1, 6, 8), "XTRANS")}, "XTRANS"),
        ({"noisy": RawFrame(torch.zeros(1, 6, 6), "RGGB")}, r"noisy .*\(1, 6, 8\)"),
        (
            {"srgb": torch.zeros(3, 5, 8, dtype=torch.uint8), "clean": RawFrame(torch.zeros(1, 5, 8), "RGGB")},
            "even sides",
        ),
        (
            {"clean": RawFrame(torch.zeros(1, 6, 8), "RGGB", color_matrix=torch.eye(4))},
            r"color_matrix .*\(3, 3\)",
        ),
    ],
)
def test_what_does_not_fit_is_refused_in_one_line(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message) as caught:
        pair(**changes)
    assert "\n" not in str(caught.value)


def test_a_recipe_augments_the_pictures_of_the_pairs_that_it_trains_on() -> None:
    pairs, test = demo_pairs("train", count=3), demo_pairs("test", count=1)
    data = DataConfig(count=2, pictures="pairs", validation=None)
    recipe = Recipe(data=data, arms={"ours": ArmConfig(augmented=0.5)})
    frames, _ = open_frames(recipe, {"pairs": pairs, "test": test})
    pictures = frames["pictures"]
    assert len(pictures) == 2 == len(pictures[:])
    assert torch.equal(pictures[1], pairs[1].srgb)
    with pytest.raises(ValueError, match=r"data\.pictures: .*pairs"):
        replace(data, pairs=None)


PHONES = ("GP", "IP", "S6")
LABELS = [FrameLabel(f"{scene:03d}", phone, iso) for scene in (1, 2) for phone in PHONES for iso in (100, 400, 1600)]


class Shots(Frames[Pair]):
    """Eighteen tiny frames of two scenes by three phones; notes which were read."""

    def __init__(self) -> None:
        super().__init__([f"{k:04d}_{label.scene}_{label.phone}_010" for k, label in enumerate(LABELS)])
        self.labels = LABELS
        self.seen: list[int] = []

    def read(self, index: int) -> Pair:
        self.seen.append(index)
        return Pair(self.names[index], RawFrame(torch.zeros(1, 2, 2), "RGGB"), torch.zeros(3, 2, 2, dtype=torch.uint8))


def test_the_first_ones_are_of_one_phone_and_others_are_not() -> None:
    shots = Shots()
    first = select_pairs(shots, 18, 3)
    assert first == [0, 1, 2] and {LABELS[k].phone for k in first} == {"GP"}
    one_each = select_pairs(shots, 18, 3, "phones")
    assert not shots.seen, "none is read"
    assert sorted(LABELS[k].phone for k in one_each) == sorted(PHONES)
    assert {LABELS[k].iso for k in one_each} == {400}, "not base ISO"


def test_phones_take_turns_and_spread_in_iso() -> None:
    chosen = one_a_phone(LABELS, 8)
    counts = [sum(LABELS[k].phone == phone for k in chosen) for phone in PHONES]
    assert counts == [3, 3, 2] and len(set(chosen)) == 8
    assert [LABELS[k].phone for k in chosen[:3]] == list(PHONES)
    assert {LABELS[k].iso for k in chosen if LABELS[k].phone == "GP"} == {100, 400, 1600}
    with pytest.raises(ValueError, match=r"data\.count: .*pairs"):
        one_a_phone(LABELS, 20)


def test_scenes_are_whole() -> None:
    assert whole_scenes(LABELS, 9) == list(range(9)) and whole_scenes(LABELS, 18) == list(range(18))
    with pytest.raises(ValueError, match=r"data\.count: .*scenes"):
        select_pairs(Shots(), 18, 5, "scenes")


def test_names_are_of_frames_or_of_their_folders_and_what_is_held_out_is_not_chosen() -> None:
    assert select_pairs(Shots(), 18, None, ["0004_001_IP_010", "0017_002_S6"]) == [4, 17]
    with pytest.raises(ValueError, match=r"data\.select: 0099"):
        select_pairs(Shots(), 18, None, ["0099"])
    assert select_pairs(Shots(), 4, None) == [0, 1, 2, 3]
    assert max(select_pairs(Shots(), 9, 3, "phones")) < 9 and select_pairs(Shots(), 9, 9, "scenes") == list(range(9))
    with pytest.raises(ValueError, match="0017_002_S6"):
        select_pairs(Shots(), 9, None, ["0017_002_S6"])


def test_what_has_no_labels_is_refused() -> None:
    pairs = list(Shots())
    assert select_pairs(pairs, 18, 2) == [0, 1]
    with pytest.raises(ValueError, match="phones"):
        select_pairs(pairs, 18, 2, "phones")
    with pytest.raises(ValueError, match="'best'"):
        select_pairs(pairs, 18, 2, "best")


COLOURS = torch.tensor([0.2, 0.5, 0.8]).reshape(3, 1, 1)


@pytest.mark.parametrize("cfa", list(CFA))
def test_a_site_is_the_mean_of_its_own_colour(cfa: CFA) -> None:
    rgb = COLOURS.expand(3, 24, 32)
    assert torch.allclose(bin_mosaic(mosaic(rgb, cfa), cfa, 4), mosaic(rgb[:, :6, :8], cfa))
    raw = torch.rand(1, 24, 30, generator=torch.Generator().manual_seed(0))
    assert torch.equal(bin_mosaic(raw, cfa, 1), raw)


@pytest.mark.parametrize("factor", [2, 3, 4, 5])
def test_binned_sites_lie_where_a_sensor_s_lie(factor: int) -> None:
    """A ramp keeps its slope from site to site, whatever their colours."""
    rows, columns = (torch.arange(24.0 * factor) for _ in range(2))
    ramp = (3.0 * rows[:, None] + columns)[None]
    binned = bin_mosaic(ramp, "GRBG", factor)[:, 2:-2, 2:-2]
    assert torch.allclose(binned.diff(dim=-1), torch.tensor(float(factor)), atol=1e-2)
    assert torch.allclose(binned.diff(dim=-2), torch.tensor(3.0 * factor), atol=1e-2)
    assert binned[0, 0, 0].item() == pytest.approx(4.0 * (2.5 * factor - 0.5), abs=1e-2)
    noise = torch.randn(1, 1600, 1600, generator=torch.Generator().manual_seed(0))
    side = 1600 // (2 * factor) * 2 * factor
    left = bin_mosaic(noise[..., :side, :side], "GRBG", factor)[..., 4:-4, 4:-4].var().item()
    assert left == pytest.approx(bin_mosaic_variance(factor), rel=0.03)
    assert bin_mosaic_variance(factor) == pytest.approx(factor**-2, rel=0.35)


@pytest.mark.parametrize("factor", [1, 2, 3, 4])
def test_sites_that_are_binned_together_share_one_centre(factor: int) -> None:
    """All four read the same value of a ramp, that at the middle of their cell's area."""
    rows, columns = (torch.arange(24.0 * factor) for _ in range(2))
    ramp = (3.0 * rows[:, None] + columns)[None]
    cell = bin_mosaic(ramp, "GRBG", factor, together=True)[0, 2:4, 2:4]
    assert torch.allclose(cell, torch.tensor(4.0 * (3 * factor - 0.5)), atol=1e-4)
    side = 1600 // (2 * factor) * 2 * factor
    noise = torch.randn(1, side, side, generator=torch.Generator().manual_seed(0))
    left = bin_mosaic(noise, "GRBG", factor, together=True)[..., 4:-4, 4:-4].var().item()
    assert left == pytest.approx(bin_mosaic_variance(factor, together=True), rel=0.03)


def test_both_frames_of_a_pair_have_one_pattern() -> None:
    clean = RawFrame(torch.zeros(1, 4, 6), "RGGB")
    with pytest.raises(ValueError, match=r"RGGB.*GRBG"):
        Pair("a", clean, torch.zeros(3, 4, 6, dtype=torch.uint8), replace(clean, cfa="GRBG"))


@pytest.mark.parametrize("cfa", ["XTRANS", "RGBW"])
def test_other_patterns_are_refused(cfa: str) -> None:
    with pytest.raises(ValueError, match=f"CFA '{cfa}' is not a Bayer pattern"):
        bin_mosaic(torch.zeros(1, 24, 24), cfa, 2)
    with pytest.raises(ValueError, match="binned"):
        bin_mosaic(torch.zeros(1, 24, 24), "RGGB", 5)


def test_noise_falls_by_the_number_of_sites() -> None:
    generator = torch.Generator().manual_seed(0)
    raw = torch.rand(1, 1, 48, generator=generator).repeat_interleave(16, 2).expand(1, 768, 768)
    noisy = raw + torch.randn(raw.shape, generator=generator) * (4e-3 * raw + 1e-4) ** 0.5
    srgb = torch.zeros(3, 768, 768, dtype=torch.uint8)
    clean = RawFrame(raw.contiguous(), CFA.RGGB)
    pair = Pair("a", clean, srgb, replace(clean, mosaic=noisy, noise_profile=(4e-3, 1e-4))).binned(4)
    left = bin_mosaic_variance(4)
    assert pair.noisy is not None and pair.noisy.noise_profile == pytest.approx((4e-3 * left, 1e-4 * left))
    measured = measure_noise(pair.clean.mosaic.numpy(), pair.noisy.mosaic.numpy())
    assert measured[0] * 0.5 + measured[1] == pytest.approx((4e-3 * 0.5 + 1e-4) * left, rel=0.05)


def test_pairs_are_opened_binned() -> None:
    whole, binned = open_pairs("demo:test"), open_pairs("demo:test", bin=4)
    assert as_frames(binned).names == [pair.name for pair in whole]
    pair = binned[0]
    assert pair.clean.mosaic.shape == (1, 72, 112) and pair.srgb.shape == (3, 72, 112) and pair.cfa == whole[0].cfa
    assert pair.clean.mosaic.mean().item() == pytest.approx(whole[0].clean.mosaic.mean().item(), rel=1e-3)
    assert shared_frame(whole, binned) is not None and as_frames(whole).stamps() != as_frames(binned).stamps()
    readable = Readable(binned)
    readable.broken[0] = "damaged"
    assert readable.readable()[0].clean.mosaic.shape == (1, 72, 112)
    with pytest.raises(ValueError, match=r"^bin"):
        open_pairs("demo:test", bin=0)
    with pytest.raises(ValueError, match="binned"):
        demo_pairs("test", count=1)[0].binned(200)


@pytest.mark.parametrize(("shot_var", "read_var"), [(1e-2, 4e-4), (2e-3, 1e-6), (1e-5, 1e-3)])
@pytest.mark.parametrize("clipped", [False, True])
def test_both_levels_are_found(shot_var: float, read_var: float, clipped: bool) -> None:
    rng = np.random.default_rng(0)
    clean = rng.random((400, 500)) ** 2
    noisy = clean + rng.normal(size=clean.shape) * np.sqrt(shot_var * clean + read_var)
    found = measure_noise(clean, noisy.clip(0, 1) if clipped else noisy)
    for y in (0.05, 0.3, 0.8):
        assert found[0] * y + found[1] == pytest.approx(shot_var * y + read_var, rel=0.15 if clipped else 0.05)


def test_levels_are_positive_whatever_is_given() -> None:
    flat = np.full((8, 8), 0.5)
    assert min(measure_noise(flat, flat)) > 0 and min(measure_noise(flat, flat + 0.1)) > 0
    rng = np.random.default_rng(0)
    falling = rng.random((300, 300))
    assert min(measure_noise(falling, falling + rng.normal(size=falling.shape) * (1.1 - falling))) > 0
