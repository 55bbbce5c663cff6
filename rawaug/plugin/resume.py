"""How a loader keeps its order, so that it can go on after a break.

:class:`KeptOrder` keeps what a pass visits, in order: each request is an index with its epoch and occurrence
(:mod:`rawaug.plugin.epochs`). :class:`Numbered` answers requests, whatever datasets lie in between (Subset,
ConcatDataset, or one's own).
"""

from __future__ import annotations

import copy
import math
import operator
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence, Sized
from typing import Any

import torch
from torch import Tensor
from torch.utils.data import (
    BatchSampler,
    DataLoader,
    Dataset,
    DistributedSampler,
    IterableDataset,
    RandomSampler,
    SequentialSampler,
)

from rawaug.plugin.epochs import answering
from rawaug.seeding import rank_key, world_size

_MOST_PARTS = 512
"""Longer lists are data, not parts of a dataset."""


class KeptOrder:
    """A sampler in place of a DataLoader's own, which keeps what a pass visits, and numbers what comes again.

    It yields requests (index, epoch, occurrence, rank) for :class:`Numbered`, or batches of them.

    The processes of a distributed run share one order if a ``DistributedSampler`` deals it, or if they go on with the
    order of a single process: of what is left, process r of W takes every W-th from the r-th on. Any other sampler
    has an order of its own in each process, and there the draws are keyed by the rank, too.

    Args:
        loader: a DataLoader whose sampler has a length.
    """

    def __init__(self, loader: DataLoader[Any]) -> None:
        self.sampler: Any = loader.sampler
        self.batch_size, self.drop_last = loader.batch_size, loader.drop_last
        batches: Any = loader.batch_sampler
        self.has_batches = batches is not None and not _is(batches, BatchSampler)
        if self.has_batches:
            self.sampler, self.batch_size = batches, None
        elif batches is not None:
            self.sampler, self.batch_size, self.drop_last = batches.sampler, batches.batch_size, batches.drop_last

        self.epoch = 0
        self.order: list[Any] = []
        """What the current pass visits, in all processes that share it: indices, or batches of them."""
        self._first = 0
        self._next: tuple[list[Any], int] | None = None
        self._generator: tuple[torch.Generator, Tensor] | None = None

    @property
    def is_shared(self) -> bool:
        """Whether the order is that of all processes."""
        return not self.has_batches and (world_size() == 1 or type(self.sampler) is DistributedSampler)

    @property
    def _share(self) -> tuple[int, int]:
        """The number of this process and the number of processes among which the order is dealt."""
        if type(self.sampler) is DistributedSampler:
            return self.sampler.rank, self.sampler.num_replicas
        return 0, 1

    def __len__(self) -> int:
        return math.ceil(len(self.sampler) / (self.batch_size or 1))

    def __iter__(self) -> Iterator[Any]:
        if self._generator is not None:
            generator, state = self._generator
            generator.set_state(state)

        order, first = self._next or (None, 0)
        self.start_anew()
        self.order, self._first = self._draw() if order is None else order, first

        requests = self._requests()
        if self.has_batches or self.batch_size is None:
            yield from requests
            return

        batch = []
        for request in requests:
            batch.append(request)
            if len(batch) == self.batch_size:
                yield batch
                batch = []
        if batch and not self.drop_last:
            yield batch

    def _draw(self) -> list[Any]:
        """Draw the order of a pass; for a DistributedSampler, the order that it deals to all processes."""
        if type(self.sampler) is not DistributedSampler:
            return list(self.sampler)

        sampler = copy.copy(self.sampler)
        sampler.rank, sampler.num_replicas, sampler.num_samples = 0, 1, self.sampler.total_size
        return list(sampler)

    def _requests(self) -> Iterator[Any]:
        """Go through the order, and number this process's part of it."""
        rank, processes = self._share
        own_rank = () if self.is_shared else rank_key()
        epoch = self.epoch

        seen: Counter[Any] = Counter()
        for position, entry in enumerate(self.order):
            requests = []
            for index in entry if self.has_batches else [entry]:
                index = _as_number(index)
                requests.append((index, epoch, seen[index], own_rank))
                seen[index] += 1

            if position >= self._first and (position - self._first) % processes == rank:
                yield requests if self.has_batches else requests[0]

    def visited(self, batches: int) -> int:
        """The number of entries of the order that all processes have visited after ``batches`` more of this one."""
        entries = batches * (self.batch_size or 1)
        return min(self._first + entries * self._share[1], len(self.order))

    def start_anew(self) -> None:
        """Let the next pass draw its own order, from its first entry on."""
        self._next = self._generator = None

    def go_on(self, order: Sequence[Any], first: int) -> None:
        """Let the next pass go on with entry ``first`` of the order of an earlier one.

        What is left is dealt anew if it cannot be divided by the number of processes: the last ones are left out with
        ``drop_last``, else some are visited twice, as DistributedSampler does.
        """
        order, processes = list(order), self._share[1]
        remaining = len(order) - first
        if self.drop_last:
            order = order[: first + remaining // processes * processes]
        else:
            extra = -remaining % processes
            order += (order[first:] * extra)[:extra]
        self.start_anew()
        self._next = order, first

    def draw_from(self, generator: torch.Generator, state: Tensor) -> None:
        """Let the next pass draw its order from a generator in this state, whatever else is drawn before."""
        self._generator = generator, state


def _is(sampler: Any, kind: type) -> bool:
    """Whether a sampler is exactly PyTorch's, or torchdata's of the same name."""
    if type(sampler).__module__.startswith("torchdata."):
        return isinstance(sampler, kind)
    return type(sampler) is kind


def _as_number(index: Any) -> Any:
    """An index as an int, if it is a whole number of any type."""
    try:
        return operator.index(index)
    except TypeError:
        return index


class Numbered(Dataset[Any]):
    """The dataset of a loader whose order is kept; it answers requests, and everything else is the dataset's own."""

    def __init__(self, dataset: Any) -> None:
        self.__dict__["dataset"] = dataset

    def __len__(self) -> int:
        return len(self.dataset)

    def __getitem__(self, request: Any) -> Any:
        with answering([request]):
            return self.dataset[request[0]]

    def __getitems__(self, requests: Sequence[Any]) -> list[Any]:
        if not hasattr(self.dataset, "__getitems__"):
            return [self[request] for request in requests]

        with answering(requests):
            samples: list[Any] = self.dataset.__getitems__([request[0] for request in requests])
            return samples

    def __getattr__(self, name: str) -> Any:
        if "dataset" not in self.__dict__:
            raise AttributeError(name)
        return getattr(self.dataset, name)

    def __setattr__(self, name: str, value: Any) -> None:
        setattr(self.dataset, name, value)  # as a worker_init_fn may do

    def __reduce__(self) -> Any:
        return Numbered, (self.dataset,)


def keep_order(loader: Any) -> tuple[Any, KeptOrder | None]:
    """Make a copy of a DataLoader whose order is kept.

    Args:
        loader: any loader.

    Returns:
        The copy and its order. Or the loader itself and None if it is no DataLoader, iterates in a way of its own, goes
        through an iterable dataset, or has a sampler without a length.
    """
    if not isinstance(loader, DataLoader) or isinstance(loader.dataset, IterableDataset):
        return loader, None
    is_plain = type(loader).__iter__ is DataLoader.__iter__ or type(loader).__module__.startswith("torchdata.")
    if not is_plain or not _has_length(loader.sampler if loader.batch_sampler is None else loader.batch_sampler):
        return loader, None

    order = KeptOrder(loader)
    name = "sampler" if loader.batch_sampler is None else "batch_sampler"
    return _copy_loader(loader, dataset=Numbered(loader.dataset), **{name: order}), order


def _has_length(sampler: Any) -> bool:
    try:
        return isinstance(sampler, Sized) and len(sampler) >= 0
    except TypeError:  # raised by a batch sampler over one without a length
        return False


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
    return _copy_loader(loader, sampler=sampler, batch_sampler=batches)


def _has_own_order(loader: DataLoader[Any]) -> bool:
    """Whether the sampler is the one that the loader made from ``shuffle``."""
    sampler: Any = loader.sampler
    batches: Any = loader.batch_sampler
    if isinstance(loader.dataset, IterableDataset):
        return False
    if batches is not None and (not _is(batches, BatchSampler) or batches.sampler is not sampler):
        return False
    if _is(sampler, RandomSampler):
        return not sampler.replacement and sampler.num_samples == len(sampler.data_source)
    return type(sampler) is SequentialSampler


def _copy_loader(loader: DataLoader[Any], **parts: Any) -> DataLoader[Any]:
    """Copy a DataLoader with other parts, and with its own workers."""
    copied = copy.copy(loader)
    for name, part in {**parts, "_iterator": None}.items():
        object.__setattr__(copied, name, part)  # a DataLoader forbids this after its construction
    return copied


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

    indices = list(map(_as_number, indices))
    is_batched = len(sizes) == len(order)
    if not all(isinstance(index, int) for index in indices) or (sizes and not is_batched):
        return {"order": list(order)}
    return {
        "indices": torch.tensor(indices, dtype=torch.int64),
        "sizes": torch.tensor(sizes, dtype=torch.int64),
    }


def unpack_order(packed: Mapping[str, Any]) -> list[Any]:
    """Read the order that :func:`pack_order` has packed."""
    if "order" in packed:
        return list(packed["order"])

    indices, sizes = packed["indices"], packed["sizes"]
    if not len(sizes):
        return list(indices.tolist())
    return [batch.tolist() for batch in indices.split(sizes.tolist())]


def numbering(dataset: Any) -> list[Any]:
    """The outermost datasets with ``set_epoch`` in a dataset: itself, or those in its attributes and lists."""
    datasets: list[Any] = []
    seen: set[int] = set()
    pending = [dataset]
    while pending:
        part = pending.pop(0)
        if isinstance(part, (list, tuple)) and len(part) <= _MOST_PARTS:
            pending += [entry for entry in part if isinstance(entry, Dataset)]
        if not isinstance(part, Dataset) or id(part) in seen:
            continue

        seen.add(id(part))
        if hasattr(part, "set_epoch"):
            datasets.append(part)
        else:
            pending += vars(part).values()
    return datasets
