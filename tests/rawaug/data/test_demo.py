"""The demo: the physics of its camera, and splits that share nothing."""

from __future__ import annotations

import math
from collections.abc import Iterator

import pytest
import torch

from rawaug.bayer import CFA, pack
from rawaug.data import DemoCamera, demo_pairs, demo_photographs, demo_pictures, open_pairs, open_pictures
from rawaug.data.demo import (
    BLACK,
    FRAME,
    NOISE_LEVELS,
    PAIRS,
    PHOTOGRAPHS,
    PICTURES_ONLY,
    WHITE,
    DemoShot,
    _leaves,
    _pair,
    _shading,
    _tone,
)


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def flat(level: int, size: int = 192) -> torch.Tensor:
    return torch.full((3, size, size), level, dtype=torch.uint8)


DAYLIGHT = DemoShot(white_balance=(2.0, 1.0, 1.5), exposure=0.9, iso=100, noise_seed=7)


def test_capture_is_sample_and_apply_and_replays_bit_for_bit() -> None:
    picture = torch.randint(0, 256, (3, 32, 48), dtype=torch.uint8, generator=generator())
    camera = DemoCamera()
    captured = camera.capture(picture, generator(3), "shot")
    again = camera.apply(picture, camera.sample(generator(3)), "shot")
    assert torch.equal(captured.srgb, again.srgb)
    for first, second in ((captured.clean, again.clean), (captured.noisy, again.noisy)):
        assert first is not None and second is not None and torch.equal(first.mosaic, second.mosaic)
        assert torch.equal(first.color_matrix, second.color_matrix)
    assert captured.clean.white_balance == again.clean.white_balance and captured.cfa == CFA.GRBG


@pytest.mark.parametrize("iso", NOISE_LEVELS)
@pytest.mark.parametrize("level", [0, 60, 255])
def test_noise_has_the_variance_of_its_levels_and_no_bias(iso: int, level: int) -> None:
    pair = DemoCamera().apply(flat(level), DAYLIGHT._replace(iso=iso))
    assert pair.noisy is not None and pair.noisy.noise_profile is not None
    noise = (pair.noisy.mosaic - pair.clean.mosaic).double()
    step = 1 / (WHITE - BLACK)
    expected = (
        pair.noisy.noise_profile[0] * pair.clean.mosaic.double().mean() + pair.noisy.noise_profile[1] + step**2 / 12
    )
    spread = math.sqrt(2 / noise.numel())
    assert noise.square().mean() / expected == pytest.approx(1, abs=6 * spread + 0.02)
    assert abs(noise.mean()) < 5 * (expected / noise.numel()) ** 0.5 + 0.01 * expected**0.5
    if level == 0:
        assert (pair.noisy.mosaic < 0).float().mean() > 0.3, "clipped at black"
    assert pair.noisy.mosaic.max() <= 1


def test_raw_holds_digital_numbers() -> None:
    pair = DemoCamera().capture(
        torch.randint(0, 256, (3, 32, 48), dtype=torch.uint8, generator=generator()), generator()
    )
    assert pair.noisy is not None
    for raw in (pair.clean.mosaic, pair.noisy.mosaic):
        numbers = raw.double() * (WHITE - BLACK) + BLACK
        assert (numbers - numbers.round()).abs().max() < 1e-3
        assert numbers.min() > -1e-3 and numbers.max() < WHITE + 1e-3


@pytest.mark.parametrize("seed", range(5))
def test_grey_stays_grey_and_flat_in_any_light(seed: int) -> None:
    pair = DemoCamera().capture(flat(128, 64), generator(seed), iso=100)
    assert pair.srgb.float().std() < 1.0
    sites = pack(pair.clean.mosaic, pair.cfa).mean((-2, -1))
    red, green, blue = sites[0], (sites[1] + sites[2]) / 2, sites[3]
    assert (green / red).item() == pytest.approx(pair.clean.white_balance[0], rel=0.01)
    assert (green / blue).item() == pytest.approx(pair.clean.white_balance[2], rel=0.01)


def test_raw_falls_off_towards_the_corners_around_a_point_off_centre() -> None:
    shading = _shading(256, 384)
    row, column = divmod(int(shading.argmax()), 384)
    assert (row, column) != (128, 192) and abs(row - 128) < 30 and abs(column - 192) < 30
    corners = shading[[0, 0, -1, -1], [0, -1, 0, -1]]
    assert 0.5 < corners.min() < corners.max() < 0.7
    raw = DemoCamera().apply(flat(255), DAYLIGHT).clean.mosaic
    green = pack(raw, CFA.GRBG)[1]
    expected = _shading(192, 192)[0::2, 0::2] * DAYLIGHT.exposure  # Gr comes first in GRBG
    assert torch.allclose(green, expected, atol=1e-3)


@pytest.mark.parametrize("cfa", list(CFA))
def test_a_saturated_primary_lights_its_own_sites_most(cfa: CFA) -> None:
    for channel, sites in ((0, (0,)), (1, (1, 2)), (2, (3,))):
        picture = torch.zeros(3, 32, 32, dtype=torch.uint8)
        picture[channel] = 255
        shot = DAYLIGHT._replace(white_balance=(1.0, 1.0, 1.0))
        pair = DemoCamera(cfa).apply(picture, shot)
        means = pack(pair.clean.mosaic, cfa).mean((-2, -1))
        assert set(means.topk(len(sites)).indices.tolist()) == set(sites)
        assert pair.srgb.float().mean((1, 2)).argmax() == channel


