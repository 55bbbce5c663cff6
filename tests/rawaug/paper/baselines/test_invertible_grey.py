"""Invertible greyscale: any size, and an encoder that learns to hide what the decoder needs."""

from __future__ import annotations

import torch

from rawaug.data.pairs import Pair
from rawaug.metrics import psnr
from rawaug.paper.baselines.base import Training, fit_baseline
from rawaug.paper.baselines.invertible_grey import InvertibleGrey


def test_sides_need_not_be_multiples_of_four() -> None:
    model = InvertibleGrey(features=4, blocks=1)
    assert model.reverse(torch.rand(1, 3, 10, 14)).shape == (1, 1, 10, 14)
    assert model(torch.rand(1, 1, 10, 14)).shape == (1, 3, 10, 14)


def test_what_the_encoder_renders_holds_what_the_decoder_needs(exact_pairs: list[Pair]) -> None:
    """After a short training RAW comes back from the own rendering better than before it."""
    pair = exact_pairs[0]

    def restored(model: InvertibleGrey) -> float:
        with torch.no_grad():
            picture = model(pair.clean.mosaic[None], pair.clean.white_balance)
            return psnr(model.reverse(picture, pair.clean.white_balance), pair.clean.mosaic[None]).item()

    before = restored(InvertibleGrey("GRBG", features=8, blocks=1))
    model = InvertibleGrey("GRBG", features=8, blocks=1)
    fit_baseline(model, exact_pairs, Training(steps=60, crop=32, batch=2, progress=False))
    assert restored(model) > before + 3.0


def test_the_hidden_error_trains_the_encoder(exact_pairs: list[Pair]) -> None:
    model = InvertibleGrey("GRBG", features=4, blocks=1)
    compressed = model.compress(exact_pairs[0].clean.mosaic[None])
    error = (model.from_picture(model.to_picture(compressed)) - compressed).abs().mean()
    error.backward()
    gradients = [parameter.grad for parameter in model.encoder.parameters()]
    assert all(gradient is not None and gradient.isfinite().all() for gradient in gradients)
    assert any(gradient is not None and gradient.abs().max() > 0 for gradient in gradients)
