"""Which draw a sample is, and how a loader goes on after a break.

A draw is keyed by (seed, epoch, index, occurrence): the occurrence says how often the index came before in its epoch,
as it does with samplers that draw with replacement. There are two ways to know epoch and occurrence:

- In a loader that :mod:`rawaug.plugin.loader` has made resumable, they travel with the index: :class:`KeptOrder` keeps
  what a pass visits, in order, and :class:`Numbered` answers its requests, whatever datasets lie in between (Subset,
  ConcatDataset, or one's own).
- Elsewhere draws are counted where they are made, since a DataLoader does not tell its Dataset that a new pass begins.
  For a picture with an index, the epoch is the number of earlier visits of this picture (:class:`Visits`): in a pass
  that visits every picture once, visit k is epoch k, however many workers share the pass. For a stream, it is the
  number of earlier passes, which each worker counts for itself (:class:`Passes`).

The counts lie in shared memory, where workers of every start method find them, persistent ones too. A cell is written
only by the worker that has the picture, so no lock is needed. ``pin`` states the epoch, in which the counts are then
the occurrences; ``freeze`` makes a draw a pure function of (seed, index).
"""

from __future__ import annotations

import copy
import math
import operator
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence, Sized
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any, SupportsIndex

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
    get_worker_info,
)

from rawaug.errors import count_of
from rawaug.seeding import rank_key

_COUNTED = -1
"""The value that stands for "not pinned"."""
_MAX_WORKERS = 512

_BROKEN_OFF = (
    "the state is of the middle of a pass whose workers had fetched more pictures than were used, so it cannot go on "
    "exactly; resume by rawaug.resumable(loader), by numbering the epochs with set_epoch, or begin the next epoch "
    "with load_state_dict(state, next_epoch=True)"
)


def world_size() -> int:
    """The number of processes of a distributed run; 1 without one."""
    if not torch.distributed.is_available() or not torch.distributed.is_initialized():
        return 1
    return torch.distributed.get_world_size()


def require_epoch(epoch: SupportsIndex) -> int:
    """Convert an epoch, or the number of a batch, to an int.

    Raises:
        ValueError: if it does not fit the 63 bits of a shared counter.
    """
    if not isinstance(epoch, SupportsIndex) or not 0 <= operator.index(epoch) < 2**63:
        raise ValueError(f"an epoch is an integer from 0 to 2^63 - 1, got {epoch!r}")
    return operator.index(epoch)


# -- a loader whose order is kept -------------------------------------------------------------------------------------


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
        with _answering([request]):
            return self.dataset[request[0]]

    def __getitems__(self, requests: Sequence[Any]) -> list[Any]:
        if not hasattr(self.dataset, "__getitems__"):
            return [self[request] for request in requests]

        with _answering(requests):
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


class _Answer:
    """Requests that a dataset is answering: its n-th draw belongs to the n-th request."""

    def __init__(self, requests: Sequence[Any]) -> None:
        self.requests = requests
        self.draws = 0

    def key(self, number: int) -> tuple[int | str, ...]:
        """The key of the next draw, of picture ``number``."""
        request = min(self.draws, len(self.requests) - 1)
        index, epoch, occurrence, rank = self.requests[request]
        further = self.draws - request  # a dataset may ask for more pairs than one
        self.draws += 1

        if (index, occurrence, further) == (number, 0, 0):
            return (epoch, number, *rank)
        return (epoch, number, *rank, "again", repr(index), occurrence, further)


_answer: ContextVar[_Answer | None] = ContextVar("answer", default=None)


@contextmanager
def _answering(requests: Sequence[Any]) -> Iterator[None]:
    token = _answer.set(_Answer(requests))
    try:
        yield
    finally:
        _answer.reset(token)


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
        if isinstance(part, (list, tuple)) and len(part) <= _MAX_WORKERS:
            pending += [entry for entry in part if isinstance(entry, Dataset)]
        if not isinstance(part, Dataset) or id(part) in seen:
            continue

        seen.add(id(part))
        if hasattr(part, "set_epoch"):
            datasets.append(part)
        else:
            pending += vars(part).values()
    return datasets


# -- draws that are counted -------------------------------------------------------------------------------------------


