"""A loader whose epochs are numbered and whose order is kept, so that it goes on exactly in the middle of an epoch.

:func:`resumable` makes one of a loader of any batches, such as those of RawPairs; :mod:`rawaug.plugin.wrapped` makes
one whose batches become RAW pairs. In a distributed run each process has its share of the samples
(:mod:`rawaug.plugin.resume`).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sized
from typing import Any, Generic, NamedTuple, Self, TypeVar

import torch
from torch import Tensor
from torch.utils.data import DataLoader, IterableDataset

from rawaug.plugin.epochs import require_epoch
from rawaug.plugin.resume import KeptOrder, keep_order, numbering, own_share, pack_order, unpack_order
from rawaug.seeding import rank_key, world_size

Batch = TypeVar("Batch", covariant=True)


class Position(NamedTuple):
    """The next batch of a pass, and how many batches before it the wrapped loader will give again."""

    epoch: int
    batch: int
    passed: int = 0


class ResumableLoader(Generic[Batch]):
    """A loader that numbers its passes and can go on in the middle of one; other attributes are the loader's own.

    Args:
        loader: a DataLoader, or anything that iterates like one.
        seed: seed of the order of a distributed run, where each process has its share.
    """

    def __init__(self, loader: Iterable[Any], seed: int = 0) -> None:
        self.loader, self.seed = loader, seed
        self._share: Any = None
        self._kept: Any = None
        self._order: KeptOrder | None = None
        self._next = self._at = Position(0, 0)
        self._begun = 0  # the batch from which the order of the current pass was gone through
        self._frozen: int | None = None
        self._has_pool = False
        self._resumed_generator: Tensor | None = None
        self._loaded: Mapping[str, Any] | None = None
        self._resumes = False  # whether the next pass is that of a state

    @property
    def share(self) -> Any:
        """The wrapped loader, or this process's part of it in a distributed run."""
        if self._share is None:
            if world_size() == 1:
                return self.loader
            self._share = own_share(self.loader, self.seed)
        return self._share

    def __len__(self) -> int:
        return len(self.share)

    def set_epoch(self, epoch: int, start: int = 0) -> None:
        """Set the epoch of the next pass and the number of its first batch.

        Without a call every pass counts as the next epoch. Call it with ``start`` if the wrapped loader itself resumes
        in the middle of an epoch. The epoch is forwarded to the wrapped loader's own ``set_epoch``, if there is one. It
        does nothing after :meth:`freeze`, nor for the epoch of a state that was just loaded: libraries call it before
        every pass, and the pass goes on where the state was saved.
        """
        position = Position(require_epoch(epoch), require_epoch(start))
        if self._frozen is not None or (self._resumes and not start and position.epoch == self._next.epoch):
            return

        self._resumes = False
        self._next = self._at = position
        self._loaded = None
        if self._order is not None:
            self._order.start_anew()
        if hasattr(self.loader, "set_epoch"):
            self.loader.set_epoch(epoch)

    def freeze(self, epoch: int = 0) -> Self:
        """Fix the draws, as for validation: every pass is this epoch, whatever ``set_epoch`` is told later.

        Returns:
            The loader itself.
        """
        self._frozen = None
        self.set_epoch(epoch)
        self._frozen = epoch
        return self

    def state_dict(self) -> dict[str, Any]:
        """The state from which :meth:`load_state_dict` goes on with the next batch.

        It holds the epoch, the number of that batch, and what the state belongs to. In the middle of a pass it holds
        the order of the pass and how many samples all processes have visited, and if the loader has these, the state of
        its ``generator`` or its own ``state_dict``.

        The processes of a distributed run have one state, unless a sampler other than ``DistributedSampler`` gives each
        an order of its own; then each saves and loads its own state.
        """
        if self._loaded is not None:  # nothing has been asked for since
            return dict(self._loaded)

        loader, order = self._prepare()
        state: dict[str, Any] = {"epoch": self._at.epoch, "batch": self._at.batch, **self._describe()}
        if self._generator is not None:
            state["generator"] = self._generator.get_state()
            state["pool"] = self._has_pool

        if order is None:
            if hasattr(loader, "state_dict"):
                state["loader"] = loader.state_dict()
        elif self._at.batch:
            state["samples"] = order.visited(self._at.batch - self._begun)
            state["order"] = pack_order(order.order)
            state["rank"] = None if order.is_shared else rank_key()
        return state

    def _describe(self) -> dict[str, Any]:
        """What a state belongs to: the seeds, the number of samples, the processes, and how batches are loaded."""
        dataset = getattr(self.loader, "dataset", None)
        length = None
        if isinstance(dataset, Sized) and not isinstance(dataset, IterableDataset):
            length = len(dataset)

        seeds = [self.seed]
        for part in numbering(dataset):
            seeds.append(getattr(part, "seed", 0))
        return {
            "seeds": seeds,
            "length": length,
            "processes": world_size(),
            "batch_size": getattr(self.loader, "batch_size", None),
            "workers": getattr(self.loader, "num_workers", None),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on with the batch after the last one that ``state`` knows of.

        A DataLoader goes on in the order of the pass, and loads nothing twice. Its batches may have another size, and
        the state of one process, or the order of a ``DistributedSampler``, is dealt to any number of processes. A
        wrapped loader with its own ``load_state_dict`` goes on by itself. Any other loader loads its first batches
        again and they are passed over, so it must give the same ones.

        Raises:
            ValueError: if the state belongs to other seeds; in the middle of a pass also if it belongs to another
                number of samples, or cannot go on with this number of processes, or in this process.
        """
        missing = sorted({"epoch", "batch", *self._describe()} - set(state))
        if missing:
            raise ValueError(f"this is no state of a resumable loader: it lacks {', '.join(missing)}")

        epoch, batch = require_epoch(state["epoch"]), require_epoch(state["batch"])
        loader, order = self._prepare()
        self._require_same(state, "seeds")
        self._loaded = None
        self._resumes = True

        if order is not None:
            self._load_order(order, state, batch)
            self._next = self._at = Position(epoch, batch)
            self._begun = batch
        elif "loader" in state and hasattr(loader, "load_state_dict"):
            if batch:
                self._require_same(state, "processes", "workers")
            self._load_loader(state, batch)
            self._next = self._at = Position(epoch, batch)
        else:
            self._require_repeatable(state, epoch, batch)
            self._next = self._at = Position(epoch, batch, passed=batch)
            return
        self._loaded = state

    def _require_same(self, state: Mapping[str, Any], *facts: str) -> None:
        """Raise ValueError if the state belongs to a loader that differs in one of these facts."""
        present = self._describe()
        for fact in facts:
            if state[fact] != present[fact]:
                raise ValueError(
                    f"the state is of a loader with {fact} {state[fact]}, this one has {present[fact]}; use the same, "
                    "or begin the next epoch with set_epoch"
                )

    def _load_order(self, order: KeptOrder, state: Mapping[str, Any], batch: int) -> None:
        """Let the next pass go on with the order of the state."""
        if batch:
            if "order" not in state:
                raise ValueError("the state has no order of the pass; it was saved by another kind of loader")
            self._require_same(state, "length")
            if state["rank"] is not None:
                self._require_same(state, "processes")
                if tuple(state["rank"]) != rank_key():
                    raise ValueError("the state is that of another process; save and load one for each process")

            visits = unpack_order(state["order"])
            if order.has_batches != any(isinstance(entry, (list, tuple)) for entry in visits):
                raise ValueError("the state has batches of a batch sampler where the loader has samples, or vice versa")
            if world_size() > 1 and not order.is_shared:
                self._require_same(state, "processes")
            order.go_on(visits, state["samples"])

        if self._generator is None or "generator" not in state:
            return
        if batch:
            self._resumed_generator = state["generator"]  # the order of this pass is drawn already
        elif state.get("pool"):  # a new pool of workers draws once more than one that is used again
            order.draw_from(self._generator, state["generator"])
        else:
            self._generator.set_state(state["generator"])

    def _load_loader(self, state: Mapping[str, Any], batch: int) -> None:
        """Load the state of a loader that has one, and the state of its generator."""
        generator = self._generator
        if generator is None or "generator" not in state:
            self.loader.load_state_dict(state["loader"])  # type: ignore[attr-defined]
        elif batch or getattr(self.loader, "num_workers", 1):
            self.loader.load_state_dict(state["loader"])  # type: ignore[attr-defined]
            self._resumed_generator = state["generator"] if batch else None
        else:
            # At the end of a pass without workers torchdata's loader would draw from its generator once too often.
            generator.set_state(state["generator"])

    def _require_repeatable(self, state: Mapping[str, Any], epoch: int, batch: int) -> None:
        """Raise ValueError if the loader cannot be expected to give its first batches again."""
        if batch:
            self._require_same(state, "length", "processes", "batch_size", "workers")
        if not isinstance(self.loader, DataLoader):
            return

        dataset = self.loader.dataset
        if batch and not isinstance(dataset, IterableDataset):
            raise ValueError(
                "the loader's order cannot be kept: its sampler has no length, or it iterates in its own way; resume "
                "at the start of an epoch, or make the loader resumable instead of preparing it by a library"
            )
        if (epoch or batch) and self._counts_in_dataset and not numbering(dataset):
            raise ValueError(
                f"{type(dataset).__name__} cannot be told the epoch, so its draws would be those of epoch 0; give it a "
                "set_epoch(epoch) that passes it on to the RawPairStream inside"
            )

    _counts_in_dataset = True
    """Whether the draws are made in the loader's dataset, which must know the epoch."""

    @property
    def _generator(self) -> torch.Generator | None:
        """The generator of the loader, or that of its sampler."""
        generator: torch.Generator | None = getattr(self.loader, "generator", None)
        if generator is None and self._order is not None:
            generator = getattr(self._order.sampler, "generator", None)
        return generator

    def _prepare(self) -> tuple[Any, KeptOrder | None]:
        """Return the loader to iterate, and its order if that is kept."""
        if self._kept is None:
            self._kept, self._order = keep_order(self.share)
        return self._kept, self._order

    def __iter__(self) -> Iterator[Batch]:
        loader, order = self._prepare()
        self._loaded = None
        self._resumes = False
        epoch, start, passed = self._at = self._next
        self._next = Position(epoch + 1, 0)
        if self._frozen is not None:
            self._next = Position(epoch, 0)
        self._begun = start

        if self.share is not self.loader:
            self.share.sampler.set_epoch(epoch)
        if order is not None:
            order.epoch = epoch
        self._begin(epoch)

        first = start - passed
        length = self._length()
        number = first - 1
        for number, batch in enumerate(loader, first):
            self._has_pool = bool(getattr(loader, "persistent_workers", False))
            if self._generator is not None and self._resumed_generator is not None:
                self._generator.set_state(self._resumed_generator)  # whatever has been drawn to begin again
                self._resumed_generator = None
            if number < start:
                continue

            converted = self._convert(batch, epoch, number)
            self._at = self._after(epoch, number, is_last=number + 1 == length)
            yield converted

        self._at = Position(epoch + 1, 0)
        if number < start and not start and order is None and hasattr(self.loader, "load_state_dict"):
            yield from self._again(epoch)  # the state was that of the end of the previous pass

    def _again(self, epoch: int) -> Iterator[Batch]:
        """Make the pass of a loader that resumes by itself and has just ended the pass of its state."""
        length = self._length()
        for number, batch in enumerate(self.share):
            converted = self._convert(batch, epoch, number)
            self._at = self._after(epoch, number, is_last=number + 1 == length)
            yield converted

        self._at = Position(epoch + 1, 0)

    @staticmethod
    def _after(epoch: int, number: int, is_last: bool) -> Position:
        """Say where a pass goes on after a batch; training loops stop at the last one, before the iterator ends."""
        if is_last:
            return Position(epoch + 1, 0)
        return Position(epoch, number + 1)

    def _begin(self, epoch: int) -> None:
        """Tell the epoch to the datasets that number their epochs; this is called before each pass."""
        for dataset in numbering(getattr(self.loader, "dataset", None)):
            dataset.set_epoch(epoch)

    def _convert(self, batch: Any, epoch: int, number: int) -> Batch:
        """Convert a batch of the loader to what this loader yields."""
        converted: Batch = batch
        return converted

    def _length(self) -> int | None:
        """The number of batches in a pass, if it is reliable."""
        if isinstance(getattr(self.loader, "dataset", None), IterableDataset):
            return None
        if not isinstance(self.loader, Sized):
            return None

        try:
            return len(self)
        except TypeError:  # raised by a sampler without a length
            return None

    def __getattr__(self, name: str) -> Any:
        if "_share" not in self.__dict__:  # copy and pickle ask for attributes before any is set
            raise AttributeError(name)
        return getattr(self.share, name)


def resumable(loader: Iterable[Any], seed: int = 0) -> ResumableLoader[Any]:
    """Make a loader that goes on in the middle of an epoch, exactly.

    It numbers its passes, and each index that the sampler draws carries the epoch and how often it came before in it.
    So every :class:`rawaug.RawPairs` draws by (seed, epoch, index, occurrence), also inside a Subset, a ConcatDataset
    or a Dataset of your own. A ``set_epoch`` of the dataset, or of those inside it, is called too. The order of a pass
    is kept with the state.

    Args:
        loader: a DataLoader, or anything that iterates like one.
        seed: seed of the order of a distributed run, in which each process has its share of a loader that is sequential
            or has ``shuffle=True``.

    Example:
        >>> from rawaug import DictionaryISP, RawAugment, RawPairs
        >>> pairs = RawPairs([torch.rand(3, 32, 32) for _ in range(4)], RawAugment(DictionaryISP()), crop=32)
        >>> loader = resumable(DataLoader(pairs, batch_size=2, shuffle=True))
        >>> batches = iter(loader)
        >>> first, state = next(batches), loader.state_dict()
        >>> second = next(batches)
        >>> loader.load_state_dict(state)
        >>> torch.equal(next(iter(loader)).noisy, second.noisy)
        True
    """
    return ResumableLoader(loader, seed)
