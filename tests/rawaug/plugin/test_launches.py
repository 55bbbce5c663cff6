"""How many operations a call needs, each of which would launch a kernel on a GPU: views do not count.

The passes of :mod:`rawaug.kernels` are not counted here, as Numba runs them. Nothing may grow with the batch.
"""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode

from rawaug.kernels import runtime
from rawaug.plugin.augment import RawAugment
from rawaug.plugin.targets import Burst, Srgb

VIEWS = {
    "_reshape_alias", "_unsafe_view", "alias", "as_strided", "detach", "diagonal", "expand", "permute", "reshape",
    "select", "slice", "split", "split_with_sizes", "squeeze", "t", "transpose", "unbind", "unfold", "unsqueeze",
    "view", "empty", "empty_like", "empty_strided", "new_empty", "_local_scalar_dense",
}  # fmt: skip


class Launches(TorchDispatchMode):
    """Counts operations that are no views."""

    def __init__(self) -> None:
        super().__init__()
        self.count = 0

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        if func.overloadpacket.__name__ not in VIEWS:
            self.count += 1
        return func(*args, **(kwargs or {}))


def launches(augment: RawAugment, batch: int) -> int:
    srgb = torch.randint(256, (batch, 3, 16, 16), generator=torch.Generator().manual_seed(0), dtype=torch.uint8)
    with Launches() as counted:
        augment(srgb, torch.Generator().manual_seed(1))
    return counted.count


@pytest.mark.skipif(not runtime.has_numba(), reason="without Numba the passes are operations, too")
@pytest.mark.parametrize(
    ("settings", "most"),
    [({}, 100), ({"target": "rgb"}, 160), ({"burst": Burst(4)}, 200), ({"target": "srgb"}, 260)],
)
def test_launches_do_not_grow_with_the_batch(settings: dict[str, Any], most: int) -> None:
    augment = RawAugment.from_pretrained("universal", **settings)
    few, many = launches(augment, 16), launches(augment, 64)
    assert few <= most and many <= few + 5, (few, many)  # a draw is repeated where gains are implausible


@pytest.mark.skipif(not runtime.has_numba(), reason="without Numba the passes are operations, too")
def test_further_shots_do_not_either() -> None:
    augment = RawAugment.from_pretrained("universal", target=Srgb(shots=1))
    assert launches(augment, 64) <= launches(augment, 16) + 20