class _Epochs:
    """Counts in shared memory, with an epoch that may be pinned or frozen instead."""

    def __init__(self, *shape: int) -> None:
        self._pinned = torch.full((1,), _COUNTED).share_memory_()
        self._frozen = torch.zeros(1, dtype=torch.bool).share_memory_()
        self._counts = torch.zeros(shape, dtype=torch.int32).share_memory_()
        self._rank: tuple[int, ...] = ()

    @property
    def pinned(self) -> int | None:
        """The pinned epoch; None while epochs are counted."""
        epoch = int(self._pinned)
        if epoch == _COUNTED:
            return None
        return epoch

    @property
    def frozen(self) -> bool:
        """Whether every pass is the pinned epoch, whatever is pinned later."""
        return bool(self._frozen)

    def pin(self, epoch: int) -> None:
        """Begin an epoch, in the workers too, which lasts until the next call; nothing happens if it is frozen."""
        number = require_epoch(epoch)
        if not self.frozen:
            self._pinned[0] = number

    def freeze(self, epoch: int) -> None:
        """Fix the epoch for good."""
        self._pinned[0] = require_epoch(epoch)
        self._frozen[0] = True

    def rank(self) -> tuple[int, ...]:
        """:func:`rawaug.seeding.rank_key`; the parent's in a spawned worker, which is not in the process group."""
        return rank_key() or self._rank

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_rank": self.rank()}

    def __setstate__(self, state: dict[str, Any]) -> None:
        for name, value in state.items():
            if isinstance(value, Tensor):
                value.share_memory_()  # an unpickled copy is not shared with its own workers; in a worker it is already
            setattr(self, name, value)

    def _resume(self, epoch: int | None) -> None:
        if not self.frozen:
            self._pinned[0] = _COUNTED if epoch is None else require_epoch(epoch)


class Visits(_Epochs):
    """Counts how often each of ``size`` pictures was asked for by its index, in the pinned epoch if there is one.

    A pass that is broken off counts everything that its workers had fetched ahead. A picture that is drawn with
    replacement counts each time, in the order in which workers come to it. Distributed processes share the pictures
    between them, so the key of a counted draw also contains the rank.
    """

    def __init__(self, size: int) -> None:
        super().__init__(size)
        self._in_workers = torch.zeros(1, dtype=torch.bool).share_memory_()
        """Whether workers have counted visits."""
        self._batch = torch.ones(1, dtype=torch.int64).share_memory_()
        """How many pictures are asked for at a time."""

    def pin(self, epoch: int) -> None:
        super().pin(epoch)
        self._counts.zero_()
        self._in_workers[0] = False

    def key(self, index: int) -> tuple[int | str, ...]:
        """Count a visit of picture ``index``, and return the key of its draw: epoch, index, rank, and occurrence."""
        pinned = self.pinned
        if pinned is not None and self.frozen:
            return (pinned, index)

        answer = _answer.get()
        if answer is not None:
            return answer.key(index)
        if index >= len(self._counts):
            pictures = count_of(len(self._counts), "picture")
            raise ValueError(f"the dataset has grown from {pictures}; create RawPairs again")

        if get_worker_info() is not None:
            self._in_workers[0] = True
        visit = int(self._counts[index])
        self._counts[index] = visit + 1
        if pinned is None:
            return (visit, index, *self.rank())
        if visit == 0:
            return (pinned, index)
        return (pinned, index, *self.rank(), "again", visit)

    def fetch(self, batch: int) -> None:
        """Note how many pictures a loader asks for at a time."""
        self._batch[0] = batch

    def state_dict(self) -> dict[str, Any]:
        """The pinned epoch, each picture's visits, and whether the state is exact.

        The processes of a distributed run share one state, so there the visits of each picture are the passes so far.
        In a pinned epoch whose pictures come once, the workers' visits need not be known.
        """
        if self.pinned is None:
            visits = self._shared_by_ranks(self._counts.clone())
            return {"epoch": None, "visits": visits, "exact": not self._runs_ahead(visits)}

        visits = self._counts.clone()
        by_workers = bool(self._in_workers) or get_worker_info() is not None
        comes_again = bool((visits > 1).any())
        if by_workers:
            visits.zero_()
        return {"epoch": self.pinned, "visits": visits, "exact": self.frozen or not (by_workers and comes_again)}

    def load_state_dict(self, state: dict[str, Any], next_epoch: bool = False) -> None:
        """Go on from ``state``.

        Args:
            state: a state from :meth:`state_dict`.
            next_epoch: begin the next epoch if the state is from the middle of a pass.

        Raises:
            ValueError: if the state is for another number of pictures, or is not exact.
        """
        visits = torch.as_tensor(state["visits"])
        if visits.shape != self._counts.shape:
            pictures = count_of(len(visits), "picture")
            raise ValueError(f"the state is that of {pictures}, the dataset has {len(self._counts)}")

        if next_epoch and len(visits):
            visits = torch.full_like(visits, int(visits.max()))
        elif not state.get("exact", True):
            raise ValueError(_BROKEN_OFF)

        self._resume(state["epoch"])
        self._counts.copy_(visits)
        self._in_workers[0] = False

    def _runs_ahead(self, visits: Tensor) -> bool:
        """Whether workers have counted visits of pictures that the training may not have seen yet.

        This cannot be seen if they have fetched all the rest of a pass; such a state is that of the next pass.
        """
        worker = get_worker_info()
        if worker is not None:  # a worker of torchdata's StatefulDataLoader, where each keeps its own state
            return worker.num_workers > 1
        if not bool(self._in_workers) or not len(visits):
            return False

        behind = int((visits < visits.max()).sum())
        return behind >= int(self._batch)  # drop_last leaves out fewer than that

    @staticmethod
    def _shared_by_ranks(visits: Tensor) -> Tensor:
        world = world_size()
        if world == 1 or not len(visits):
            return visits

        share = math.ceil(len(visits) / world)  # a sampler pads the shares if they do not divide evenly
        passes = math.ceil(int(visits.sum()) / share)
        return torch.full_like(visits, max(passes, int(visits.max())))