def test_gains_are_those_of_daylight_to_tungsten() -> None:
    shots = [DemoCamera().sample(generator(seed)) for seed in range(200)]
    red = torch.tensor([shot.white_balance[0] for shot in shots])
    blue = torch.tensor([shot.white_balance[2] for shot in shots])
    assert red.min() >= 1.5 and red.max() <= 2.3 and blue.min() >= 1.29 and blue.max() <= 2.2
    assert torch.corrcoef(torch.stack([red, blue]))[0, 1] < -0.9
    assert {shot.iso for shot in shots} == set(NOISE_LEVELS)


def test_the_tone_curve_keeps_order_and_ends() -> None:
    curve = _tone(torch.linspace(0, 1, 4096))
    assert (curve.diff() > 0).all() and curve[0] == 0 and curve[-1] == pytest.approx(1)


def test_a_scene_that_is_no_picture_is_refused() -> None:
    with pytest.raises(ValueError, match=r"demo: .*scene"):
        DemoCamera().capture(torch.rand(3, 8, 8), generator())
    with pytest.raises(ValueError, match="sides"):
        DemoCamera().capture(torch.zeros(3, 9, 8, dtype=torch.uint8), generator())


def forget() -> None:
    """What was made, so that it is made anew."""
    _pair.cache_clear()
    _leaves.cache_clear()


@pytest.fixture
def made_anew() -> Iterator[None]:
    forget()
    yield
    forget()


def test_splits_share_no_photograph() -> None:
    names = [*PICTURES_ONLY, *(name for files in PHOTOGRAPHS.values() for name in files)]
    assert len(set(names)) == len(names)
    for split, files in PHOTOGRAPHS.items():
        photographs = demo_photographs(split)
        assert list(photographs) == [file.split(".")[0] for file in files]
        assert all(photograph.dtype == torch.uint8 and photograph.shape[0] == 3 for photograph in photographs.values())


@pytest.mark.usefixtures("made_anew")
@pytest.mark.parametrize("split", PHOTOGRAPHS)
def test_dead_leaves_of_a_split_are_textured_from_no_other(split: str, monkeypatch: pytest.MonkeyPatch) -> None:
    used: list[torch.Tensor] = []

    def record(height: int, width: int, sources: list[torch.Tensor], generator: torch.Generator) -> torch.Tensor:
        used.extend(sources)
        return torch.zeros(3, height, width, dtype=torch.uint8)

    monkeypatch.setattr("rawaug.data.demo.dead_leaves", record)
    demo_pairs(split)
    if split == "train":
        assert len(open_pictures("demo:")) == 32
    sources = {source.data_ptr() for source in used}
    for other in PHOTOGRAPHS:
        photographs = {photograph.data_ptr() for photograph in demo_photographs(other).values()}
        assert photographs <= sources if other == split else not photographs & sources


def test_pairs_of_every_split() -> None:
    for split, count in PAIRS.items():
        pairs = demo_pairs(split)
        assert len(pairs) == len({pair.name for pair in pairs}) == count
        for pair in pairs:
            assert pair.clean.mosaic.shape == (1, *FRAME) and pair.cfa == CFA.GRBG and pair.registered
            assert pair.noisy is not None and pair.name.startswith(f"{split}_")
            assert (pair.clean.mosaic >= 1).float().mean() < 0.01, "clipped"
    assert len({pair.noisy.noise_profile for pair in demo_pairs("test") if pair.noisy is not None}) == 6


def test_a_pair_depends_on_its_key_alone() -> None:
    first = demo_pairs("train", 1)
    forget()
    longer = demo_pairs("train", 3)
    assert first[0] is not longer[0] and longer[0] is demo_pairs("train", 1)[0]
    assert torch.equal(first[0].srgb, longer[0].srgb)
    assert first[0].noisy is not None and longer[0].noisy is not None
    assert torch.equal(first[0].noisy.mosaic, longer[0].noisy.mosaic)
    assert not torch.equal(longer[0].clean.mosaic, longer[1].clean.mosaic)


def test_pictures_are_many_and_differ() -> None:
    photographs = 2 + len(PICTURES_ONLY)
    pictures = demo_pictures(photographs + 3)
    assert [tuple(picture.shape) for picture in pictures[photographs:]] == [(3, *FRAME)] * 3
    assert not torch.equal(pictures[-2], pictures[-1])
    forget()
    assert torch.equal(pictures[-2], demo_pictures(photographs + 2)[-1])
    assert len(demo_pictures(1)) == 1


def test_open_by_name() -> None:
    assert [pair.name for pair in open_pairs("demo:validation")] == [pair.name for pair in demo_pairs("validation")]
    assert len(open_pairs("demo:", split="train")) == PAIRS["train"]
    with pytest.raises(ValueError, match=r"demo: .*validation"):
        open_pairs("demo:holdout")
    with pytest.raises(ValueError, match="count"):
        demo_pairs("train", 0)
