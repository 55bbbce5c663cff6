"""Dictionaries: what their atoms are normalised to, and sampling that stays in the hull."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from rawaug.camera import samplers
from rawaug.camera.lights import D65, LightRange, sample_lights, white_point
from rawaug.camera.matrices import camera_from_srgb, gains_in_light, load_cameras
from rawaug.camera.samplers import CameraSampler
from rawaug.data import demo_pictures
from rawaug.isp.dictionary import (
    CameraDictionary,
    ColourDictionary,
    GainDictionary,
    convex_weights,
    nearest_in_hull,
    perturb,
    project_to_simplex,
)
from rawaug.isp.fast import BakedISP
from rawaug.isp.model import DictionaryISP
from rawaug.isp.sampling import camera_sampler, draw_setting
from rawaug.isp.tone import STEPS
from rawaug.plugin.augment import RawAugment
from rawaug.plugin.dataset import RawPairs


def test_combining_parameters_equals_combining_images() -> None:
    generator = torch.Generator().manual_seed(0)
    colour, gain = ColourDictionary(4), GainDictionary(4)
    with torch.no_grad():
        colour.matrices.copy_(torch.rand(4, 3, 3, generator=generator))
    weights = convex_weights(1, 4, generator)
    x = torch.rand(3, 10, generator=generator)
    images = torch.stack([atom @ x for atom in colour.atoms()])
    torch.testing.assert_close(colour.combine(weights)[0] @ x, torch.einsum("n,nip->ip", weights[0], images))
    images = torch.stack([x / g[:, None] for g in gain.channel_gains()])
    expected = torch.einsum("n,nip->ip", weights[0], images)
    torch.testing.assert_close(x / gain.combine(weights)[0][:, None], expected)


def test_a_known_light_chooses_the_atoms_that_were_seen_in_it() -> None:
    colour, balance = ColourDictionary(3), torch.tensor([[2.0, 1.0, 1.5], [3.0, 2.0, 4.0]])
    even = torch.full((2, 3), 1 / 3)
    torch.testing.assert_close(colour.weights_for(balance, even), even)  # uninformative light
    colour.light.copy_(torch.tensor([[2.0, 1.5], [1.5, 2.0], [1.0, 1.0]]).log())
    colour.spread.fill_(0.05)
    torch.testing.assert_close(colour.weights_for(balance, even), torch.eye(3)[:2], atol=1e-4, rtol=0)


@given(st.lists(st.floats(-2, 2), min_size=1, max_size=9))
def test_projection_is_on_the_simplex_and_leaves_its_points(values: list[float]) -> None:
    projected = project_to_simplex(torch.tensor([values], dtype=torch.float64))
    assert (projected >= 0).all()
    torch.testing.assert_close(projected.sum(), torch.tensor(1.0, dtype=torch.float64))
    torch.testing.assert_close(project_to_simplex(projected), projected)


def test_perturbed_weights_are_the_nearest_on_the_simplex() -> None:
    """Not those clipped at 0 and divided by their sum: that draws mixtures towards their middle."""
    weights, strength = torch.tensor([[0.9, 0.1, 0.0, 0.0]]).expand(200, 4), 0.3
    noise = torch.randn(200, 4, generator=torch.Generator().manual_seed(1))
    drawn = perturb(weights, strength, torch.Generator().manual_seed(1))
    torch.testing.assert_close(drawn, project_to_simplex(weights + strength * noise))
    torch.testing.assert_close(drawn.sum(1), torch.ones(200))
    outside = weights + strength * noise
    for _ in range(20):  # no other point of the simplex is nearer
        other = convex_weights(200, 4, torch.Generator().manual_seed(_))
        assert ((drawn - outside).square().sum(1) <= (other - outside).square().sum(1) + 1e-5).all()


def test_convex_weights_are_uniform_on_the_simplex() -> None:
    weights = convex_weights(20_000, 3, torch.Generator().manual_seed(0))
    torch.testing.assert_close(weights.sum(1), torch.ones(20_000))
    # a flat Dirichlet of three has mean 1/3 and variance 1/18
    torch.testing.assert_close(weights.mean(0), torch.full((3,), 1 / 3), atol=0.006, rtol=0)
    torch.testing.assert_close(weights.var(0), torch.full((3,), 1 / 18), atol=0.002, rtol=0)


def test_a_mixture_is_found_and_a_point_outside_is_projected() -> None:
    atoms = torch.tensor([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]], dtype=torch.float64)
    points = torch.tensor([[0.2, 0.3], [1.0, 1.0], [-1.0, 0.5]], dtype=torch.float64)
    weights, error = nearest_in_hull(points, atoms)
    torch.testing.assert_close(weights.sum(dim=1), torch.ones(3, dtype=torch.float64))
    nearest = torch.tensor([[0.2, 0.3], [0.5, 0.5], [0.0, 0.5]], dtype=torch.float64)
    torch.testing.assert_close(weights @ atoms, nearest, atol=1e-6, rtol=0)
    torch.testing.assert_close(error, torch.tensor([0.0, 0.5, 1.0], dtype=torch.float64), atol=1e-6, rtol=0)


def sampler_of(cameras: CameraDictionary, lights: LightRange, consistent: bool = True) -> CameraSampler:
    return CameraSampler(cameras.known, cameras.atoms(), cameras.responses(), lights, consistent)


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def test_white_and_grey_are_divided_by_the_gains(universal: DictionaryISP) -> None:
    setting = draw_setting(universal, 8, generator())
    assert universal.tone is not None
    curve = universal.tone.combine(setting.tone_weights)
    for code in (100, 255):
        picture = torch.full((8, 3, 2, 2), code / 255)
        made = universal.stages.reverse(picture, setting)[:, :, 0, 0]
        torch.testing.assert_close(made * setting.gains, curve[:, code * STEPS, None].expand(8, 3), atol=1e-5, rtol=0)
        baked = BakedISP(universal)(picture, setting)[:, [0, 1, 3], 0, 0]  # R, Gr and B of the packed RAW
        torch.testing.assert_close(baked, made, atol=1e-5, rtol=0)


def test_each_channel_clips_at_its_own_white() -> None:
    """As in a sensor: where green is clipped red mostly has room, and neither is the picture's white always clipped."""
    augment = RawAugment.from_pretrained("universal")
    white = augment(torch.full((2000, 3, 2, 2), 255, dtype=torch.uint8), generator()).clean[:, :, 0, 0]
    red, green, blue = (white[:, c] for c in (0, 1, 3))
    assert white.max() == 1.0 and 0.5 < (green >= 0.99).float().mean() < 0.8
    clipped = green >= 0.99
    assert 0.45 < (red[clipped] < 0.9).float().mean() < 0.7 and 0.4 < (blue[clipped] < 0.9).float().mean() < 0.65
    assert (white >= 0.99).all(dim=1).float().mean() < 0.2


