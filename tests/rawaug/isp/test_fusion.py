"""Encoders give weights on the simplex; what the user knows of a shot takes the place of their guess."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch

from rawaug.data.pairs import Pair
from rawaug.isp.config import ISPParams
from rawaug.isp.encoders import THUMBNAIL, AtomEncoder, thumbnail
from rawaug.isp.model import DictionaryISP
from rawaug.isp.tone import srgb_to_linear
from rawaug.metrics import psnr


def images() -> torch.Tensor:
    return torch.rand(2, 3, 3, 16, 16, generator=torch.Generator().manual_seed(0))


def test_an_encoder_gives_its_constant_and_with_trained_layers_looks_at_the_picture() -> None:
    encoder = AtomEncoder(3)
    encoder.set_prior(torch.tensor([0.2, 0.3, 0.5]))
    torch.testing.assert_close(encoder(images()), torch.tensor([[0.2, 0.3, 0.5]] * 2))
    encoder.add_layers((4, 4, 4))
    torch.testing.assert_close(encoder(images()), torch.tensor([[0.2, 0.3, 0.5]] * 2))
    with torch.no_grad():
        for parameter in encoder.parameters():
            parameter.normal_(0.0, 0.3, generator=torch.Generator().manual_seed(0))
    first, second = encoder(images())
    assert not torch.allclose(first, second)
    torch.testing.assert_close(first.sum(), torch.tensor(1.0))


def test_an_atom_of_no_weight_can_come_back() -> None:
    encoder = AtomEncoder(2)
    encoder.set_prior(torch.tensor([1.0, 0.0]))
    weights = encoder(images()[:, :2])
    assert (weights[:, 1] > 0).all() and (weights[:, 1] < 1e-5).all()


def test_a_thumbnail_keeps_the_mean_and_the_shape() -> None:
    picture = torch.rand(1, 3, 96, 192, generator=torch.Generator().manual_seed(0))
    small = thumbnail(picture)
    assert small.shape == (1, 3, THUMBNAIL // 2, THUMBNAIL)
    torch.testing.assert_close(small.mean(), picture.mean())
    assert torch.equal(thumbnail(picture[..., :20, :30]), picture[..., :20, :30])  # small ones stay as they are


LIGHT = (1.7, 0.9, 1.4)


def picture() -> torch.Tensor:
    return 0.05 + 0.75 * torch.rand(1, 3, 32, 48, generator=torch.Generator().manual_seed(0))


def readings(raw: torch.Tensor, count: int, seed: int = 1) -> torch.Tensor:
    """``(1, count, 3)`` random places with their values."""
    generator = torch.Generator().manual_seed(seed)
    rows, columns = (torch.randint(side, (count,), generator=generator) for side in raw.shape[-2:])
    return torch.stack([rows.float(), columns.float(), raw[0, 0, rows, columns]], dim=1)[None]


@pytest.mark.parametrize("clipped", [False, True])
def test_exact_readings_give_the_gains_and_clipped_ones_are_left_out(clipped: bool) -> None:
    isp = DictionaryISP()
    truth = isp.reverse(picture(), white_balance=LIGHT)
    samples = readings(truth.raw, 64)
    if clipped:
        samples[:, ::2, 2] = 1.0
    solved = isp.reverse(picture(), raw_samples=samples).params
    torch.testing.assert_close(solved.gains, truth.params.gains, rtol=1e-4, atol=0)


def test_noisy_readings_with_some_on_edges_give_the_gains() -> None:
    isp = DictionaryISP()
    truth = isp.reverse(picture(), white_balance=LIGHT)
    off = []
    for seed in range(8):
        samples = readings(truth.raw, 64, seed)
        generator = torch.Generator().manual_seed(seed)
        value = samples[..., 2]
        value += (1e-4 * value).sqrt() * torch.randn(value.shape, generator=generator)
        value[:, :8] *= 3.0  # these lie on edges
        solved = isp.reverse(picture(), raw_samples=samples).params
        off.append((solved.gains / truth.params.gains - 1).abs())
    assert torch.cat(off).median() < 0.01
    assert torch.cat(off).max() < 0.05


def test_a_channel_without_a_reading_keeps_its_gain() -> None:
    isp = DictionaryISP()
    chosen = isp.choose(picture()).gains
    truth = isp.reverse(picture(), white_balance=LIGHT)
    samples = readings(truth.raw, 64)
    green = (samples[..., 0] + samples[..., 1]) % 2 == 1  # RGGB
    solved = isp.reverse(picture(), raw_samples=samples[green][None]).params.gains
    torch.testing.assert_close(solved[0, 1], truth.params.gains[0, 1], rtol=1e-4, atol=0)
    torch.testing.assert_close(solved[:, 0::2], chosen[:, 0::2])


def test_readings_reproduce_an_unseen_shot(fitted: DictionaryISP, exact_pair: Callable[..., Pair]) -> None:
    unseen = exact_pair("unseen", (1.4, 1.0, 2.0), seed=9)
    raw = fitted.reverse(unseen.srgb[None], raw_samples=readings(unseen.clean.mosaic[None], 64)).raw
    assert psnr(raw, unseen.clean.mosaic[None]).item() > 50.0


def test_readings_choose_the_colour_atoms_of_their_light() -> None:
    isp = DictionaryISP()
    isp.colour.light.copy_(torch.linspace(-0.5, 1.0, 16)[:, None].expand(16, 2))
    isp.colour.spread.fill_(0.05)
    truth = isp.reverse(picture(), white_balance=(1.65, 1.0, 1.65))  # log 0.5: atom 10 of 16
    assert truth.params.colour_weights.argmax() == 10
    solved = isp.reverse(picture(), raw_samples=readings(truth.raw, 64)).params
    torch.testing.assert_close(solved.colour_weights, truth.params.colour_weights, atol=1e-3, rtol=0)


def grey(params: ISPParams) -> torch.Tensor:
    return params.matrix[0].sum(1) / params.gains[0]


def test_a_file_decides_where_nothing_was_measured_and_grey_is_its_inverse() -> None:
    isp = DictionaryISP()
    isp.colour.neutral.copy_(torch.tensor([0.4]).log().expand(16, 3))
    params = isp.reverse(picture(), white_balance=(2.0, 1.0, 1.6)).params
    torch.testing.assert_close(grey(params), 1 / (0.4 * torch.tensor([2.0, 1.0, 1.6])), rtol=1e-4, atol=0)
    params = isp.reverse(picture(), white_balance=(2.0, 1.0, 1.6), digital_gain=0.5).params
    torch.testing.assert_close(grey(params), 1 / (0.5 * torch.tensor([2.0, 1.0, 1.6])), rtol=1e-4, atol=0)


CHOICE = [[0.05, 0.03, 0.03], [0.03, 0.05, 0.03], [0.03, 0.03, 0.08]]


@pytest.mark.parametrize(("noise", "share"), [(0.0, 1.0), (1e8, 0.0)])
def test_a_file_without_noise_fulfils_its_ratios_and_with_infinite_noise_leaves_the_choice(
    noise: float, share: float
) -> None:
    isp = DictionaryISP()
    isp.info["gain_errors"] = [CHOICE, (noise * torch.eye(3) + 1e4).tolist()]
    blind = isp.reverse(picture()).params
    params = isp.reverse(picture(), white_balance=LIGHT).params
    light = torch.tensor(LIGHT)
    ratios = (1.0 - share) * grey(blind).log() - share * light.log()
    torch.testing.assert_close(grey(params).log() - grey(params)[1].log(), ratios - ratios[1], atol=2e-3, rtol=0)
    if share:
        # the digital gain of the choice is kept as its errors go together, not replaced by the file's
        file = DictionaryISP().reverse(picture(), white_balance=LIGHT).params
        assert not torch.isclose(grey(params)[1], grey(file)[1], rtol=1e-2)


def test_the_less_noisy_of_choice_and_file_counts_more() -> None:
    isp = DictionaryISP()
    off = []
    blind, light = grey(isp.reverse(picture()).params), 1 / (torch.tensor(LIGHT) / LIGHT[1])
    for noise in (0.01, 0.05, 0.25):
        isp.info["gain_errors"] = [(0.05 * torch.eye(3)).tolist(), (noise * torch.eye(3)).tolist()]
        fused = grey(isp.reverse(picture(), white_balance=LIGHT).params)
        off.append(((fused / blind).log() / (light / blind).log()).tolist())
    expected = torch.tensor([0.05 / 0.06, 0.5, 0.05 / 0.3])[:, None].expand(3, 3)
    torch.testing.assert_close(torch.tensor(off), expected, rtol=1e-3, atol=0)


def test_a_known_digital_gain_is_met_and_moves_the_others_as_their_errors_go_together() -> None:
    isp = DictionaryISP()
    isp.info["gain_errors"] = [CHOICE, (1e-6 * torch.eye(3)).tolist()]
    blind = grey(isp.reverse(picture()).params)
    known = grey(isp.reverse(picture(), digital_gain=0.5).params)
    torch.testing.assert_close(known[1], torch.tensor(2.0))
    torch.testing.assert_close((known / blind).log()[0], 0.6 * (known / blind).log()[1])


def test_readings_with_much_noise_are_weighed_against_the_choice() -> None:
    isp = DictionaryISP()
    truth = isp.reverse(picture(), white_balance=LIGHT)
    samples = readings(truth.raw, 64)
    samples[..., 2] *= torch.exp(0.5 * torch.randn(64, generator=torch.Generator().manual_seed(0)))
    shares = []
    for variance in (1e-8, 1e-2, 1e4):
        isp.info["gain_errors"] = [(variance * torch.eye(3)).tolist(), torch.eye(3).tolist()]
        moved = isp.reverse(picture(), raw_samples=samples).params.gains / isp.choose(picture()).gains
        shares.append(moved.log().norm().item())
    assert shares[0] < 1e-3 < shares[1] < shares[2]


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"white_balance": (2.0, 1.0)}, r"white_balance .*\(3,\)"),
        ({"white_balance": torch.ones(2, 3)}, "white_balance"),
        ({"white_balance": (0.0, 1.0, 1.6)}, r"white_balance .*positive"),
        ({"digital_gain": 0.0}, r"digital_gain .*positive"),
        ({"raw_samples": torch.full((1, 1, 3), float("nan"))}, "NaN"),
        ({"digital_gain": torch.ones(2)}, "digital_gain"),
        ({"raw_samples": torch.zeros(1, 4)}, "row, column, value"),
        ({"raw_samples": torch.tensor([[[32.0, 0.0, 0.1]]])}, r"outside .*32 x 48"),
        ({"raw_samples": torch.tensor([[[0.0, -1.0, 0.1]]])}, "outside the picture"),
    ],
)
def test_other_shapes_and_places_are_refused(given: dict[str, torch.Tensor], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        DictionaryISP().reverse(picture(), **given)  # type: ignore[arg-type]


# -- a known tone curve ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["universal", "universal-small"])
def test_a_tone_by_name_is_that_curve_in_both_passes(name: str) -> None:
    isp = DictionaryISP.from_pretrained(name)
    x = picture()
    result = isp.reverse(x, tone="linear", intermediates=True)
    torch.testing.assert_close(result.intermediates["x2"], srgb_to_linear(x), atol=2e-4, rtol=0)
    back = isp.forward(result.raw, result.params._replace(tone_weights=isp.choose(x).tone_weights), tone="linear")
    assert torch.equal(back.params.tone_weights, result.params.tone_weights)
    assert not torch.allclose(isp.reverse(x).raw, result.raw)


def test_a_mixture_of_tones_is_the_mean_of_their_light() -> None:
    isp = DictionaryISP.from_pretrained("universal")
    x = picture()
    names = isp.info["tones"]
    one, two = (isp.reverse(x, tone=name, intermediates=True).intermediates["x2"] for name in names[:2])
    mixed = isp.reverse(x, tone={names[0]: 1.0, names[1]: 3.0}, intermediates=True)
    torch.testing.assert_close(mixed.intermediates["x2"], 0.25 * one + 0.75 * two, atol=1e-5, rtol=0)
    replayed = isp.reverse(x, tone=mixed.params.tone_weights[0])
    assert torch.equal(replayed.raw, mixed.raw)


def test_tones_that_there_are_not_are_refused() -> None:
    isp = DictionaryISP.from_pretrained("universal")
    with pytest.raises(ValueError, match="linear"):
        isp.reverse(picture(), tone="liner")
    with pytest.raises(ValueError, match="negative"):
        isp.reverse(picture(), tone={"linear": -1.0})
    with pytest.raises(ValueError, match="tone must be"):
        isp.reverse(picture(), tone=torch.ones(3))
    with pytest.raises(ValueError, match="learned"):
        DictionaryISP.from_pretrained("canon-powershot").reverse(picture(), tone="linear")
