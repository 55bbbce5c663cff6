"""rawaug evaluate: damaged weights end it in one line."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from torch import nn

import denoisers
from rawaug import DictionaryISP


def absurd(network: nn.Module) -> None:
    """Weights that are finite and make results that are not."""
    for weights in network.parameters():
        weights.data.fill_(3e38)


def isp(file: Path) -> None:
    model = DictionaryISP.from_pretrained("canon-powershot")
    absurd(model.get_submodule("stages"))
    model.save(file)


def denoiser(file: Path) -> None:
    model = denoisers.UNet(width=4, scales=2)
    absurd(model)
    denoisers.save(model, file, {"cfa": "RGGB"})


@pytest.mark.parametrize("made", [isp, denoiser])
def test_the_first_result_that_is_not_finite_ends_it(
    made: Callable[[Path], None], tmp_path: Path, refused: Callable[..., str]
) -> None:
    file = tmp_path / "absurd.safetensors"
    made(file)
    said = refused("evaluate", file, "--data", "demo:test", "--quiet")
    assert "test_00_coffee: the result is not finite" in said
