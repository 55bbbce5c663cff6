"""A DataLoader of sRGB pictures as a loader of RAW pairs: one line, on the device of the training.

Batch n of epoch e is drawn from a generator seeded with BLAKE2b(seed, "wrap", e, n), where the seed is the
augmentation's. So the same batches make the same pairs, whatever the loader's workers do. Each pass is a new epoch. In
a distributed run each process has its share of the pictures (:mod:`rawaug.plugin.resume`), and the keys of all
processes but the first also contain their rank.

:func:`resumable` does the same for the epochs and the order of a loader of any batches, such as those of RawPairs.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence, Sized
from pathlib import Path
from typing import Any, Generic, NamedTuple, Self, TypeVar, overload

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import DataLoader, IterableDataset

from rawaug.isp.config import ISPParams
from rawaug.kernels.runtime import find_device
from rawaug.plugin.crops import crop_size
from rawaug.plugin.dataset import Maker, as_augment, open_dataset
from rawaug.plugin.epochs import require_epoch
from rawaug.plugin.maker import PairMaker
from rawaug.plugin.params import Keys, PairForm, RawPair, pair_form
from rawaug.plugin.pictures import find_picture, get_picture, is_picture, replace_picture
from rawaug.plugin.resume import KeptOrder, keep_order, numbering, own_share, pack_order, unpack_order
from rawaug.seeding import keyed_generator, rank_key, world_size

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


class WrappedLoader(ResumableLoader[Batch]):
    """A loader of RAW pairs, made by :func:`wrap`; its other attributes are the wrapped loader's own.

    Args:
        loader, augment, crop, key, bgr, device: as for :func:`wrap`, which converts and checks them.
        form: how a pair is handed over.
    """

    def __init__(
        self,
        loader: Iterable[Any],
        augment: PairMaker,
        crop: tuple[int, int] | None,
        key: str | int | None,
        form: PairForm,
        bgr: bool,
        device: torch.device | str | None,
    ) -> None:
        super().__init__(loader, augment.seed)
        self.key, self.crop, self.form, self.bgr = key, crop, form, bgr

        if isinstance(device, str):
            device = find_device(device)
        elif device is None:
            device = augment.device
        self.device = device
        self.augment = augment.to(device)

    _counts_in_dataset = False

    def _begin(self, epoch: int) -> None:
        """Do nothing: the pairs are drawn here, so the dataset keeps its own epochs."""

    def _convert(self, batch: Any, epoch: int, number: int) -> Batch:
        picture_key = find_picture(batch, self.key, batched=True)
        pictures = self._with_channel(get_picture(batch, picture_key))
        generator = keyed_generator(self.augment.seed, "wrap", epoch, number, *rank_key())

        pair, patches = self._make_pair(pictures, generator)
        converted: Batch = replace_picture(batch, picture_key, self.form(pair, picture=patches))
        return converted

    def _with_channel(self, batch: Any) -> Any:
        """Give batches of grey pictures ``(B, H, W)``, as a DataLoader collates them, an axis for their one channel."""
        if getattr(self.loader, "batch_size", None) is None:
            return batch
        if isinstance(batch, (Tensor, np.ndarray)) and batch.ndim == 3:
            return batch[:, None]
        return batch

    def _make_pair(self, pictures: Any, generator: torch.Generator) -> tuple[RawPair, Tensor]:
        """Make the pairs of a batch of pictures, and return them with the pictures as they were cut."""
        if self.crop is None:
            batch = self.augment.as_batch(pictures, self.bgr).to(self.device, non_blocking=True)
            chosen = self.augment.look(None)  # the pictures may be crops
            return self.augment.make_pair(batch, generator, chosen=chosen), batch

        patches, places, chosen = self._draw_crops(pictures, generator)
        patches = patches.to(self.device, non_blocking=True)
        return self.augment.make_pair(patches, generator, places, chosen), patches

    def _draw_crops(self, pictures: Any, generator: torch.Generator) -> tuple[Tensor, Tensor, ISPParams | None]:
        """Draw a crop of each picture ``(B, C, height, width)``, their places ``(B, 5)``, and their chosen settings."""
        if is_picture(pictures):
            pictures = [pictures]

        patches, places, settings = [], [], []
        for picture in pictures:
            patch, crop = self.augment.draw_patch(picture, self.crop, False, generator, bgr=self.bgr)
            patches.append(patch)
            places.append(crop)

            setting = self.augment.look(picture, self.bgr)
            if setting is not None:
                settings.append(setting)

        chosen = None
        if settings:
            chosen = ISPParams(*map(torch.cat, zip(*settings, strict=True)))
        return self.augment.stack(patches), torch.stack(places), chosen


@overload
def wrap(
    loader: DataLoader[Tensor] | str | Path,
    augment: Maker,
    crop: int | tuple[int, int] | None = None,
    *,
    key: None = None,
    keys: None = None,
    fields: None = None,
    order: str | Sequence[str] | None = None,
    bgr: bool = False,
    device: torch.device | str | None = None,
    batch_size: int | None = None,
    shuffle: bool | None = None,
) -> WrappedLoader[RawPair]: ...
@overload
def wrap(
    loader: DataLoader[Tensor] | str | Path,
    augment: Maker,
    crop: int | tuple[int, int] | None = None,
    *,
    key: None = None,
    keys: Keys,
    fields: None = None,
    order: str | Sequence[str] | None = None,
    bgr: bool = False,
    device: torch.device | str | None = None,
    batch_size: int | None = None,
    shuffle: bool | None = None,
) -> WrappedLoader[dict[str, Any]]: ...
@overload
def wrap(
    loader: Iterable[Any] | str | Path,
    augment: Maker,
    crop: int | tuple[int, int] | None = None,
    *,
    key: str | int | None = None,
    keys: Keys | None = None,
    fields: Sequence[str] | None = None,
    order: str | Sequence[str] | None = None,
    bgr: bool = False,
    device: torch.device | str | None = None,
    batch_size: int | None = None,
    shuffle: bool | None = None,
) -> WrappedLoader[Any]: ...
def wrap(
    loader: Iterable[Any] | str | Path,
    augment: Maker,
    crop: int | tuple[int, int] | None = None,
    *,
    key: str | int | None = None,
    keys: Keys | None = None,
    fields: Sequence[str] | None = None,
    order: str | Sequence[str] | None = None,
    bgr: bool = False,
    device: torch.device | str | None = None,
    batch_size: int | None = None,
    shuffle: bool | None = None,
) -> WrappedLoader[Any]:
    """Make a loader of RAW pairs from any loader of sRGB batches; the rest of the training script stays as it is.

    Args:
        loader: a DataLoader, or anything that iterates like one. Its batches are pictures ``(B, 3, H, W)`` in any form
            that :mod:`rawaug.plugin.pictures` accepts, lists of pictures, or tuples or mappings that contain these. The
            :class:`RawPair` takes their place, and everything else passes through. Or the path of a folder of pictures,
            which needs ``crop`` if they differ in size.
        augment: makes the pairs, and moves to ``device``; or an ISP, its name or its path, or a camera. A
            :class:`rawaug.RawNoise` takes clean RAW instead of pictures.
        crop: even side of a square crop, or (height, width), drawn for each picture. With it, pictures of different
            sizes form a batch. By default whole pictures, without their last row or column if a side is odd.
        key: name of the pictures in batches that are mappings, their index in tuples (0 by default).
        keys, fields, order: how pairs are handed over, as for :class:`rawaug.RawPairs`; a batch has no names.
        bgr: whether pictures have their channels in the order B, G, R, as ``cv2.imread`` gives them.
        device: device on which the pairs are made, by default that of ``augment``; a ``torch.device``, or a name that
            :func:`rawaug.kernels.runtime.find_device` knows, including ``auto``. uint8 pictures are moved there as
            uint8.
        batch_size, shuffle: for a folder, 1 and false by default; a loader has its own.

    Raises:
        TypeError: if ``augment`` is none of these.
        ValueError: if the crop is odd, the machine has no such device, or, on iteration, if there are no pictures, or
            they do not form a batch.

    Example:
        >>> from rawaug import DictionaryISP, RawAugment
        >>> loader = wrap([(torch.rand(2, 3, 64, 64), ["cat", "dog"])], RawAugment(DictionaryISP()))
        >>> [(pair.noisy.shape, labels) for pair, labels in loader]
        [(torch.Size([2, 4, 32, 32]), ['cat', 'dog'])]
    """
    maker = as_augment(augment)
    size = crop_size(crop)

    if isinstance(loader, (str, Path)):
        pictures = open_dataset(loader, maker, size)
        loader = DataLoader(pictures, batch_size=batch_size or 1, shuffle=bool(shuffle), collate_fn=list)
    elif batch_size is not None or shuffle is not None:
        raise ValueError("batch_size and shuffle are for the path of a folder; a loader has its own")
    return WrappedLoader(loader, maker, size, key, pair_form(keys, fields, order), bgr, device)
