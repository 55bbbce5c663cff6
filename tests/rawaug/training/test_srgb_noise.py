"""Noise drawn on sRGB has the variance, the colours and the compression that its parameters say, and replays."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import pytest
import torch
from torch import Tensor

from rawaug.data.pairs import Sample
from rawaug.training import srgb_noise
from rawaug.training.srgb_noise import (
    MODELS,
    BsrganNoise,
    ColouredNoise,
    SrgbNoise,
    WhiteNoise,
    noise_on_srgb,
)
from rawaug.training.srgb_samples import Conditioning, NoisyPictures, SrgbSamples

GREY = torch.full((6, 3, 128, 128), 0.5)


def noise_of(model: SrgbNoise, clean: Tensor = GREY, **given: Any) -> Tensor:
    """What a model adds, with parameters replaced by those given."""
    params = model.sample(len(clean), torch.Generator().manual_seed(0))
    return model.apply(clean, params | {k: torch.as_tensor(v) for k, v in given.items()}) - clean


def bsrgan(**given: Any) -> Tensor:
    """Noise of :class:`BsrganNoise` without normals or photons, if none are given."""
    plain: dict[str, Any] = {"photons": [0.0] * 6, "mixing": torch.zeros(6, 3, 3)}
    return noise_of(BsrganNoise(), **plain | given)


@pytest.fixture
def uncompressed(monkeypatch: pytest.MonkeyPatch) -> None:
    """No JPEG, which halves the resolution of colour noise."""
    monkeypatch.setattr(srgb_noise, "compress_jpeg", lambda srgb, quality: srgb)


def test_white_noise_has_the_drawn_deviation_between_its_limits() -> None:
    model = WhiteNoise((10.0, 40.0))
    sigma = model.sample(2000, torch.Generator().manual_seed(1))["sigma"] * 255
    assert 10.0 <= sigma.min() < 10.5 and 39.5 < sigma.max() <= 40.0
    assert sigma.mean().item() == pytest.approx(25.0, abs=0.6)
    drawn = model.sample(6, torch.Generator().manual_seed(0))["sigma"]
    noise = noise_of(model)
    torch.testing.assert_close(noise.std((1, 2, 3)), drawn, rtol=0.02, atol=0.0)
    neighbours = (noise[..., 1:] * noise[..., :-1]).mean((1, 2, 3)) / drawn.square()
    assert neighbours.abs().max() < 0.02, "white"
    assert not noise_of(WhiteNoise((0.0, 0.0))).any()


@pytest.mark.usefixtures("uncompressed")
def test_gaussian_noise_is_mixed_as_its_matrix_says() -> None:
    mixing = 0.04 * torch.tensor([[1.0, 0, 0], [1, 0, 0], [1, 0, 0]])
    grey = bsrgan(mixing=mixing.expand(6, 3, 3))
    assert grey.std(1).max() < 1e-6 and grey.mean(1).std().item() == pytest.approx(0.04, rel=0.03)
    drawn = BsrganNoise().sample(3000, torch.Generator().manual_seed(2))["mixing"]
    covariance = drawn @ drawn.mT
    same = (drawn[:, 0] == drawn[:, 1]).all(-1)
    independent = (covariance - torch.diag_embed(covariance.diagonal(dim1=1, dim2=2))).abs().amax((1, 2)) == 0
    assert same.float().mean().item() == pytest.approx(0.4, abs=0.03)
    assert independent.float().mean().item() == pytest.approx(0.4, abs=0.03)
    assert covariance.diagonal(dim1=1, dim2=2).max().sqrt() <= 25 / 255 + 1e-6
    correlated = covariance[~same & ~independent] * (255 / 25) ** 2
    assert torch.einsum("bii->b", correlated).mean().item() == pytest.approx(1.5, rel=0.1), "three scales in [0, 1]"
    found = bsrgan(mixing=drawn[~same & ~independent][:6])[0]
    torch.testing.assert_close(torch.cov(found.flatten(1)), covariance[~same & ~independent][0], rtol=0.1, atol=3e-5)


@pytest.mark.usefixtures("uncompressed")
@pytest.mark.parametrize("grey", [False, True])
def test_photons_have_the_variance_of_their_light(grey: bool) -> None:
    noise = bsrgan(photons=[400.0] * 6, grey=[grey] * 6)
    assert noise.var().item() == pytest.approx(0.5 / 400, rel=0.06)
    assert abs(noise.mean().item()) < 1e-3
    assert (noise.std(1).max().item() < 1e-6) == grey
    photons = BsrganNoise(poisson=0.3).sample(3000, torch.Generator().manual_seed(3))["photons"]
    assert (photons > 0).float().mean().item() == pytest.approx(0.3, abs=0.03)
    assert 100.0 <= photons[photons > 0].min() < 110.0 and 9000.0 < photons.max() <= 10000.0


def test_jpeg_of_lower_quality_is_further_away() -> None:
    picture = torch.rand(6, 1, 64, 64, generator=torch.Generator().manual_seed(0)).expand(6, 3, 64, 64)
    still = {"photons": torch.zeros(6), "mixing": torch.zeros(6, 3, 3)}
    near, far = (noise_of(BsrganNoise(jpeg=(q, q)), picture, **still).square().mean() for q in (95, 30))
    assert 0 < near < far / 2


@pytest.mark.parametrize("name", list(MODELS))
def test_a_sample_replays_and_keeps_the_picture(name: str) -> None:
    model = noise_on_srgb(name)
    params = model.sample(6, torch.Generator().manual_seed(4))
    noisy = model.apply(GREY, params)
    assert torch.equal(noisy, model.apply(GREY, params)) and 0 <= noisy.min() < noisy.max() <= 1
    alone = model.apply(GREY[2:3], {key: value[2:3] for key, value in params.items()})
    torch.testing.assert_close(alone, noisy[2:3], rtol=0, atol=1e-6)
    pictures = [torch.full((3, 50, 61), 99, dtype=torch.uint8)]
    first, again = (NoisyPictures(pictures, model, 32).draw(torch.Generator().manual_seed(5)) for _ in range(2))
    assert torch.equal(first.noisy, again.noisy) and first.noisy.shape == (3, 32, 32)
    assert (first.clean == 99 / 255).all() and not first.variance.any()


def test_limits_that_nobody_means_are_refused() -> None:
    wrong: list[tuple[type, dict[str, Any], str]] = [
        (WhiteNoise, {"sigma": (20.0, 10.0)}, r"sigma must be \(lowest, highest\) within 0 to 255"),
        (BsrganNoise, {"jpeg": (0, 95)}, "jpeg must be"),
        (BsrganNoise, {"poisson": 1.5}, "poisson must be"),
        (ColouredNoise, {"wide": 1.5}, "wide must be"),
        (ColouredNoise, {"wide_blur": (0.0, 3.0)}, "wide_blur must be"),
    ]
    for model, settings, said in wrong:
        with pytest.raises(ValueError, match=said):
            model(**settings)


def test_coloured_noise_has_the_drawn_deviation_and_is_blurred_and_grey_as_drawn() -> None:
    model = ColouredNoise(sigma=20.0, coloured=0.5)
    drawn = model.sample(3000, torch.Generator().manual_seed(0))
    assert drawn["sigma"].max() * 255 <= 20.0
    assert (drawn["sigma"] * 255).mean().item() == pytest.approx(20.0 / 2.5, rel=0.05), "a share to the power 1.5"
    assert (drawn["blur"] > 0).float().mean().item() == pytest.approx(0.5, abs=0.03)
    assert (drawn["quality"] > 0).float().mean().item() == pytest.approx(0.5, abs=0.03)
    given = {"sigma": torch.full((6,), 0.04), "quality": torch.zeros(6, dtype=torch.long), "grey": torch.zeros(6)}
    white, soft = (noise_of(model, **given, blur=torch.full((6,), by)) for by in (0.0, 1.2))
    for noise in (white, soft):
        assert noise.std((1, 2, 3)).sub(0.04).abs().max() < 1e-3
    neighbours = [(x[..., 1:] * x[..., :-1]).mean().item() / 0.04**2 for x in (white, soft)]
    assert abs(neighbours[0]) < 0.02 and neighbours[1] == pytest.approx(math.exp(-0.25 / 1.2**2), abs=0.05)
    grey = noise_of(model, **given | {"grey": torch.ones(6)}, blur=torch.zeros(6))
    assert grey.std(1).max() < 1e-6


def test_a_share_of_coloured_noise_is_wide_and_the_deviation_stays() -> None:
    model = ColouredNoise(sigma=20.0, coloured=0.5, wide=0.8, wide_blur=(2.0, 5.0))
    drawn = model.sample(2000, torch.Generator().manual_seed(0))
    of_coloured = drawn["wide_share"][drawn["blur"] > 0]
    assert 0.75 < of_coloured.max() <= 0.8 and of_coloured.mean().item() == pytest.approx(0.4, rel=0.05)
    assert drawn["wide_share"][drawn["blur"] == 0].max() == 0
    assert drawn["wide_blur"].min() >= 2.0 and drawn["wide_blur"].max() <= 5.0

    fine = {"sigma": torch.full((6,), 0.04), "quality": torch.zeros(6, dtype=torch.long), "grey": torch.zeros(6)}
    fine["blur"] = torch.zeros(6)
    noise = noise_of(model, **fine, wide_share=torch.full((6,), 0.5), wide_blur=torch.full((6,), 3.0))
    assert noise.std((1, 2, 3)).sub(0.04).abs().max() < 2e-3
    far = (noise[..., 3:] * noise[..., :-3]).mean().item() / 0.04**2
    assert far == pytest.approx(0.5 * math.exp(-0.25 * 3**2 / 3.0**2), abs=0.06)


def test_a_network_is_told_nothing_the_deviation_or_a_wrong_one() -> None:
    told, generator = Conditioning(unknown=0.3, exact=0.5, factor=2.0), torch.Generator().manual_seed(0)
    times = torch.tensor([told.sample(generator) for _ in range(4000)])
    assert (times == 0).float().mean().item() == pytest.approx(0.3, abs=0.03)
    assert (times == 1).float().mean().item() == pytest.approx(0.5, abs=0.03)
    wrong = times[(times != 0) & (times != 1)]
    assert 0.5 <= wrong.min() < 0.51 and 1.98 < wrong.max() <= 2.0 and abs(wrong.log().mean()) < 0.05
    sample = Sample(torch.full((3, 4, 4), 0.6), torch.full((3, 4, 4), 0.5), torch.zeros(3, 4, 4))
    assert torch.allclose(told.apply(sample, 2.0).variance, torch.full((3, 4, 4), 0.04))


def test_a_share_of_the_samples_has_noise_drawn_on_srgb_and_each_depends_on_its_generator_alone() -> None:
    class Camera:
        def draw_batch(self, generators: Sequence[torch.Generator]) -> list[Sample]:
            return [Sample(*torch.rand(3, 3, 8, 8, generator=one)) for one in generators]

    grey = NoisyPictures([torch.full((3, 40, 40), 99, dtype=torch.uint8)], WhiteNoise(), 8)
    mixed = SrgbSamples(Camera(), grey, 0.25, Conditioning())  # type: ignore[arg-type]
    samples = mixed.draw_batch([torch.Generator().manual_seed(k) for k in range(400)])
    share = sum(bool((one.clean == 99 / 255).all()) for one in samples) / 400
    assert share == pytest.approx(0.25, abs=0.06)
    for k in (0, 7, 8, 9):
        again = mixed.draw(torch.Generator().manual_seed(k))
        assert all(map(torch.equal, again, samples[k]))


def test_each_compressed_picture_keeps_its_own_chroma() -> None:
    """Of red and green columns 4:2:0 makes one colour; a picture before them that is no JPEG shifts nobody's."""
    stripes = torch.zeros(3, 3, 32, 32)
    stripes[:, 0, :, ::2], stripes[:, 1, :, 1::2] = 0.8, 0.4
    kept = {"sigma": [0.0] * 3, "quality": [0, 98, 98], "chroma_420": [True, False, True]}
    coded = stripes + noise_of(ColouredNoise(), stripes, **kept)
    chroma = (coded[:, 0] - coded[:, 1]).diff(dim=-1).abs().mean((1, 2))
    assert chroma[0] > 1.0 and chroma[1] > 1.0 and chroma[2] < 0.5
