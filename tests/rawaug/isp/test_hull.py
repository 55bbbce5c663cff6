"""The hull of colour atoms: distances are errors on pictures, mixtures are found, greedy atoms reach unseen cameras."""

from __future__ import annotations

import pytest
import torch

from rawaug.isp.cameras import colour_matrix, published_cameras
from rawaug.isp.dictionary import colour_coordinates, greedy_atoms, nearest_in_hull, psnr, second_moment

COLOURS = torch.rand(3, 500, generator=torch.Generator().manual_seed(0)).double() ** 2


def test_squared_distance_is_the_error_on_pictures() -> None:
    first, second = colour_matrix(published_cameras().distinct()[[3, 90]])
    a, b = colour_coordinates(torch.stack([first, second]), second_moment(COLOURS))
    error = (first @ COLOURS - second @ COLOURS).square().mean()
    assert (a - b).square().sum().item() == pytest.approx(error.item(), rel=1e-9)


def test_a_mixture_is_found_and_a_point_outside_is_projected() -> None:
    atoms = torch.tensor([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]], dtype=torch.float64)
    points = torch.tensor([[0.2, 0.3], [1.0, 1.0], [-1.0, 0.5]], dtype=torch.float64)
    weights, error = nearest_in_hull(points, atoms)
    torch.testing.assert_close(weights.sum(dim=1), torch.ones(3, dtype=torch.float64))
    nearest = torch.tensor([[0.2, 0.3], [0.5, 0.5], [0.0, 0.5]], dtype=torch.float64)
    torch.testing.assert_close(weights @ atoms, nearest, atol=1e-6, rtol=0)
    torch.testing.assert_close(error, torch.tensor([0.0, 0.5, 1.0], dtype=torch.float64), atol=1e-6, rtol=0)


def test_greedy_atoms_of_some_cameras_reach_the_others() -> None:
    photographs = torch.tensor([[0.130, 0.122, 0.118], [0.122, 0.128, 0.130], [0.118, 0.130, 0.148]])
    points = colour_coordinates(colour_matrix(published_cameras().distinct()), photographs)
    seen, unseen = points[0::8], points[4::8]
    greedy = psnr(nearest_in_hull(unseen, seen[greedy_atoms(seen, 4)])[1])
    order = torch.randperm(len(seen), generator=torch.Generator().manual_seed(0))
    by_chance = psnr(nearest_in_hull(unseen, seen[order[:4]])[1])
    assert (greedy >= 45).double().mean() > (by_chance >= 45).double().mean() + 0.4
    assert (greedy >= 45).double().mean() > 0.65
