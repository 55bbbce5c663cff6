"""The shipped ISP ``phones``: encoders that look, and dictionaries of what may be cameras."""

from __future__ import annotations

import pytest
import torch

from rawaug.data.phones import CAMERAS, Shot, take_shot
from rawaug.isp.fit.atoms import plausible_matrices
from rawaug.isp.model import DictionaryISP
from rawaug.isp.stages import LensShading


@pytest.fixture(scope="module")
def isp() -> DictionaryISP:
    return DictionaryISP.from_pretrained("phones")


def test_it_has_encoders_and_both_masks_in_no_more_parameters_than_published(isp: DictionaryISP) -> None:
    lens = isp.stages.find(LensShading)
    assert isp.config.encoders and lens is not None and lens.reverse_attention is not None
    assert sum(p.numel() for p in isp.parameters()) <= 590_000


def test_its_dictionaries_are_plausible_matrices_and_gains(isp: DictionaryISP) -> None:
    """All but one atom, of frames with hardly any colour; and so is what the constants choose."""
    atoms = isp.colour.atoms()
    torch.testing.assert_close(atoms.abs().sum(2), torch.ones(16, 3))
    setting = isp.typical_setting()
    assert plausible_matrices(atoms).sum() >= 15 and plausible_matrices(setting.matrix).all()
    digital, red, blue = isp.gain.atoms().unbind(1)
    assert digital.min() > 0.5 and digital.max() < 25.0
    usual = (torch.stack([red, blue]).amin(0) > 0.9) & (torch.stack([red, blue]).amax(0) < 4.0)
    assert usual.sum() >= 15
    assert (setting.gains > 1.0).all() and (setting.gains < 8.0).all()


def test_its_mask_darkens_corners_about_the_middle(isp: DictionaryISP) -> None:
    lens = isp.stages.find(LensShading)
    assert lens is not None
    corners = torch.tensor([[0.7, 0.7], [0.7, -0.7], [-0.7, 0.7], [-0.7, -0.7]]).T[None, :, None]
    mask = lens.mask(corners)
    assert mask.min() > 0.4 and mask.max() < 0.8 and lens.mask.mean.abs().max() < 0.15


def test_it_tells_a_dark_room_from_daylight(isp: DictionaryISP) -> None:
    """Of the same scene: more gain for less light."""
    scene = 0.1 + 0.5 * torch.rand(3, 16, 16, generator=torch.Generator().manual_seed(0))
    scene = scene.repeat_interleave(16, 1).repeat_interleave(16, 2)

    def green_gain(stops: float) -> float:
        shot = Shot(5500, stops, 100, balance_error=0.0, tint_error=(0.0, 0.0), lift_error=0.0)
        pair = take_shot(CAMERAS["IP"], scene, shot, torch.Generator().manual_seed(0))
        with torch.no_grad():
            return float(isp.choose(pair.srgb[None]).gains[0, 1])

    assert green_gain(2.5) > 1.2 * green_gain(0.5)
