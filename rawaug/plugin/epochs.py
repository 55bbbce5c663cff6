"""The epoch that a draw belongs to, and a DataLoader's share of a distributed run.

A DataLoader does not tell its Dataset that a new pass begins, so draws are counted where they are made:

- of a picture with an index, the epoch is the number of earlier visits of this picture (:class:`Visits`): in a pass
  that visits every picture once, visit k is epoch k, however many workers share the pass and in whatever order;
- of a stream, it is the number of earlier passes, of which each worker counts its own (:class:`Passes`).

The counts lie in shared memory, where workers of every start method find them, persistent ones too. A cell is written
by the one worker that has the picture, so no lock is needed. ``pin`` replaces the count by a fixed epoch: a draw is
then a pure function of (seed, epoch, index).
"""

from __future__ import annotations

import copy
import math
from operator import index
from typing import Any, SupportsIndex

import torch
from torch import Tensor
from torch.utils.data import BatchSampler, DataLoader, DistributedSampler, RandomSampler, SequentialSampler

from rawaug.seeding import rank_key


def world_size() -> int:
    """The number of processes of a distributed run, 1 without one."""
    distributed = torch.distributed.is_available() and torch.distributed.is_initialized()
    return torch.distributed.get_world_size() if distributed else 1


def own_share(loader: Any, seed: int) -> Any:
    """Divide a DataLoader between the processes of a distributed run.

    Lightning and Fabric divide only a DataLoader, which a wrapped one is not.

    Args:
        loader: a DataLoader whose order comes from its ``shuffle``.
        seed: of the order, the same in all processes.

    Returns:
        A loader over this process's pictures; ``loader`` itself in a single process, where its sampler was chosen by
        the user, and where it is no DataLoader.
    """
    if world_size() == 1 or not isinstance(loader, DataLoader) or not _has_own_order(loader):
        return loader
    shuffle = isinstance(loader.sampler, RandomSampler)
    dataset: Any = loader.dataset
    sampler: DistributedSampler[Any] = DistributedSampler(
        dataset, shuffle=shuffle, seed=seed, drop_last=loader.drop_last
    )
    share = copy.copy(loader)
    batches = BatchSampler(sampler, loader.batch_size, loader.drop_last) if loader.batch_size is not None else None
    # A DataLoader refuses another sampler once it is made; a copy that has no iterator yet may have one.
    share.__dict__.update(sampler=sampler, batch_sampler=batches, _iterator=None)
    return share


def _has_own_order(loader: DataLoader[Any]) -> bool:
    """Whether the sampler is the one that the loader made from ``shuffle``."""
    sampler, batches = loader.sampler, loader.batch_sampler
    if batches is not None and not (type(batches) is BatchSampler and batches.sampler is sampler):
        return False
    if type(sampler) is RandomSampler:
        return not sampler.replacement and sampler.num_samples == len(sampler.data_source)
    return type(sampler) is SequentialSampler


_COUNTED = -1  # in place of a pinned epoch
MAX_WORKERS = 512


def require_epoch(epoch: SupportsIndex) -> int:
    """Convert an epoch, or the number of a batch, to an int.

    Raises:
        ValueError: if it does not fit the 63 bits of a shared counter.
    """
    if not isinstance(epoch, SupportsIndex) or not 0 <= index(epoch) < 2**63:
        raise ValueError(f"an epoch is an integer from 0 to 2^63 - 1, got {epoch!r}")
    return index(epoch)


class _Epochs:
    """Counts in shared memory, and an epoch that may be pinned instead."""

    def __init__(self, *shape: int) -> None:
        self._pinned = torch.full((1,), _COUNTED).share_memory_()
        self._counts = torch.zeros(shape, dtype=torch.int32).share_memory_()
        self._rank: tuple[int, ...] = ()

    @property
    def pinned(self) -> int | None:
        """The pinned epoch, None while epochs are counted."""
        epoch = int(self._pinned)
        return None if epoch == _COUNTED else epoch

    def pin(self, epoch: int) -> None:
        """Fix the epoch, in the workers too, until the next call."""
        self._pinned[0] = require_epoch(epoch)

    def rank(self) -> tuple[int, ...]:
        """:func:`rawaug.seeding.rank_key`; in a spawned worker, which is no part of the process group, the parent's."""
        return rank_key() or self._rank

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_rank": self.rank()}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        for value in state.values():
            if isinstance(value, Tensor):
                value.share_memory_()  # an unpickled copy is not shared with its own workers; in a worker it is already

    def _resume(self, epoch: int | None) -> None:
        self._pinned[0] = _COUNTED if epoch is None else require_epoch(epoch)


