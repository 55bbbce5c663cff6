"""The baked reverse pass against the ISP itself."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from rawaug import bayer
from rawaug.isp.config import POINTWISE_STAGES, ISPConfig, ISPParams
from rawaug.isp.fast import BakedISP, FastForward
from rawaug.isp.model import DictionaryISP
from rawaug.isp.sampling import camera_sampler, draw_setting
from rawaug.isp.stages import LensShading, ToneMap
from rawaug.kernels import runtime
from rawaug.metrics import psnr
from rawaug.plugin.augment import RawAugment
from rawaug.plugin.draw import Draw
from tests.rawaug.kernels.full_isp import full_isp


@pytest.fixture(params=["compiled", "pytorch"])
def either_way(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """With and without compiled loops."""
    monkeypatch.setattr(runtime, "has_numba", lambda: request.param == "compiled")


@pytest.mark.usefixtures("either_way")
@pytest.mark.parametrize("attention", [False, True])
def test_baked_is_the_isp_above_75_db(attention: bool) -> None:
    isp = full_isp(attention=attention)
    generator = torch.Generator().manual_seed(1)
    srgb = torch.randint(256, (4, 3, 48, 64), generator=generator, dtype=torch.uint8)
    params = isp.choose(srgb) if attention else isp.reverse(srgb, digital_gain=0.6).params  # some gains below 1
    unbaked = bayer.pack(isp.reverse(srgb, params).raw, isp.cfa)
    assert psnr(BakedISP(isp)(srgb, params), unbaked).min().item() > 75.0


def test_the_table_has_the_same_bits_with_any_number_of_threads() -> None:
    isp, before = full_isp(), torch.get_num_threads()
    tables = []
    for threads in (1, 2, 3):
        torch.set_num_threads(threads)
        try:
            tables.append(BakedISP(isp).table)
            assert torch.get_num_threads() == threads
        finally:
            torch.set_num_threads(before)
    assert torch.equal(tables[0], tables[1]) and torch.equal(tables[0], tables[2])


@pytest.mark.usefixtures("either_way")
@pytest.mark.parametrize("left_out", POINTWISE_STAGES)
def test_any_stage_may_be_left_out(left_out: str) -> None:
    isp = full_isp(stages=tuple(stage for stage in POINTWISE_STAGES if stage != left_out))
    srgb = torch.randint(256, (1, 3, 16, 16), generator=torch.Generator().manual_seed(1), dtype=torch.uint8)
    params = isp.choose(srgb)
    unbaked = bayer.pack(isp.reverse(srgb, params).raw, isp.cfa)
    assert psnr(BakedISP(isp)(srgb, params), unbaked).item() > 75.0


@pytest.mark.usefixtures("either_way")
@pytest.mark.parametrize("view", range(bayer.N_VIEWS))
def test_the_mask_keeps_to_the_place_that_a_turned_crop_has_in_its_frame(view: int) -> None:
    isp = full_isp()
    frame = torch.rand(1, 3, 40, 60, generator=torch.Generator().manual_seed(1))
    params = isp.choose(frame)
    x5 = isp.stages.reverse(frame, params)
    crop, expected = (bayer.turn(x[..., 6:26, 34:50], view) for x in (frame, x5))
    raw = BakedISP(isp)(crop, params, torch.tensor([[6, 34, 40, 60, view]]))
    assert psnr(raw, bayer.pack_rgb(expected, isp.cfa)).item() > 75.0


@pytest.mark.usefixtures("either_way")
@pytest.mark.parametrize("looks", [False, True])
def test_choice_is_that_of_the_isp(looks: bool) -> None:
    generator = torch.Generator().manual_seed(2)
    isp = full_isp(encoders=looks)
    with torch.no_grad():
        for encoder in (isp.reverse_encoders.colour, isp.reverse_encoders.gain) if looks else ():
            list(encoder.parameters())[-2].normal_(std=5.0, generator=generator)
    srgb = torch.randint(256, (3, 3, 150, 200), generator=generator, dtype=torch.uint8)
    augment = RawAugment(isp, noise=(0.0, 0.0), draw=Draw(sampling="chosen"))
    chosen, expected = augment.settings.choose(srgb), isp.choose(srgb)
    assert (expected.colour_weights.std(0) > 1e-3).any() == looks
    for a, b in zip(chosen, expected, strict=True):
        torch.testing.assert_close(a, b, atol=1e-3, rtol=0)


def test_later_changes_of_the_isp_do_not_reach_it() -> None:
    isp, srgb = full_isp(), torch.rand(1, 3, 8, 8, generator=torch.Generator().manual_seed(1))
    params, baked = isp.choose(srgb), BakedISP(isp)
    before = baked(srgb, params)
    with torch.no_grad():
        for value in isp.parameters():
            value.add_(0.1)
    assert torch.equal(baked(srgb, params), before)


def test_pictures_and_parameters_that_do_not_fit_are_refused() -> None:
    isp = full_isp()
    baked, params = BakedISP(isp), isp.choose(torch.zeros(2, 3, 8, 8))
    with pytest.raises(ValueError, match="sides"):
        baked(torch.zeros(2, 3, 8, 7), params)
    with pytest.raises(ValueError, match="matrix"):
        baked(torch.zeros(3, 3, 8, 8), params)
    with pytest.raises(ValueError, match="place"):
        baked(torch.zeros(2, 3, 8, 8), params, torch.tensor([[0, 0, 8, 8]]))


def test_stages_in_another_order_are_refused() -> None:
    with pytest.raises(ValueError, match="colour"):
        BakedISP(DictionaryISP(ISPConfig(stages=("gamma", "gains", "colour"))))
    with pytest.raises(ValueError, match="colour"):
        FastForward(DictionaryISP(ISPConfig(stages=("gamma", "gains", "colour"))))


def forward_curved(**settings: object) -> DictionaryISP:
    """:func:`full_isp`, whose forward networks do something as well."""
    isp, generator = full_isp(**settings), torch.Generator().manual_seed(5)
    with torch.no_grad():
        if tone := isp.stages.find(ToneMap):
            list(tone.forward_network.parameters())[-2].normal_(std=0.05, generator=generator)
        if (lens := isp.stages.find(LensShading)) and lens.forward_attention:
            for layers in (lens.forward_attention.layers, lens.forward_attention.place_layers):
                list(layers.parameters())[-2].normal_(std=0.05, generator=generator)
    return isp


@pytest.mark.usefixtures("either_way")
@pytest.mark.parametrize("name", ["universal", "canon-powershot", "curved"])
def test_fast_forward_is_the_isp_above_60_db(name: str) -> None:
    isp = forward_curved() if name == "curved" else DictionaryISP.from_pretrained(name)
    isp.requires_grad_(False)
    generator = torch.Generator().manual_seed(1)
    srgb = torch.rand(3, 3, 32, 48, generator=generator)
    drawn = camera_sampler(isp) is not None
    params = draw_setting(isp, 3, generator) if drawn else isp.choose(srgb)
    raw = isp.reverse(srgb, params).raw
    x5 = bayer.demosaic(raw + 0.01 * torch.randn(raw.shape, generator=generator), isp.cfa)
    made = FastForward(isp)(x5, params)
    assert made.dtype == torch.float32 and made.min() >= 0 and made.max() <= 1
    assert error_below_white(isp, made, x5, params) > 60.0


def error_below_white(isp: DictionaryISP, made: Tensor, x5: Tensor, params: ISPParams) -> float:
    """PSNR against the exact pass where its linear light is at most white; above, the fast one clips before tone."""
    seen: dict[str, Tensor] = {}
    exact = isp.stages.forward(x5, params, None, seen).clamp(0.0, 1.0)
    balanced = seen["x3"] <= params.gains.amin(dim=1)[:, None, None, None]
    below = ((seen["x2"] <= 1.0) & balanced).all(dim=1, keepdim=True).expand_as(exact)
    assert below.float().mean() > 0.4
    return float(-10.0 * (made - exact)[below].square().mean().log10())


@pytest.mark.usefixtures("either_way")
@pytest.mark.parametrize("view", [0, 4])
def test_fast_forward_undoes_the_mask_where_the_crop_was(view: int) -> None:
    isp = forward_curved()
    x5 = 0.3 * torch.rand(1, 3, 40, 60, generator=torch.Generator().manual_seed(1))
    params = isp.choose(x5)
    whole = isp.stages.forward(x5, params).clamp(0.0, 1.0)
    crop, expected = (bayer.turn(x[..., 6:26, 34:50], view).contiguous() for x in (x5, whole))
    made = FastForward(isp)(crop, params, torch.tensor([[6, 34, 40, 60, view]]))
    assert psnr(made, expected).item() > 50.0


@pytest.mark.usefixtures("either_way")
@pytest.mark.parametrize("name", ["universal", "canon-powershot", "gopro-hero"])
def test_a_saturated_sensor_develops_to_a_neutral_highlight(name: str) -> None:
    isp = DictionaryISP.from_pretrained(name).requires_grad_(False)
    white = torch.ones(2, 3, 4, 4)
    params = draw_setting(isp, 2, torch.Generator().manual_seed(1)) if isp.config.cameras else isp.choose(white)
    centre = torch.tensor([[998, 1498, 2000, 3000]]).expand(2, 4)  # where the mask leaves all light
    srgb = FastForward(isp)(white, params, centre)
    assert (srgb.amax(dim=1) - srgb.amin(dim=1)).max() < 0.02 and srgb.min() > 0.95


@pytest.mark.usefixtures("either_way")
def test_gradients_of_fast_forward_are_those_of_the_isp() -> None:
    isp = DictionaryISP.from_pretrained("universal").requires_grad_(False)
    params = draw_setting(isp, 1, torch.Generator().manual_seed(2))
    x5 = 0.1 + 0.1 * torch.rand(1, 3, 8, 8, generator=torch.Generator().manual_seed(1))
    found = []
    for forward in (FastForward(isp), isp.stages.forward):
        x, gains = x5.clone().requires_grad_(), params.gains.clone().requires_grad_()
        forward(x, params._replace(gains=gains)).square().sum().backward()
        found.append((x.grad, gains.grad))
    for ours, exact in zip(*found, strict=True):
        torch.testing.assert_close(ours, exact, rtol=0.02, atol=0.02)


@pytest.mark.usefixtures("either_way")
@pytest.mark.parametrize("method", bayer.DIRECTIONAL)
def test_a_choice_of_direction_sees_nothing_below_black(method: str) -> None:
    """RAW developers clip before they compare directions, so that noise around black does not choose."""
    isp = DictionaryISP.from_pretrained("universal").requires_grad_(False)
    params, forward = draw_setting(isp, 1, torch.Generator().manual_seed(1)), FastForward(isp)
    raw = 0.02 * torch.randn(1, 1, 32, 48, generator=torch.Generator().manual_seed(0)) + 0.01
    below, clipped = forward.develop([raw, raw.clamp_min(0.0)], [method], params)
    assert torch.equal(below, clipped) and clipped.std() > 0.01


@pytest.mark.usefixtures("either_way")
@pytest.mark.parametrize("cfa", list(bayer.CFA))
def test_mosaics_are_demosaiced_by_their_own_method_and_developed(cfa: bayer.CFA) -> None:
    isp, methods = DictionaryISP.from_pretrained("universal"), ["malvar", "bilinear", "malvar"]
    isp.configure(cfa=cfa)
    params, forward = draw_setting(isp, 3, torch.Generator().manual_seed(1)), FastForward(isp.requires_grad_(False))
    raw = 0.3 * torch.rand(3, 1, 6, 530, generator=torch.Generator().manual_seed(0))
    linear = torch.cat([bayer.demosaic(one, cfa, method) for one, method in zip(raw.split(1), methods, strict=True)])
    torch.testing.assert_close(forward.develop([raw], methods, params)[0], forward(linear, params), atol=1e-4, rtol=0)
