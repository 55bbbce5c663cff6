"""Pictures as datasets yield them."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from rawaug.conform import even_sided, to_rgb_tensor


def test_a_float_picture_keeps_its_values() -> None:
    array = np.array([[[0.1, 0.2, 0.3]]], dtype=np.float32)
    assert torch.equal(to_rgb_tensor(array).flatten(), torch.tensor([0.1, 0.2, 0.3]))


def test_a_narrow_tensor_is_read_channels_first() -> None:
    assert to_rgb_tensor(torch.zeros(3, 8, 4)).shape == (3, 8, 4)
    assert to_rgb_tensor(np.zeros((3, 8, 4), np.uint8)).shape == (3, 3, 8)  # HWC with alpha


@pytest.mark.parametrize("bad", [np.zeros((5, 6, 7)), np.zeros((2, 3, 4, 5))])
def test_what_is_no_picture_is_refused(bad: np.ndarray) -> None:
    with pytest.raises(ValueError, match="got shape"):
        to_rgb_tensor(bad)


def test_integers_other_than_bytes_are_refused() -> None:
    with pytest.raises(ValueError, match="int32"):
        to_rgb_tensor(np.zeros((4, 4, 3), np.int32))


def test_odd_sides_lose_a_line() -> None:
    assert even_sided(torch.zeros(3, 5, 8)).shape == (3, 4, 8)
