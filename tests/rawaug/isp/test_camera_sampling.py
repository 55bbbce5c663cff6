"""Camera-consistent settings: replay, physics of white and grey, and how the hull is filled."""

from __future__ import annotations

import pytest
import torch

from rawaug.isp.camera_sampling import PLAUSIBLE_GAINS, CameraSampler
from rawaug.isp.cameras import colour_matrix, published_cameras, white_balance
from rawaug.isp.dictionary import CameraDictionary, sparse_weights
from rawaug.isp.light import D65, LightRange, sample_lights, white_point
from rawaug.isp.model import DictionaryISP
from rawaug.isp.tone import STEPS
from rawaug.isp.universal import of_cameras


@pytest.fixture(scope="module")
def universal() -> DictionaryISP:
    return DictionaryISP.from_pretrained("universal")


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def test_the_same_seed_draws_the_same_bits(universal: DictionaryISP) -> None:
    first, again, other = (universal.draw_setting(4, generator(seed)) for seed in (1, 1, 2))
    assert all(torch.equal(a, b) for a, b in zip(first, again, strict=True))
    assert not torch.equal(first.gains, other.gains)


def test_white_fills_the_sensor_and_grey_is_divided_by_the_gains(universal: DictionaryISP) -> None:
    setting = universal.draw_setting(8, generator())
    white = universal.reverse_pixels(torch.ones(8, 3, 2, 2), setting)
    torch.testing.assert_close(white, torch.ones_like(white), atol=1e-5, rtol=0)
    grey = universal.reverse_pixels(torch.full((8, 3, 2, 2), 100 / 255), setting)[:, :, 0, 0]
    assert universal.tone is not None
    curve = universal.tone.combine(setting.tone_weights)
    torch.testing.assert_close(grey * setting.gains, curve[:, 100 * STEPS, None].expand(8, 3), atol=1e-5, rtol=0)


def test_settings_are_of_cameras_that_can_be(universal: DictionaryISP) -> None:
    setting = universal.draw_setting(2000, generator())
    balance = setting.gains / setting.gains[:, 1:2]
    torch.testing.assert_close(setting.gains.amin(dim=1), torch.ones(2000))
    assert balance.min() >= PLAUSIBLE_GAINS[0] - 1e-5 and balance.max() <= PLAUSIBLE_GAINS[1] + 1e-4
    torch.testing.assert_close(setting.matrix.sum(dim=2), torch.ones(2000, 3))
    torch.testing.assert_close(setting.tone_weights.sum(dim=1), torch.ones(2000))


def test_gains_follow_the_light(universal: DictionaryISP) -> None:
    """Light that needs more blue needs less red: gains drawn on their own would not correlate."""
    gains = universal.draw_setting(2000, generator()).gains
    red, blue = (gains[:, c].div(gains[:, 1]).log() for c in (0, 2))
    assert torch.corrcoef(torch.stack([red, blue]))[0, 1] < -0.5


def test_the_balance_in_a_light_is_that_of_the_matrix_from_xyz(universal: DictionaryISP) -> None:
    sampler = universal.camera_sampler()
    assert sampler is not None and isinstance(universal.colour, CameraDictionary)
    weights, light = universal.colour.known[::100], sample_lights(7, generator())
    expected = white_balance(universal.colour.xyz_to_camera(weights), torch.from_numpy(light))
    torch.testing.assert_close(torch.from_numpy(sampler.balance(weights.double().numpy(), light)), expected)


def test_independent_gains_are_those_of_other_light(universal: DictionaryISP) -> None:
    """The same cameras as in a consistent draw, and the same spread of gains, in no relation to each other."""
    assert isinstance(universal.colour, CameraDictionary)
    camera = of_cameras(universal, ["Nikon D750", "Leica S3"]).colour
    assert isinstance(camera, CameraDictionary)

    def error(consistent: bool) -> torch.Tensor:
        sampler = CameraSampler(camera, 0, 1, 1, LightRange((6504.0, 6504.0), lamps=0.0), consistent=consistent)
        setting = sampler.sample(64, generator())
        balance = white_balance(camera.xyz_to_camera(setting.colour_weights), white_point(D65))
        own = balance / balance.amin(dim=1, keepdim=True)
        return (setting.gains / own).log().abs().amax(dim=1)

    assert error(consistent=True).max() < 0.1, "a little off the locus, but the camera's"
    assert 0.2 < (error(consistent=False) > 0.1).float().mean() < 0.8, "half of the draws have the other camera's gains"


def test_draws_are_where_the_published_cameras_are(universal: DictionaryISP) -> None:
    drawn = universal.draw_setting(4000, generator()).matrix
    published = colour_matrix(published_cameras().distinct()).float()
    torch.testing.assert_close(drawn.mean(dim=0), published.mean(dim=0), atol=0.02, rtol=0)
    spread = drawn.std(dim=0).mean() / published.std(dim=0).mean()
    assert 0.65 < spread < 0.95  # mixtures of two: 0.87 of the cameras' own, and the hull leaves some out


def test_one_named_camera_has_its_own_matrix_and_balance(universal: DictionaryISP) -> None:
    own = published_cameras().named(["Nikon D750"])
    nikon = of_cameras(universal, "nikon d750")
    setting = nikon.draw_setting(5, generator())
    torch.testing.assert_close(setting.matrix, colour_matrix(own).float().expand(5, 3, 3))
    assert setting.gains.std(dim=0).max() > 0.1
    assert isinstance(nikon.colour, CameraDictionary)
    back = nikon.colour.xyz_to_camera(torch.ones(1, 1))
    d65 = white_point(D65)
    torch.testing.assert_close(white_balance(back, d65), white_balance(own, d65), atol=1e-3, rtol=0)
    torch.testing.assert_close(back, own, atol=1e-4, rtol=0)
    with pytest.raises(ValueError, match="not listed"):
        of_cameras(universal, "Box Brownie")
    with pytest.raises(ValueError, match="by name needs an ISP of published cameras"):
        of_cameras(DictionaryISP(), "Nikon D750")


def test_weights_are_sparse_and_reach_the_corners() -> None:
    weights = sparse_weights(4000, 20, 3, generator())
    torch.testing.assert_close(weights.sum(dim=1), torch.ones(4000, dtype=torch.float64))
    assert (weights > 0).sum(dim=1).max() <= 3 and (weights >= 0).all()
    assert (weights.amax(dim=1) > 0.95).double().mean() > 0.08  # flat weights of 20 atoms: never
    torch.testing.assert_close(weights.mean(dim=0), torch.full((20,), 0.05).double(), atol=0.015, rtol=0)


def test_what_cannot_be_drawn_is_refused() -> None:
    green_only = CameraDictionary(1, 1)
    green_only.set_cameras(torch.tensor([[[0.01, 0, 0], [0, 1.0, 0], [0, 0, 0.01]]]), torch.ones(1, 1))
    with pytest.raises(ValueError, match="gains within"):
        CameraSampler(green_only, 0).sample(1, generator())
    with pytest.raises(ValueError, match="at least one camera"):
        CameraSampler(green_only, 0, cameras_mixed=0)
