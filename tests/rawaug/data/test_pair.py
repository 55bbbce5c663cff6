from __future__ import annotations

import dataclasses
from typing import Any

import pytest
import torch

from rawaug.bayer import CFA
from rawaug.data import Pair


def pair(**changes: Any) -> Pair:
    fields: dict[str, Any] = {
        "name": "shot",
        "srgb": torch.zeros(3, 6, 8, dtype=torch.uint8),
        "raw": torch.zeros(1, 6, 8),
        "cfa": CFA.RGGB,
        "white_balance": (2.0, 1.0, 1.5),
        "color_matrix": torch.eye(3),
    }
    return Pair(**{**fields, **changes})


def test_a_pair_holds_what_it_was_given() -> None:
    noisy = torch.ones(1, 6, 8)
    shot = pair(noisy=noisy, shot_var=1e-3, read_var=1e-6)
    assert shot.noisy is noisy and shot.registered and shot.camera == "unknown"
    assert pair().noisy is None
    with pytest.raises(dataclasses.FrozenInstanceError):
        shot.name = "other"  # type: ignore[misc]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"srgb": torch.zeros(3, 6, 8)},
            r"pair shot: srgb must be torch.uint8 \(3, 6, 8\), got torch.float32 \(3, 6, 8\)",
        ),
        ({"srgb": torch.zeros(3, 6, 6, dtype=torch.uint8)}, r"srgb must be .*got torch.uint8 \(3, 6, 6\)"),
        ({"raw": torch.zeros(1, 6, 8, dtype=torch.float64)}, r"raw must be torch.float32"),
        ({"raw": torch.zeros(6, 8)}, r"pair shot: raw must be torch.float32"),
        ({"noisy": torch.zeros(1, 6, 6)}, r"noisy must be torch.float32 \(1, 6, 8\)"),
        ({"srgb": torch.zeros(3, 5, 8, dtype=torch.uint8), "raw": torch.zeros(1, 5, 8)}, "even sides"),
        ({"color_matrix": torch.eye(4)}, r"color_matrix must be \(3, 3\)"),
        ({"shot_var": 1e-3, "read_var": 1e-6}, "must be given together, with a noisy mosaic"),
        ({"shot_var": 1e-3, "noisy": torch.zeros(1, 6, 8)}, "must be given together"),
    ],
)
def test_what_does_not_fit_is_refused_in_one_line(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message) as caught:
        pair(**changes)
    assert "\n" not in str(caught.value)
