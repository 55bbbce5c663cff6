"""What weights depend on: nothing that only changes how fast, where or how safely they are found."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Any

import pytest

from rawaug.training.config import SAME_WEIGHTS, DenoiserConfig, TrainConfig, weights_key

OTHER: dict[str, Any] = {
    "schedule": "step", "loss": "l2", "weigh": "mixed", "precision": "bf16-mixed", "channels_last": False,
    "compile": True, "ema": 0.5, "start_share": 0.5, "learning_rate": 1e-3, "clip_norm": 1.0, "logger": "csv",
}  # fmt: skip


@pytest.mark.parametrize("key", [field.name for field in fields(TrainConfig)])
def test_a_key_counts_unless_it_leaves_the_weights_as_they_are(key: str) -> None:
    config = TrainConfig()
    other: dict[str, Any] = {key: OTHER.get(key, getattr(config, key) + 2 if key not in OTHER else None)}
    changed = replace(config, **other)
    before, after = (weights_key(DenoiserConfig(), c, "samples", "validation") for c in (config, changed))
    assert (before == after) == (key in {"workers", "compile", "checkpoint_every", "logger"}) == (key in SAME_WEIGHTS)


def test_looks_count_where_they_choose_the_weights() -> None:
    often, rarely = TrainConfig(validate_every=10), TrainConfig(validate_every=100)
    for validation, same in ((None, True), (["frame"], False)):
        keys = {weights_key(DenoiserConfig(), config, "samples", validation) for config in (often, rarely)}
        assert (len(keys) == 1) == same


def test_network_samples_and_validation_count() -> None:
    known = (DenoiserConfig(), TrainConfig(), "samples", None)
    others = [(DenoiserConfig("DnCNN"), *known[1:]), (*known[:2], "more", None), (*known[:3], "frames")]
    assert len({weights_key(*arguments) for arguments in (known, *others)}) == 4
