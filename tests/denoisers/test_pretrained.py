"""Shipped denoisers: found by name or path, each with a card that has every field and the file's hash."""

from __future__ import annotations

import hashlib
from pathlib import Path

import pytest
import torch

from denoisers import UNet, from_pretrained, save
from denoisers import files as pretrained

FIELDS = (
    "Licence",
    "Architecture",
    "Training data",
    "Command",
    "Commit",
    "Seed",
    "SHA-256",
    "Noise",
    "Measured",
    "Not good for",
)
"""Rows of the card, as the template in docs/model_card.md has them."""

ROOT = Path(__file__).parents[2]


def test_a_name_or_a_path_gives_the_network(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pretrained, "FOLDER", tmp_path)
    model = UNet(width=4, scales=2, seed=3)
    save(model, tmp_path / "tiny.safetensors", {})
    for name in ("tiny", tmp_path / "tiny.safetensors"):
        loaded = from_pretrained(name)
        assert not loaded.training
        assert all(torch.equal(a, b) for a, b in zip(loaded.parameters(), model.parameters(), strict=True))
    with pytest.raises(FileNotFoundError, match=r"huge: no such denoiser; give .* a shipped one \(tiny\)"):
        from_pretrained("huge")


@pytest.mark.parametrize("name", pretrained.shipped())
def test_every_shipped_denoiser_has_its_card(name: str) -> None:
    weights = pretrained.FOLDER / f"{name}.safetensors"
    card = weights.with_suffix(".md").read_text(encoding="utf-8")
    assert [field for field in FIELDS if f"| {field} |" not in card] == []
    assert hashlib.sha256(weights.read_bytes()).hexdigest() in card
    assert weights.stat().st_size < 6e6 or name != pretrained.DEFAULT
    assert "TODO" not in card


def test_the_template_has_every_field() -> None:
    template = (ROOT / "docs/model_card.md").read_text(encoding="utf-8")
    assert [field for field in FIELDS if f"| {field} |" not in template] == []
