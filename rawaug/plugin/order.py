"""The order in which a DataLoader visits its pictures: a process's share of it, and the rest of a pass.

A DataLoader draws its order when a pass begins, from its own generator or from the global state, and a pool of workers
that is used again draws one number less from it than a new one. So the order of a pass is kept with the state: a pass
that goes on after a break follows it, and the batches that were seen are not loaded again.
"""

from __future__ import annotations

import copy
from collections.abc import Iterator, Sequence, Sized
from typing import Any

import torch
from torch import Tensor
from torch.utils.data import (
    BatchSampler,
    DataLoader,
    DistributedSampler,
    IterableDataset,
    RandomSampler,
    SequentialSampler,
)


def world_size() -> int:
    """The number of processes of a distributed run; 1 without one."""
    if not torch.distributed.is_available() or not torch.distributed.is_initialized():
        return 1
    return torch.distributed.get_world_size()


class KeptOrder:
    """A sampler in place of a loader's own, which keeps the indices that it yields.

    Args:
        sampler: a sampler of indices, or of batches of them.
    """

    def __init__(self, sampler: Any) -> None:
        self.sampler = sampler
        self.current: list[Any] | None = None
        """What the current pass visits, in order; None before the first pass."""
        self._next: list[Any] | None = None
        self._first = 0
        self._generator: tuple[torch.Generator, Tensor] | None = None

    def __len__(self) -> int:
        return len(self.sampler)

    def __iter__(self) -> Iterator[Any]:
        if self._generator is not None:
            generator, state = self._generator
            generator.set_state(state)

        order, first = self._next, self._first
        self.start_at(0)
        self.current = list(self.sampler) if order is None else order
        yield from self.current[first:]

    def start_at(self, batch: int, order: list[Any] | None = None) -> None:
        """Let the next pass begin at a batch, in the order of an earlier pass if one is given."""
        self._next, self._first, self._generator = order, batch, None

    def draw_from(self, generator: torch.Generator, state: Tensor) -> None:
        """Let the next pass draw its order from a generator in this state, whatever else is drawn before."""
        self._generator = generator, state


def keep_order(loader: Any) -> tuple[Any, KeptOrder | None]:
    """Make a copy of a DataLoader whose order is kept.

    Args:
        loader: any loader.

    Returns:
        The copy and its order. Or the loader itself and None if it resumes by itself, is no DataLoader, goes through an
        iterable dataset, or has a sampler without a length.
    """
    if not isinstance(loader, DataLoader) or hasattr(loader, "load_state_dict"):
        return loader, None

    name = "sampler" if loader.batch_sampler is None else "batch_sampler"
    sampler = getattr(loader, name)
    if isinstance(loader.dataset, IterableDataset) or not _has_length(sampler):
        return loader, None

    order = KeptOrder(sampler)
    return _with_samplers(loader, **{name: order}), order


def _has_length(sampler: Any) -> bool:
    try:
        return isinstance(sampler, Sized) and len(sampler) >= 0
    except TypeError:  # raised by a batch sampler over one without a length
        return False


def is_drawn(sampler: Any) -> bool:
    """Whether a sampler draws its order when a pass begins, instead of taking it from the epoch."""
    inner = sampler.sampler if isinstance(sampler, BatchSampler) else sampler
    return not isinstance(inner, (SequentialSampler, DistributedSampler, range, list, tuple, Tensor))


def pack_order(order: Sequence[Any]) -> dict[str, Any]:
    """Pack an order into tensors, if it consists of whole numbers or batches of them, to be kept with a state."""
    indices: list[Any] = []
    sizes = []
    for entry in order:
        if isinstance(entry, (list, tuple)):
            indices += entry
            sizes.append(len(entry))
        else:
            indices.append(entry)

    is_batched = len(sizes) == len(order)
    if not all(isinstance(index, int) for index in indices) or (sizes and not is_batched):
        return {"order": list(order)}
    return {
        "indices": torch.tensor(indices, dtype=torch.int64),
        "sizes": torch.tensor(sizes, dtype=torch.int64),
    }


def unpack_order(packed: dict[str, Any]) -> list[Any]:
    """Read the order that :func:`pack_order` has packed."""
    if "order" in packed:
        return list(packed["order"])

    indices, sizes = packed["indices"], packed["sizes"]
    if not len(sizes):
        return list(indices.tolist())
    return [batch.tolist() for batch in indices.split(sizes.tolist())]


def own_share(loader: Any, seed: int) -> Any:
    """Divide a DataLoader between the processes of a distributed run.

    Lightning and Fabric divide only a DataLoader, and a wrapped one is not a DataLoader.

    Args:
        loader: a DataLoader whose order comes from its ``shuffle``.
        seed: seed of the order, the same in all processes.

    Returns:
        A loader over this process's pictures. Or ``loader`` itself in a single process, if the user chose its sampler,
        or if it is no DataLoader.
    """
    if world_size() == 1 or not isinstance(loader, DataLoader) or not _has_own_order(loader):
        return loader

    dataset: Any = loader.dataset
    sampler: DistributedSampler[Any] = DistributedSampler(
        dataset, shuffle=isinstance(loader.sampler, RandomSampler), seed=seed, drop_last=loader.drop_last
    )
    batches = None
    if loader.batch_size is not None:
        batches = BatchSampler(sampler, loader.batch_size, loader.drop_last)
    return _with_samplers(loader, sampler=sampler, batch_sampler=batches)


def _with_samplers(loader: DataLoader[Any], **samplers: Any) -> DataLoader[Any]:
    """Copy a DataLoader with other samplers, and with its own workers."""
    other = copy.copy(loader)
    for name, sampler in samplers.items():
        object.__setattr__(other, name, sampler)  # a DataLoader forbids this after its construction
    object.__setattr__(other, "_iterator", None)
    return other


def _has_own_order(loader: DataLoader[Any]) -> bool:
    """Whether the sampler is the one that the loader made from ``shuffle``."""
    sampler, batches = loader.sampler, loader.batch_sampler
    if batches is not None and (type(batches) is not BatchSampler or batches.sampler is not sampler):
        return False
    if type(sampler) is RandomSampler:
        return not sampler.replacement and sampler.num_samples == len(sampler.data_source)
    return type(sampler) is SequentialSampler
