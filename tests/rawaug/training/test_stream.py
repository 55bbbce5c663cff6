"""The stream of samples: keyed, in the network's pattern, divided as the arm says."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch.utils.data import DataLoader

from rawaug import bayer
from rawaug.bayer import CFA, noise_variance
from rawaug.data import demo_pairs, demo_photographs, demo_pictures
from rawaug.data.pairs import Pair
from rawaug.io import RawFrame
from rawaug.isp.model import DictionaryISP
from rawaug.noise import noise_model
from rawaug.plugin.augment import RawAugment
from rawaug.plugin.dataset import RawPairs
from rawaug.plugin.targets import Srgb, Target
from rawaug.seeding import keyed_generator
from rawaug.training.sources import OwnPictureCrops, RealCrops
from rawaug.training.stream import StepSampler, TrainingStream


def colour_pair(cfa: CFA) -> Pair:
    """A frame that is 0.2 at red, 0.5 at green and 0.8 at blue sites."""
    rgb = torch.tensor([0.2, 0.5, 0.8])[:, None, None].expand(3, 40, 48)
    srgb = torch.zeros(3, 40, 48, dtype=torch.uint8)
    return Pair("colours", RawFrame(bayer.mosaic(rgb, cfa), cfa), srgb)


@pytest.mark.parametrize("cfa", list(CFA))
def test_crops_of_any_sensor_come_in_the_networks_pattern(cfa: CFA) -> None:
    crops = RealCrops([colour_pair(cfa)], noise_model((0.0, 0.0)), crop=16, cfa=CFA.BGGR)
    expected = torch.tensor([0.2, 0.5, 0.5, 0.8])[:, None, None].expand(4, 8, 8)
    for seed in range(16):
        sample = crops.draw(torch.Generator().manual_seed(seed))
        assert torch.equal(sample.clean, expected)
        assert torch.equal(sample.noisy, expected)


@pytest.mark.parametrize("cfa", list(CFA))
def test_own_pictures_become_raw_at_the_sites_that_were_read(cfa: CFA) -> None:
    channels = bayer.mosaic(torch.arange(3)[:, None, None].expand(3, 24, 30), cfa)
    read = torch.nn.functional.one_hot(channels[0].long(), 3).movedim(2, 0)
    pair = Pair("sites", RawFrame(torch.zeros(1, 24, 30), cfa), (255 * read).to(torch.uint8))
    crops = OwnPictureCrops([pair], RawAugment(DictionaryISP()), crop=16)
    for seed in range(16):
        patch, place = crops.draw_patch(pair, torch.Generator().manual_seed(seed))
        assert patch.shape == (3, 16, 16) and place[2:4].tolist() == [24, 30]
        assert (bayer.mosaic(patch, CFA.RGGB) == 255).all()
    assert crops.draw(torch.Generator().manual_seed(0)).clean.shape == (4, 8, 8)


@pytest.mark.parametrize("source", ["captured", "drawn", "made of pictures"])
def test_the_noise_map_of_a_sample_is_that_of_its_noisy_frame(source: str) -> None:
    """No network is told of the clean frame, not even through its noise map, wherever a sample comes from."""
    pair = demo_pairs("train", count=1)[0]
    assert pair.noisy is not None
    pair = replace(pair, noisy=replace(pair.noisy, noise_profile=(1e-2, 1e-4)))
    if source == "drawn":
        pair = replace(pair, noisy=None)
    real = RealCrops([pair], noise_model((1e-2, 1e-4)), crop=32, cfa=pair.cfa)
    pictures = RawPairs(demo_pictures(1), RawAugment(DictionaryISP(), noise=(1e-2, 1e-4)), crop=32)
    stream = TrainingStream(real, pictures, batch=1, augmented=float("pictures" in source), seed=0)
    sample = stream[0]
    assert not torch.allclose(sample.noisy, sample.clean, atol=1e-2)
    torch.testing.assert_close(sample.variance, noise_variance(sample.noisy, 1e-2, 1e-4))


@pytest.mark.parametrize("levels", [True, False])
def test_a_captures_noise_is_never_renewed(levels: bool) -> None:
    pair = demo_pairs("train", count=1)[0]
    assert pair.noisy is not None
    known = set(pair.noisy.mosaic.flatten().tolist())
    pair = pair if levels else replace(pair, noisy=replace(pair.noisy, noise_profile=None))
    crops = RealCrops([pair], noise_model("cycleisp_sidd"), crop=32, cfa=pair.cfa)
    for seed in range(4):
        assert set(crops.draw(torch.Generator().manual_seed(seed)).noisy.flatten().tolist()) <= known


def test_frames_smaller_than_the_crop_are_named() -> None:
    with pytest.raises(ValueError, match="colours:"):
        RealCrops([colour_pair(CFA.RGGB)], noise_model((0.0, 0.0)), crop=64, cfa=CFA.RGGB).draw(torch.Generator())


def test_samples_depend_on_seed_and_index_alone() -> None:
    pairs = demo_pairs("train", count=2)
    real = RealCrops(pairs, noise_model("cycleisp_sidd"), 32, pairs[0].cfa)
    augment = RawAugment(DictionaryISP())
    pictures = RawPairs(list(demo_photographs("train").values()), augment, crop=32)
    stream = TrainingStream(real, pictures, batch=4, augmented=0.5, seed=1)
    later = stream[9].noisy
    for index in (0, 5, 9):
        _ = stream[index]
    assert torch.equal(stream[9].noisy, later)
    assert not torch.equal(stream[8].noisy, later)
    assert stream.from_pictures == 2


@pytest.mark.parametrize("target", ["raw", "srgb"])
def test_a_step_made_at_once_is_that_of_the_plugin_one_by_one(target: Target) -> None:
    augment = RawAugment(DictionaryISP(), target=Srgb(jpeg=(50, 60)) if target == "srgb" else target)
    small = [picture[:, :96, :112] for picture in demo_pictures(3)]
    pictures = RawPairs(small, augment, crop=32, zoom=2.0)
    stream = TrainingStream(None, pictures, batch=4, augmented=1.0, seed=1)
    for index, sample in zip((7, 4, 6), stream.__getitems__([7, 4, 6]), strict=True):
        generator = keyed_generator(1, "stream", index)
        alone = pictures.draw(int(torch.randint(3, (), generator=generator)), generator)
        assert torch.equal(sample.noisy, alone.noisy) and torch.equal(sample.clean, alone.clean)
    real = RealCrops([colour_pair(CFA.RGGB)], noise_model("cycleisp_sidd"), 16, CFA.RGGB)
    mixed = TrainingStream(real, RawPairs(small, RawAugment(DictionaryISP()), crop=16), 4, 0.5, seed=1)
    for index, sample in enumerate(mixed.__getitems__(range(4))):
        assert torch.equal(sample.noisy, mixed[index].noisy)


def test_an_arm_needs_its_sources() -> None:
    with pytest.raises(ValueError, match=r"data\.pictures"):
        TrainingStream(None, None, 4, 1.0, 0)
    with pytest.raises(ValueError, match=r"data\.pairs"):
        TrainingStream(None, None, 4, 0.0, 0)


def test_processes_divide_a_step_and_a_resume_goes_on_in_it() -> None:
    whole = [i for step in StepSampler(3, 5, 4) for i in step]
    assert whole == list(range(12, 20))
    parts = [i for rank in (0, 1) for step in StepSampler(3, 5, 4, rank, 2) for i in step]
    assert sorted(parts) == whole
    with pytest.raises(ValueError, match="multiple"):
        StepSampler(0, 1, 3, 0, 2)


@pytest.mark.parametrize("target", ["raw", "srgb"])
def test_a_device_makes_the_pairs_that_the_workers_would_have_made(target: Target) -> None:
    pictures = list(demo_photographs("train").values())[:2]
    augment = RawAugment.from_pretrained("universal", noise="cycleisp_sidd", target=target)

    def open_stream() -> TrainingStream:
        return TrainingStream(None, RawPairs(pictures, augment, crop=32, zoom=6.0), batch=4, augmented=1.0, seed=3)

    expected = next(iter(DataLoader(open_stream(), batch_sampler=StepSampler(5, 6, 4))))

    stream = open_stream()
    make_pairs = stream.leave_pairs_to(torch.device("cpu"))
    crops, params = next(iter(DataLoader(stream, batch_sampler=StepSampler(5, 6, 4))))
    assert make_pairs is not None and crops.dtype == torch.uint8 and crops.shape == (4, 3, 32, 32)
    for part, image in zip(make_pairs(crops, params), expected, strict=True):
        assert torch.equal(part, image)


def test_samples_that_are_not_all_of_pictures_are_made_by_the_workers() -> None:
    pairs = demo_pairs("train", count=1)
    real = RealCrops(pairs, noise_model("cycleisp_sidd"), 32, pairs[0].cfa)
    pictures = RawPairs(list(demo_photographs("train").values())[:1], "universal", crop=32)
    assert TrainingStream(real, pictures, 4, 0.5, seed=0).leave_pairs_to(torch.device("cpu")) is None
    assert TrainingStream(real, None, 4, 0.0, seed=0).leave_pairs_to(torch.device("cpu")) is None
