"""Encoders: weights on the simplex, from a constant alone or from the picture as well."""

from __future__ import annotations

import torch

from rawaug.isp.staged import THUMBNAIL, Encoder, thumbnail


def images() -> torch.Tensor:
    return torch.rand(2, 3, 3, 16, 16, generator=torch.Generator().manual_seed(0))


def test_without_layers_an_encoder_gives_its_constant() -> None:
    encoder = Encoder(3)
    encoder.set_prior(torch.tensor([0.2, 0.3, 0.5]))
    torch.testing.assert_close(encoder(images()), torch.tensor([[0.2, 0.3, 0.5]] * 2))


def test_one_with_layers_starts_from_its_constant_and_then_looks_at_the_picture() -> None:
    encoder = Encoder(3)
    encoder.set_prior(torch.tensor([0.2, 0.3, 0.5]))
    encoder.add_layers((4, 4, 4))
    torch.testing.assert_close(encoder(images()), torch.tensor([[0.2, 0.3, 0.5]] * 2))
    with torch.no_grad():
        for parameter in encoder.parameters():
            parameter.normal_(0.0, 0.3, generator=torch.Generator().manual_seed(0))
    first, second = encoder(images())
    assert not torch.allclose(first, second)
    torch.testing.assert_close(first.sum(), torch.tensor(1.0))


def test_an_atom_of_no_weight_can_come_back() -> None:
    encoder = Encoder(2)
    encoder.set_prior(torch.tensor([1.0, 0.0]))
    weights = encoder(images()[:, :2])
    assert (weights[:, 1] > 0).all() and (weights[:, 1] < 1e-5).all()


def test_a_thumbnail_keeps_the_mean_and_the_shape() -> None:
    picture = torch.rand(1, 3, 96, 192, generator=torch.Generator().manual_seed(0))
    small = thumbnail(picture)
    assert small.shape == (1, 3, THUMBNAIL // 2, THUMBNAIL)
    torch.testing.assert_close(small.mean(), picture.mean())
    assert torch.equal(thumbnail(picture[..., :20, :30]), picture[..., :20, :30])  # small ones stay as they are
