"""CycleISP's denoiser: its published size, its checkpoints, which the test writes in their layout, and its file."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from torch import Tensor

import denoisers
from denoisers import CycleISPDenoiser


def published(model: CycleISPDenoiser) -> dict[str, Tensor]:
    """The keys of a published checkpoint for weights that are all drawn anew."""
    generator, state = torch.Generator().manual_seed(1), {}
    renamed = (("head.", "head.0."), (".spatial.", ".SA.spatial.conv."), (".channel.", ".CA.conv_du."))
    for key, value in model.trunk.state_dict().items():
        for own, theirs in (*renamed, (".merge.", ".conv1x1.")):
            key = key.replace(own, theirs)
        state[f"module.{key}"] = 0.05 * torch.randn(value.shape, generator=generator)
    slope = torch.rand(64, generator=generator)  # one PReLU, saved wherever it is used
    return {key: slope if value.shape == (64,) and ".weight" in key else value for key, value in state.items()}


def test_the_published_network_has_2_8_million_parameters_and_loads(tmp_path: Path) -> None:
    model = CycleISPDenoiser()
    assert sum(p.numel() for p in model.parameters()) == pytest.approx(2.84e6, rel=0.01)
    state = published(model)
    assert "module.body.3.body.7.CA.conv_du.2.bias" in state and "module.tail.0.bias" in state
    torch.save({"epoch": 1, "state_dict": state}, tmp_path / "sidd.pth")
    loaded = CycleISPDenoiser.from_published(tmp_path / "sidd.pth")
    assert torch.equal(loaded.trunk.head.weight, state["module.head.0.weight"])
    assert torch.equal(
        loaded.trunk.get_parameter("body.0.body.0.merge.bias"), state["module.body.0.body.0.conv1x1.bias"]
    )
    noisy, variance = torch.rand(1, 4, 6, 8), torch.full((1, 4, 6, 8), 1e-3)
    with torch.no_grad():
        given = torch.cat([noisy, variance], dim=1)  # the variance itself, not its root
        expected = noisy + loaded.trunk.tail(loaded.trunk.body(loaded.trunk.head(given)))  # type: ignore[operator]
        torch.testing.assert_close(loaded(noisy, variance), expected)
        assert not torch.equal(expected, noisy)
    denoisers.save(loaded, tmp_path / "own.safetensors", {})
    again, _ = denoisers.load(tmp_path / "own.safetensors")
    with torch.no_grad():
        torch.testing.assert_close(again(noisy, variance), loaded(noisy, variance))


class Payload:
    """What a pickle could carry."""


def test_other_checkpoints_are_refused(tmp_path: Path) -> None:
    torch.save({"state_dict": {"head": Payload()}}, tmp_path / "code.pth")
    with pytest.raises(ValueError, match="not a checkpoint of plain weights"):
        CycleISPDenoiser.from_published(tmp_path / "code.pth")
    torch.save({"state_dict": {"head.0.bias": torch.zeros(64)}}, tmp_path / "part.pth")
    with pytest.raises(ValueError, match=r"part\.pth: layer \S+ is missing for the denoiser of this size"):
        CycleISPDenoiser.from_published(tmp_path / "part.pth")
    with pytest.raises(ValueError, match="groups, blocks and reduction must be at least 1"):
        CycleISPDenoiser(groups=0)
