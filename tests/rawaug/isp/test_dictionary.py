"""Dictionaries: what their atoms are normalised to, and sampling that stays in the hull."""

from __future__ import annotations

import torch
from hypothesis import given
from hypothesis import strategies as st

from rawaug.isp.dictionary import (
    ColourDictionary,
    GainDictionary,
    ToneDictionary,
    convex_weights,
    perturb,
    project_to_simplex,
)


def test_colour_atoms_have_rows_of_l1_norm_one() -> None:
    colour = ColourDictionary(3)
    with torch.no_grad():
        colour.matrices.copy_(torch.randn(3, 3, 3, generator=torch.Generator().manual_seed(0)))
    torch.testing.assert_close(colour.atoms().abs().sum(2), torch.ones(3, 3))


def test_gain_atoms_start_between_one_and_two_as_published() -> None:
    atoms = GainDictionary(64).atoms()
    assert ((atoms >= 1) & (atoms <= 2)).all()
    assert atoms.min() < 1.1 and atoms.max() > 1.9


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
    torch.testing.assert_close(colour.weights_for(balance), torch.full((2, 3), 1 / 3))  # uninformative light
    colour.light.copy_(torch.tensor([[2.0, 1.5], [1.5, 2.0], [1.0, 1.0]]).log())
    colour.spread.fill_(0.05)
    torch.testing.assert_close(colour.weights_for(balance), torch.eye(3)[:2], atol=1e-4, rtol=0)


def test_known_gains_make_grey_the_inverse_of_the_white_balance() -> None:
    generator = torch.Generator().manual_seed(0)
    colour, balance = ColourDictionary(2), torch.tensor([[2.0, 1.0, 1.5]])
    with torch.no_grad():
        colour.matrices.copy_(torch.randn(2, 3, 3, generator=generator) * 0.1 + torch.eye(3))
    colour.neutral.copy_(torch.tensor([[0.8], [0.2]]).log().expand(2, 3))
    weights = torch.tensor([[0.5, 0.5]])
    grey = colour.combine(weights) @ torch.ones(3) / colour.gains_for(balance, weights)
    torch.testing.assert_close(grey, 1 / (0.4 * balance))  # the digital gains' geometric mean


@given(st.lists(st.floats(-2, 2), min_size=1, max_size=9))
def test_projection_is_on_the_simplex_and_leaves_its_points(values: list[float]) -> None:
    projected = project_to_simplex(torch.tensor([values], dtype=torch.float64))
    assert (projected >= 0).all()
    torch.testing.assert_close(projected.sum(), torch.tensor(1.0, dtype=torch.float64))
    torch.testing.assert_close(project_to_simplex(projected), projected)


def test_projection_is_the_nearest_point() -> None:
    torch.testing.assert_close(project_to_simplex(torch.tensor([[0.5, 0.9]])), torch.tensor([[0.3, 0.7]]))
    torch.testing.assert_close(project_to_simplex(torch.tensor([[2.0, 0.0]])), torch.tensor([[1.0, 0.0]]))


def test_perturbation_grows_with_strength_and_is_keyed() -> None:
    weights = torch.full((500, 4), 0.25)

    def spread(strength: float) -> float:
        return (perturb(weights, strength, torch.Generator().manual_seed(1)) - weights).std().item()

    assert spread(0.0) < 1e-6 < spread(0.05) < spread(0.2)
    again = perturb(weights, 0.1, torch.Generator().manual_seed(1))
    assert torch.equal(again, perturb(weights, 0.1, torch.Generator().manual_seed(1)))


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


def test_a_mixture_of_curves_has_the_same_bits_in_any_batch_with_and_without_zeros() -> None:
    tone = ToneDictionary(5)
    tone.curves.copy_(torch.rand(5, tone.curves.shape[1], generator=torch.Generator().manual_seed(0)))
    weights = torch.tensor([[0.0, 0.3, 0.0, 0.7, 0.0], [0.1, 0.2, 0.3, 0.15, 0.25], [0.0, 0.0, 0.0, 0.0, 1.0]])
    mixed = tone.combine(weights)
    torch.testing.assert_close(mixed, weights @ tone.curves)
    assert all(torch.equal(tone.combine(row[None])[0], table) for row, table in zip(weights, mixed, strict=True))
    fitted = weights.clone().requires_grad_()
    assert torch.equal(tone.combine(fitted), mixed)
    tone.combine(fitted)[:, 500].sum().backward()
    torch.testing.assert_close(fitted.grad, tone.curves[:, 500].expand(3, 5))
