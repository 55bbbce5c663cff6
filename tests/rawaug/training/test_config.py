"""What weights depend on: nothing that only changes how fast, where or how safely they are found."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Any

import pytest

from rawaug.training.config import SAME_WEIGHTS, TrainConfig

OTHER: dict[str, Any] = {
    "schedule": "step", "loss": "l2", "weigh": "mixed", "precision": "bf16-mixed", "channels_last": False,
    "compile": True, "ema": 0.5, "start_share": 0.5, "learning_rate": 1e-3, "clip_norm": 1.0, "logger": "csv",
}  # fmt: skip


@pytest.mark.parametrize("key", [field.name for field in fields(TrainConfig)])
def test_a_key_counts_unless_it_leaves_the_weights_as_they_are(key: str) -> None:
    config = TrainConfig()
    other: dict[str, Any] = {key: OTHER.get(key, getattr(config, key) + 2 if key not in OTHER else None)}
    before, after = (c.weights_settings(validated=True) for c in (config, replace(config, **other)))
    assert (before == after) == (key in {"workers", "compile", "checkpoint_every", "logger"}) == (key in SAME_WEIGHTS)


def test_looks_count_where_they_choose_the_weights() -> None:
    often, rarely = TrainConfig(validate_every=10), TrainConfig(validate_every=100)
    for validated in (False, True):
        same = often.weights_settings(validated) == rarely.weights_settings(validated)
        assert same != validated