def test_raw_is_as_bright_as_cameras() -> None:
    """Of real frames the mean RAW is about 0.136; the built-in photographs are darker than most."""
    pairs = RawPairs(demo_pictures(), "universal", crop=128)
    means = [pairs.draw(k % len(pairs), generator(k)).clean.mean().item() for k in range(256)]
    assert 0.08 < sum(means) / len(means) < 0.16


def test_gains_follow_the_light(universal: DictionaryISP) -> None:
    """Light that needs more blue needs less red: gains drawn on their own would not correlate."""
    gains = draw_setting(universal, 2000, generator()).gains
    red, blue = (gains[:, c].div(gains[:, 1]).log() for c in (0, 2))
    assert torch.corrcoef(torch.stack([red, blue]))[0, 1] < -0.5


def test_the_balance_in_a_light_is_that_of_the_matrix_from_xyz(universal: DictionaryISP) -> None:
    sampler = camera_sampler(universal)
    assert sampler is not None and isinstance(universal.colour, CameraDictionary)
    weights, light = universal.colour.known[::100], sample_lights(7, generator())
    expected = gains_in_light(universal.colour.xyz_to_camera(weights), torch.from_numpy(light))
    torch.testing.assert_close(torch.from_numpy(sampler.balance(weights.double().numpy(), light)), expected)