class Visits(_Epochs):
    """Counts of how often each of ``size`` pictures was asked for by its index.

    A pass that is broken off counts what its workers had fetched ahead. A picture that is drawn with replacement counts
    each time, in the order in which workers come to it. Distributed processes take turns with a picture, so the key of
    a counted draw also has the rank.
    """

    def key(self, index: int) -> tuple[int, ...]:
        """Count a visit of picture ``index``, and return the key of its draw: epoch, index and rank."""
        if self.pinned is not None:
            return (self.pinned, index)
        if index >= len(self._counts):
            raise ValueError(f"the dataset has grown from {len(self._counts)} pictures; create RawPairs again")
        visit = int(self._counts[index])
        self._counts[index] = visit + 1
        return (visit, index, *self.rank())

    def state_dict(self) -> dict[str, Any]:
        """The pinned epoch and each picture's visits.

        The processes of a distributed run share one state: there each picture's visits are the passes so far.
        """
        return {"epoch": self.pinned, "visits": self._shared_by_ranks(self._counts.clone())}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from ``state``; ValueError if it belongs to another number of pictures."""
        visits = torch.as_tensor(state["visits"])
        if visits.shape != self._counts.shape:
            raise ValueError(f"the state is that of {len(visits)} pictures, the dataset has {len(self._counts)}")
        self._resume(state["epoch"])
        self._counts.copy_(visits)

    @staticmethod
    def _shared_by_ranks(visits: Tensor) -> Tensor:
        world = world_size()
        if world == 1 or not len(visits):
            return visits
        share = math.ceil(len(visits) / world)  # a sampler fills the shares up where they do not divide
        return torch.full_like(visits, max(math.ceil(int(visits.sum()) / share), int(visits.max())))


class Passes(_Epochs):
    """Counts of the passes over a stream, and the sample at which a resumed pass goes on.

    Worker w of W counts in row W, column w, and the main process in row 0. Of passes with another number of workers
    those count that their first worker has begun.
    """

    def __init__(self) -> None:
        super().__init__(MAX_WORKERS + 1, MAX_WORKERS)
        self._resumed = torch.tensor([-1, 0]).share_memory_()  # a pass, and the number of its first sample
        self._running: tuple[int, int] | None = None  # in this process: the pass, and the number of the next sample

    def begin(self, workers: int, worker: int) -> tuple[int, int]:
        """Count a pass of one of ``workers`` workers, and return its epoch and the number of its first sample."""
        # Other rows alone: a sibling may be counting the same pass in this one.
        others = self._counts[:workers, 0].sum() + self._counts[workers + 1 :, 0].sum()
        started = int(self._counts[workers, worker] + others)
        self._counts[workers, worker] += 1
        resumed, first = self._resumed.tolist()
        start = first if started == resumed else 0
        self._running = (started, start)
        return (started if self.pinned is None else self.pinned), start

    def at(self, number: int) -> None:
        """Note that sample ``number`` comes next in this process."""
        if self._running is not None:
            self._running = (self._running[0], number)

    def end(self) -> None:
        """Note that the pass of this process is over."""
        self._running = None

    def state_dict(self) -> dict[str, Any]:
        """The pinned epoch, the number of finished passes, and the number of the next sample.

        The main process does not know how far its workers have come in a pass: with workers, the state is that of the
        next pass.
        """
        started, position = self._running or (int(self._counts[:, 0].sum()), 0)
        return {"epoch": self.pinned, "passes": started, "position": position}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from ``state`` with the next sample of the next pass."""
        self._resume(state["epoch"])
        self._counts.zero_()
        self._counts[0, 0] = state["passes"]
        self._resumed.copy_(torch.tensor([state["passes"], state["position"]]))
        self._running = None
