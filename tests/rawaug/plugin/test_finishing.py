"""Finishing: what it does to noise in flat areas, at edges and between channels, and that clean follows noisy."""

from __future__ import annotations

import math

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from rawaug.plugin import finishing
from rawaug.plugin.augment import RawAugment
from rawaug.plugin.finishing import Finish, box, gaussian_blur, smooth
from rawaug.plugin.jpeg import compress_jpeg
from rawaug.plugin.targets import Srgb

SIDE = 96


def setting(softness: float = 0.0, luma: float = 0.0, edge: float = 1e9, chroma: float = 0.0) -> Tensor:
    """``(1, 8)`` parameters without sharpening; nothing is an edge by default."""
    return torch.tensor([[softness, 4.0, luma, edge, 3.0, chroma, 0.0, 1.0]])


def step_and_noise(seed: int = 0, deviation: float = 0.02) -> tuple[Tensor, Tensor]:
    """A grey picture with an edge down its middle, noisy and clean ``(1, 3, SIDE, SIDE)``."""
    clean = torch.full((1, 3, SIDE, SIDE), 0.3)
    clean[..., SIDE // 2 :] = 0.7
    return clean + deviation * torch.randn(clean.shape, generator=torch.Generator().manual_seed(seed)), clean


@pytest.mark.parametrize("deviation", [1.0, 2.5])
def test_blur_divides_the_variance_of_white_noise_by_4_pi_s_squared(deviation: float) -> None:
    noise = torch.randn(8, 1, 128, 128, generator=torch.Generator().manual_seed(0))
    inner = gaussian_blur(noise, torch.full((8,), deviation))[..., 16:-16, 16:-16]
    assert inner.var().item() == pytest.approx(1.0 / (4.0 * math.pi * deviation**2), rel=0.06)
    flat = torch.full((1, 2, 20, 20), 0.4)
    assert torch.allclose(gaussian_blur(flat, torch.tensor([deviation])), flat)
    assert torch.equal(gaussian_blur(flat, torch.tensor([0.0])), flat)


def test_a_window_of_whole_pixels_is_a_mean_and_a_part_of_one_counts_in_part() -> None:
    image = torch.rand(2, 1, 12, 15, generator=torch.Generator().manual_seed(0))
    whole = F.avg_pool2d(F.pad(image, (2,) * 4, mode="replicate"), 5, 1)
    assert torch.allclose(smooth(image, box(torch.tensor([2.0, 2.0]))), whole, atol=1e-6)
    row = torch.zeros(1, 1, 1, 9)
    row[..., 4] = 1.0
    assert torch.allclose(smooth(row, box(torch.tensor([1.5])))[0, 0, 0, 2:7], torch.tensor([0.5, 1, 1, 1, 0.5]) / 4)


def test_each_picture_has_its_own_filter_in_pytorch_and_compiled(monkeypatch: pytest.MonkeyPatch) -> None:
    image = torch.rand(3, 2, 21, 40, generator=torch.Generator().manual_seed(0))
    deviations = torch.tensor([0.0, 0.7, 6.0])
    together = gaussian_blur(image, deviations)
    for k in range(3):
        assert torch.equal(gaussian_blur(image[k : k + 1], deviations[k : k + 1])[0], together[k])
    monkeypatch.setattr(finishing, "fastest", lambda *_, otherwise: otherwise())
    assert torch.allclose(gaussian_blur(image, deviations), together, atol=1e-6)


def test_noise_reduction_that_spares_edges_leaves_the_noise_there() -> None:
    def ratio(threshold: float) -> float:
        noisy, clean = (x[0] for x in Finish().apply(*step_and_noise(), setting(0.0, 1.0, threshold)))
        luma = (noisy - clean).mean(0)
        middle = SIDE // 2
        return (luma[:, middle - 1 : middle + 1].var() / luma[:, 8 : middle - 8].var()).item()

    assert ratio(1e9) == pytest.approx(1.0, abs=0.35)
    assert ratio(2.0) > 2.5


def test_the_clean_picture_is_the_mean_of_many_finished_shots() -> None:
    finished, cleans = [], []
    for seed in range(60):
        noisy, clean = Finish().apply(*step_and_noise(seed), setting(0.6, 0.6, 2.0, 0.9))
        finished.append(noisy)
        cleans.append(clean)
    departure = torch.stack(finished).mean(0) - torch.stack(cleans).mean(0)
    assert departure.abs().mean().item() < 1.5 * 0.02 / math.sqrt(60)
    original = step_and_noise()[1]
    assert (cleans[0] - original)[..., SIDE // 2 - 1 : SIDE // 2 + 1].abs().max().item() < 0.1, "the edge has stayed"


def test_chroma_noise_reduction_ties_the_channels_together() -> None:
    def correlation(mix: float) -> float:
        noisy, clean = Finish().apply(*step_and_noise(), setting(chroma=mix))
        return torch.corrcoef((noisy - clean)[0].flatten(1))[0, 1].item()

    assert abs(correlation(0.0)) < 0.05
    assert correlation(1.0) > 0.8


def test_sharpening_raises_the_noise_and_keeps_flat_areas() -> None:
    noisy, clean = step_and_noise()
    sharp = torch.tensor([[0.0, 4.0, 0.0, 1e9, 0.0, 0.0, 0.5, 1.0]])
    after, flat = Finish().apply(noisy, clean, sharp)
    assert (after - flat)[..., 8:40].var() > 1.5 * (noisy - clean)[..., 8:40].mean(1).var()
    assert torch.allclose(flat[..., 8:32], clean[..., 8:32], atol=1e-6)


def test_pairs_replay_and_do_not_depend_on_their_neighbours() -> None:
    augment = RawAugment.from_pretrained("universal", noise=(1e-2, 1e-4), target=Srgb(finish=True))
    pictures = torch.rand(3, 3, 32, 32, generator=torch.Generator().manual_seed(1))
    pair = augment(pictures, torch.Generator().manual_seed(2))
    again = augment.apply(pictures, pair.params)
    assert torch.equal(pair.noisy, again.noisy) and torch.equal(pair.clean, again.clean)
    alone = augment.apply(pictures[1], pair.params.map(lambda t: t[1]))
    assert torch.equal(alone.noisy, pair.noisy[1])
    assert pair.params.extras["finish"].shape == (3, 8)


@pytest.mark.parametrize("finish", [False, Finish(quality=None)])
def test_the_target_of_shots_is_the_mean_of_many_though_noise_is_clipped_at_black(finish: Finish | bool) -> None:
    dark = torch.full((1, 3, 48, 48), 0.04)
    dark[..., 24:] = 0.5

    def mean_pair(shots: int) -> tuple[Tensor, Tensor]:
        target = Srgb(demosaicing="bilinear", finish=finish, shots=shots)
        augment = RawAugment.from_pretrained("universal", noise=(1e-4, 1e-4), target=target)
        params = augment.sample(dark, torch.Generator().manual_seed(0))
        noisy, clean = [], []
        for seed in range(24):
            params.noise["seed"] = torch.tensor([seed])
            if shots:
                params.extras["shot_seed"] = torch.tensor([[1000 + seed, 2000 + seed]])
            pair = augment.apply(dark, params)
            noisy.append(pair.noisy[..., 4:20].mean())
            clean.append(pair.clean[..., 4:20].mean())
        return torch.stack(noisy).mean(), torch.stack(clean).mean()

    noisy, developed = mean_pair(0)
    assert noisy - developed > 0.008, "noise that is clipped at black makes dark areas brighter"
    noisy, mean = mean_pair(2)
    assert abs(noisy - mean) < 0.0015


def test_shots_leave_the_noisy_picture_and_unfinished_targets_as_they_are() -> None:
    pictures = torch.rand(6, 3, 32, 32, generator=torch.Generator().manual_seed(1))

    def pair(shots: int) -> tuple[Tensor, Tensor, Tensor]:
        target = Srgb(finish=Finish(unfinished=0.5, quality=None), shots=shots)
        augment = RawAugment.from_pretrained("universal", noise=(1e-2, 1e-3), target=target)
        params = augment.sample(pictures, torch.Generator().manual_seed(4))
        first, again = augment.apply(pictures, params), augment.apply(pictures, params)
        assert torch.equal(first.clean, again.clean)
        return first.noisy, first.clean, params.extras["finish"].any(dim=1)

    noisy, clean, finished = pair(0)
    same, mean, _ = pair(1)
    assert torch.equal(noisy[~finished], same[~finished]) and torch.equal(clean[~finished], mean[~finished])
    assert 0 < finished.sum() < 6
    for k in finished.nonzero()[:, 0]:
        assert not torch.equal(clean[k], mean[k])


def test_jpeg_is_on_the_noisy_picture_alone() -> None:
    pictures = torch.rand(2, 3, 32, 32, generator=torch.Generator().manual_seed(1))

    def pair(quality: tuple[int, int]) -> tuple[Tensor, Tensor]:
        finish = Finish(quality=quality)
        augment = RawAugment.from_pretrained("universal", noise=(1e-3, 1e-5), target=Srgb(finish=finish))
        made = augment(pictures, torch.Generator().manual_seed(3))
        return made.noisy, made.clean

    (rough, clean), (fine, same) = pair((20, 20)), pair((95, 95))
    assert torch.equal(clean, same)
    assert not torch.equal(rough, fine)


def test_ranges_and_shares_are_of_pictures() -> None:
    drawn = Finish(unfinished=0.25, edge=(2.0, 8.0)).sample(4000, torch.Generator().manual_seed(0))["finish"]
    plain = (drawn == 0.0).all(1)
    assert plain.float().mean().item() == pytest.approx(0.25, abs=0.03)
    edge = drawn[~plain, 3]
    assert 2.0 <= edge.min() < 2.02 and 7.95 < edge.max() <= 8.0
    assert edge.log().mean().item() == pytest.approx(math.log(4.0), abs=0.03), "drawn by its logarithm"
    noisy, clean = step_and_noise()
    assert torch.equal(Finish().apply(noisy, clean, torch.zeros(1, 8))[0], noisy)


def test_a_negative_number_of_shots_is_refused() -> None:
    with pytest.raises(ValueError, match="shots"):
        Srgb(shots=-1)


def test_ranges_out_of_order_are_refused() -> None:
    with pytest.raises(ValueError, match=r"finish: .*highest"):
        Finish(radius=(1.0, 0.5))
    with pytest.raises(ValueError, match=r"finish: .*unfinished"):
        Finish(unfinished=1.5)


def test_chroma_is_halved_in_those_pictures_that_say_so() -> None:
    """4:2:0 shares its chroma among four pixels; 4:4:4 keeps red and green columns of one pixel apart."""
    stripes = torch.zeros(3, 32, 32)
    stripes[0, :, ::2], stripes[1, :, 1::2] = 0.8, 0.4
    quality, halved = torch.tensor([98, 98, 98]), torch.tensor([True, False, True])
    coded = compress_jpeg(stripes.expand(3, -1, -1, -1), quality, halved)
    chroma = (coded[:, 0] - coded[:, 1]).diff(dim=-1).abs().mean(dim=(1, 2))
    assert chroma[1] > 1.0 and chroma[0] < 0.5 and chroma[2] < 0.5