def test_independent_gains_are_those_of_other_light(universal: DictionaryISP, monkeypatch: pytest.MonkeyPatch) -> None:
    """The same cameras as in a consistent draw, and the same spread of gains, in no relation to each other."""
    assert isinstance(universal.colour, CameraDictionary)
    camera = universal.with_cameras(["Nikon D750", "Leica S3"]).colour
    assert isinstance(camera, CameraDictionary)
    monkeypatch.setattr(samplers, "CAMERAS_MIXED", 1)

    def error(consistent: bool) -> torch.Tensor:
        weights, _, gains = sampler_of(camera, LightRange((6504.0, 6504.0), lamps=0.0), consistent).sample(
            64, generator()
        )
        balance = gains_in_light(camera.xyz_to_camera(weights), white_point(D65))
        own = balance / balance.amin(dim=1, keepdim=True)
        return (gains / own).log().abs().amax(dim=1)

    assert error(consistent=True).max() < 0.1, "a little off the locus, but the camera's"
    assert 0.2 < (error(consistent=False) > 0.1).float().mean() < 0.8, "half of the draws have the other camera's gains"


def test_one_named_camera_has_its_own_matrix_and_balance(universal: DictionaryISP) -> None:
    own = load_cameras().select(["Nikon D750"])
    nikon = universal.with_cameras("nikon d750")
    setting = draw_setting(nikon, 5, generator())
    torch.testing.assert_close(setting.matrix, camera_from_srgb(own).float().expand(5, 3, 3))
    assert setting.gains.std(dim=0).max() > 0.1
    assert isinstance(nikon.colour, CameraDictionary)
    back = nikon.colour.xyz_to_camera(torch.ones(1, 1))
    d65 = white_point(D65)
    torch.testing.assert_close(gains_in_light(back, d65), gains_in_light(own, d65), atol=1e-3, rtol=0)
    torch.testing.assert_close(back, own, atol=1e-4, rtol=0)
    with pytest.raises(ValueError, match="not listed"):
        universal.with_cameras("Box Brownie")
    with pytest.raises(ValueError, match="published cameras"):
        DictionaryISP().with_cameras("Nikon D750")


def test_what_cannot_be_drawn_is_refused() -> None:
    matrices = torch.tensor([[[0.01, 0, 0], [0, 1.0, 0], [0, 0, 0.01]]])
    green_only = CameraDictionary.from_xyz(matrices, torch.ones(1, 1))
    with pytest.raises(ValueError, match="gains within"):
        sampler_of(green_only, LightRange()).sample(1, generator())


def test_a_camera_that_is_drawn_again_brings_its_own_gains(monkeypatch: pytest.MonkeyPatch) -> None:
    """Gains that are implausible are drawn again, camera and light together, not the light alone."""
    cameras = DictionaryISP.from_pretrained("universal-small").colour
    assert isinstance(cameras, CameraDictionary)
    sampler = sampler_of(cameras, LightRange((2800.0, 7500.0), lamps=0.0))

    rounds: list[np.ndarray] = []

    def plausible_at_last(balance: np.ndarray) -> np.ndarray:
        rounds.append(balance.copy())
        return np.full(len(balance), len(rounds) > 2)

    mixtures: list[np.ndarray] = []
    balance = sampler.balance

    def recorded(weights: np.ndarray, light: np.ndarray) -> np.ndarray:
        mixtures.append(weights.copy())
        return balance(weights, light)

    monkeypatch.setattr(sampler, "is_plausible", plausible_at_last)
    monkeypatch.setattr(sampler, "balance", recorded)
    weights, _, drawn = sampler.sample(5, torch.Generator().manual_seed(0))
    assert len(mixtures) == 3 and not np.allclose(mixtures[0], mixtures[2])
    assert np.allclose(weights.numpy(), mixtures[2], atol=1e-6)
    gains = drawn.numpy()
    assert np.allclose(gains / gains[:, 1:2], rounds[2], rtol=1e-5)