class Passes(_Epochs):
    """Counts of the passes over a stream, and the sample at which a resumed pass goes on.

    Workers of one pass begin it at different times, so each reads only cells that none of its siblings writes. Worker w
    counts the passes that it has begun, whatever the number of workers, and the first of W workers counts the passes of
    W workers. The passes before a pass of worker w are its own and those of at most w workers, which had no worker w.
    """

    def __init__(self) -> None:
        super().__init__(_MAX_WORKERS)
        self._of_workers = torch.zeros(_MAX_WORKERS + 1, dtype=torch.int32).share_memory_()
        """The passes of W workers that the first of them has begun, indexed by W; 0 is for the main process."""
        self._resumed = torch.tensor([-1, 0]).share_memory_()
        """A pass, and the number of its first sample."""
        self._running: tuple[int, int] | None = None
        """The pass of this process, and the number of the next sample."""

    def begin(self, workers: int, worker: int) -> tuple[int, int]:
        """Count a pass of one of ``workers`` workers, and return its epoch and the number of its first sample."""
        started = self.passes
        if workers:
            started = int(self._counts[worker] + self._of_workers[: worker + 1].sum())
            self._counts[worker] += 1
        if worker == 0:
            self._of_workers[workers] += 1

        start = 0
        resumed, first = self._resumed.tolist()
        if started == resumed:
            start = first
        self._running = (started, start)

        if self.pinned is not None:
            return self.pinned, start
        return started, start

    @property
    def passes(self) -> int:
        """The number of passes that have begun."""
        return int(self._of_workers.sum())

    def at(self, number: int) -> None:
        """Note that sample ``number`` comes next in this process."""
        if self._running is not None:
            self._running = (self._running[0], number)

    def end(self) -> None:
        """Note that the pass of this process is over."""
        self._running = None

    def state_dict(self) -> dict[str, Any]:
        """The pinned epoch, the number of finished passes, and the number of the next sample.

        The main process does not know how far its workers have come in a pass, so with workers the state is that of the
        next pass.
        """
        started, position = self._running or (self.passes, 0)
        return {"epoch": self.pinned, "passes": started, "position": position}

    def load_state_dict(self, state: dict[str, Any], next_epoch: bool = False) -> None:
        """Go on from ``state`` with the next sample of the next pass, or with ``next_epoch`` at the next epoch."""
        passes, position = state["passes"], state["position"]
        if next_epoch and position:
            passes, position = passes + 1, 0

        self._resume(state["epoch"])
        self._counts.zero_()
        self._of_workers.zero_()
        self._of_workers[0] = passes
        self._resumed.copy_(torch.tensor([passes, position]))
        self._running = None
