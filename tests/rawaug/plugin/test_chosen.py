"""What encoders choose is chosen on the whole picture: a crop of it has the same camera setting."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from rawaug.isp.config import ISPParams
from rawaug.plugin.augment import RawAugment
from rawaug.plugin.dataset import RawPairs
from rawaug.plugin.draw import Draw
from rawaug.plugin.params import AugmentParams
from rawaug.plugin.stream import RawPairStream
from rawaug.plugin.wrapped import wrap


def half_dark() -> Tensor:
    """A picture that is dark on the left, bright on the right."""
    light = torch.linspace(5.0, 250.0, 200).expand(3, 120, 200)
    noise = torch.randint(6, (3, 120, 200), generator=torch.Generator().manual_seed(0))
    return (light + noise).to(torch.uint8)


@pytest.fixture(scope="module")
def augment() -> RawAugment:
    return RawAugment.from_pretrained("phones", draw=Draw("chosen"))


def assert_setting(params: AugmentParams, expected: ISPParams) -> None:
    for ours, theirs in zip(params.isp, expected, strict=True):
        torch.testing.assert_close(ours.reshape(theirs.shape), theirs, atol=0, rtol=0)


def test_crops_have_the_setting_of_the_whole_picture(augment: RawAugment) -> None:
    picture = half_dark()
    whole = augment.isp.choose(picture[None])
    assert (augment.sample(picture[:, :64, :64]).isp.gains / whole.gains).max() > 1.1, "crops look different"

    pairs = RawPairs([picture], augment, crop=64)
    for seed in range(3):
        generator = torch.Generator().manual_seed(seed)
        assert_setting(pairs.draw(0, generator).params, whole)
    batch = pairs.draw_batch([0, 0], [torch.Generator().manual_seed(seed) for seed in range(2)])
    assert_setting(batch.params.map(lambda tensor: tensor[:1]), whole)

    pair = pairs[0]
    assert torch.equal(pairs.replay(0, pair.params).noisy, pair.noisy)
    assert_setting(next(iter(RawPairStream([picture], augment, crop=64))).params, whole)
    (cropped,) = wrap([picture[None]], augment, crop=64)
    assert_setting(cropped.params, whole)


def test_where_the_picture_is_unknown_the_constants_serve(augment: RawAugment) -> None:
    constants = augment.isp.typical_setting()
    (pair,) = wrap([half_dark()[None, :, :64, :64]], augment)
    assert_setting(pair.params, constants)
    crop = torch.tensor([[0, 0, 120, 200, 0]])
    assert_setting(augment.sample(half_dark()[None, :, :64, :64], crop=crop), constants)


def test_draws_that_do_not_look_choose_nothing() -> None:
    assert RawAugment.from_pretrained("phones").look(half_dark()) is None
    assert RawAugment.from_pretrained("universal", draw=Draw("chosen")).look(half_dark()) is None


def test_a_perturbed_choice_stays_near_it() -> None:
    """The default strength moves gains by about a tenth of a stop, less than the choice differs between pictures."""
    augment = RawAugment.from_pretrained("phones", draw=Draw("perturb"))
    picture = half_dark()
    chosen = augment.look(picture)
    assert chosen is not None
    params = augment.sample(picture.expand(64, -1, -1, -1), torch.Generator().manual_seed(0), None, chosen)
    stops = (params.isp.gains / chosen.gains).log2().square().mean().sqrt()
    assert 0.03 < stops < 0.2
