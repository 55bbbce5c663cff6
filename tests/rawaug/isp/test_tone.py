"""Inverse tone curves: there and back, and mixtures of them."""

from __future__ import annotations

import torch

from rawaug.isp.model import DictionaryISP
from rawaug.isp.tone import ToneDictionary, to_code, to_linear


def test_curves_go_both_ways(universal: DictionaryISP) -> None:
    assert universal.tone is not None
    tables = universal.tone.curves
    code = torch.rand(len(tables), 3, 8, 8, generator=torch.Generator().manual_seed(0))
    there = to_linear(code, tables)
    torch.testing.assert_close(to_linear(to_code(there, tables), tables), there, atol=1e-5, rtol=0)
    assert torch.equal(to_code(torch.tensor([[[[-1.0, 2.0]]]]), tables[:1]), torch.tensor([[[[0.0, 1.0]]]]))


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
