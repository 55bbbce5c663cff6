"""What a call asks of a GPU, counted without one: operations and kernels, copies to the device, and waits for it.

Tensors of the device are CPU tensors in disguise. What touches one is an operation on the device, and counts as a
launch unless it is a view or leaves memory empty; so does a Triton kernel, which is not run. What works on plain CPU
tensors is the host's and costs no launch. Reading a value back, or a copy that the host waits for, is an error.
"""

from __future__ import annotations

from contextlib import nullcontext
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves, tree_map

from rawaug import kernels
from rawaug.plugin.augment import RawAugment
from rawaug.plugin.draw import Draw
from rawaug.plugin.finishing import Finish
from rawaug.plugin.targets import Burst, Srgb

pytest.importorskip("triton", reason="without Triton every pass is many operations")

VIEWS = {
    "_reshape_alias", "_unsafe_view", "alias", "as_strided", "detach", "diagonal", "expand", "permute", "reshape",
    "select", "slice", "split", "split_with_sizes", "squeeze", "t", "transpose", "unbind", "unfold", "unsqueeze",
    "view", "empty", "empty_like", "empty_strided", "new_empty", "new_empty_strided",
}  # fmt: skip
WAITS = {"_local_scalar_dense", "nonzero", "masked_select", "_unique2", "equal", "is_nonzero"}


class OnDevice(Tensor):
    """A tensor that says it is on a GPU, or, to PyTorch's own code, on ``meta``; its values are on the CPU."""

    content: Tensor

    @staticmethod
    def __new__(cls, values: Tensor) -> OnDevice:
        disguised: OnDevice = Tensor._make_wrapper_subclass(
            cls, values.shape, strides=values.stride(), dtype=values.dtype, device=torch.device("meta")
        )
        disguised.content = values
        return disguised

    @property
    def device(self) -> torch.device:  # type: ignore[override]
        return torch.device("cuda", 0)

    @classmethod
    def __torch_dispatch__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:  # type: ignore[override]
        with Launches():
            return func(*args, **(kwargs or {}))


class Launches(TorchDispatchMode):
    """Counts what would be launched on the device, and the copies to it among them."""

    def __init__(self) -> None:
        super().__init__()
        self.count = self.crossings = 0

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = dict(kwargs or {})
        name = func.overloadpacket.__name__
        if name in ("pin_memory", "_pin_memory"):  # needs a GPU
            return args[0].clone()

        disguised = [leaf for leaf in tree_leaves((args, kwargs)) if isinstance(leaf, OnDevice)]
        device = kwargs.get("device")
        is_there = device.type != "cpu" if device is not None else bool(disguised)
        if disguised and not is_there:
            raise AssertionError(f"{name} copies from the device, and waits for it")
        if is_there and not disguised and name == "_to_copy":
            assert kwargs.get("non_blocking"), "the host waits for a copy to the device"
            self.crossings += 1
        if is_there and name not in VIEWS:
            assert name not in WAITS and not _looks_up_by_mask(name, args), f"{name} waits for the device"
            self.count += 1

        if device is not None:
            kwargs["device"] = torch.device("cpu")
        out = func(*tree_map(_reveal, args), **tree_map(_reveal, kwargs))
        if not is_there:
            return out
        known = {id(leaf.content): leaf for leaf in disguised}
        return tree_map(lambda leaf: known[id(leaf)] if id(leaf) in known else _disguise(leaf), out)


def _looks_up_by_mask(name: str, args: Any) -> bool:
    """Whether an index is made of booleans, whose number only the device knows."""
    if name not in ("index", "index_put", "index_put_"):
        return False
    return any(isinstance(index, Tensor) and index.dtype in (torch.bool, torch.uint8) for index in args[1])


def _disguise(leaf: Any) -> Any:
    return OnDevice(leaf) if isinstance(leaf, Tensor) else leaf


def _reveal(leaf: Any) -> Any:
    return leaf.content if isinstance(leaf, OnDevice) else leaf


