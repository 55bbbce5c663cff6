"""Which draw a sample is.

A draw is keyed by (seed, epoch, index, occurrence): the occurrence says how often the index came before in its epoch,
as it does with samplers that draw with replacement. There are two ways to know epoch and occurrence:

- In a loader that :mod:`rawaug.plugin.loader` has made resumable, they travel with the index
  (:mod:`rawaug.plugin.resume`), and a dataset is :func:`answering` its requests.
- Elsewhere draws are counted where they are made, since a DataLoader does not tell its Dataset that a new pass begins.
  For a picture with an index, the epoch is the number of earlier visits of this picture (:class:`Visits`): in a pass
  that visits every picture once, visit k is epoch k, however many workers share the pass. For a stream, it is the
  number of earlier passes, which each worker counts for itself (:class:`Passes`).

The counts lie in shared memory, where workers of every start method find them, persistent ones too. A cell is written
only by the worker that has the picture, so no lock is needed. ``pin`` states the epoch, in which the counts are then
the occurrences; ``freeze`` makes a draw a pure function of (seed, index).
"""

from __future__ import annotations

import math
import operator
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any, SupportsIndex

import torch
from torch import Tensor
from torch.utils.data import get_worker_info

from rawaug.errors import count_of
from rawaug.seeding import rank_key, world_size

_COUNTED = -1
"""The value that stands for "not pinned"."""
_MAX_WORKERS = 512

_BROKEN_OFF = (
    "the state is of the middle of a pass whose workers had fetched more pictures than were used, so it cannot go on "
    "exactly; resume by rawaug.resumable(loader), by numbering the epochs with set_epoch, or begin the next epoch "
    "with load_state_dict(state, next_epoch=True)"
)


def require_epoch(epoch: SupportsIndex) -> int:
    """Convert an epoch, or the number of a batch, to an int.

    Raises:
        ValueError: if it does not fit the 63 bits of a shared counter.
    """
    if not isinstance(epoch, SupportsIndex) or not 0 <= operator.index(epoch) < 2**63:
        raise ValueError(f"an epoch is an integer from 0 to 2^63 - 1, got {epoch!r}")
    return operator.index(epoch)


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
def answering(requests: Sequence[Any]) -> Iterator[None]:
    token = _answer.set(_Answer(requests))
    try:
        yield
    finally:
        _answer.reset(token)


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