@pytest.fixture
def counted(monkeypatch: pytest.MonkeyPatch) -> Launches:
    """A counter of launches, Triton's kernels included, which then do nothing."""
    from triton.runtime.jit import JITFunction

    from rawaug.kernels import gpu, gpu_srgb

    launches = Launches()

    class Kernel:
        def __getitem__(self, grid: Any) -> Any:
            return self.launch

        def launch(self, *args: Any, **settings: Any) -> None:
            tensors = [arg for arg in args if isinstance(arg, Tensor)]
            assert tensors and all(isinstance(tensor, OnDevice) for tensor in tensors), "a kernel reads from the host"
            launches.count += 1

    monkeypatch.setattr(torch.cuda, "_lazy_init", lambda: None)
    monkeypatch.setattr(torch.cuda, "device_of", lambda tensor: nullcontext())
    monkeypatch.setattr(kernels, "_failed", [])
    for module in (gpu, gpu_srgb):
        for name, value in list(vars(module).items()):
            if isinstance(value, JITFunction):
                monkeypatch.setattr(module, name, Kernel())
    return launches


def on_device(augment: RawAugment) -> RawAugment:
    for module in augment.modules():
        for name, buffer in module._buffers.items():
            if buffer is not None:
                module._buffers[name] = OnDevice(buffer)
    return augment


def count(augment: RawAugment, batch: int, counted: Launches, dtype: torch.dtype = torch.uint8) -> tuple[int, int]:
    """Launches and, among them, copies to the device of one call."""
    srgb = torch.randint(256, (batch, 3, 32, 32), generator=torch.Generator().manual_seed(0), dtype=torch.uint8)
    if dtype != torch.uint8:
        srgb = srgb / 255.0
    pictures, generator = OnDevice(srgb), torch.Generator().manual_seed(1)

    counted.count = counted.crossings = 0
    with counted:
        params = augment.sample(pictures, generator)
        assert counted.count == 0, "drawing is the host's alone"
        pair = augment.apply(pictures, params)
    assert not kernels._failed
    assert all(isinstance(tensor, OnDevice) for tensor in pair[:3])
    return counted.count, counted.crossings


SETTINGS: list[tuple[dict[str, Any], int, int]] = [
    ({}, 2, 1),
    ({"draw": Draw(blur=(0.2, 0.9))}, 2, 1),
    ({"noise": "any camera"}, 16, 4),
    ({"target": "rgb"}, 2, 1),
    ({"burst": Burst(4)}, 18, 5),
    ({"target": "srgb"}, 20, 2),
    ({"target": Srgb(finish=Finish(unfinished=0.3))}, 120, 8),
    ({"target": Srgb(shots=1)}, 48, 4),
]
"""Settings, the most launches of a call, and the most copies to the device among them."""


@pytest.mark.parametrize(("settings", "most", "copies"), SETTINGS)
def test_launches_are_few_and_do_not_grow_with_the_batch(
    settings: dict[str, Any], most: int, copies: int, counted: Launches
) -> None:
    augment = on_device(RawAugment.from_pretrained("universal", **settings))
    count(augment, 1, counted)  # constants cross once in a process
    few, many = count(augment, 4, counted), count(augment, 16, counted)
    print(settings, few, many)
    assert many == few
    assert few[0] <= most and few[1] <= copies


def test_the_count_sees_what_a_loop_launches_and_what_waits(counted: Launches) -> None:
    there = OnDevice(torch.ones(3, 2))
    with counted:
        for row in there:
            row.mul_(2.0).add_(torch.zeros((), device=there.device))
        assert counted.count == 9 and torch.equal(there.content, torch.full((3, 2), 2.0))
        for wait in (lambda: there.sum().item(), lambda: there[there > 0], lambda: there.cpu()):
            with pytest.raises(AssertionError, match="device"):
                wait()
        with pytest.raises(AssertionError, match="waits"):
            torch.ones(2).to(there.device)
