"""A DataLoader of sRGB pictures as a loader of RAW pairs: one line, on the device of the training.

Batch n of epoch e is drawn from a generator seeded with BLAKE2b(seed, "wrap", e, n), where the seed is the
augmentation's. So the same batches make the same pairs, whatever the loader's workers do. Each pass is a new epoch. In
a distributed run each process has its share of the pictures (:mod:`rawaug.plugin.order`), and the keys of all processes
but the first also contain their rank.

:func:`resumable` does the same for the epochs and the order of a loader of any batches, such as those of RawPairs.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence, Sized
from pathlib import Path
from typing import Any, Generic, NamedTuple, TypeVar, overload

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import DataLoader, IterableDataset

from rawaug.kernels.runtime import find_device
from rawaug.plugin.crops import crop_size
from rawaug.plugin.dataset import Maker, as_augment, open_dataset
from rawaug.plugin.epochs import require_epoch
from rawaug.plugin.maker import PairMaker
from rawaug.plugin.order import is_drawn, keep_order, own_share, pack_order, unpack_order, world_size
from rawaug.plugin.params import Keys, PairForm, RawPair, pair_form
from rawaug.plugin.pictures import find_picture, get_picture, is_picture, replace_picture
from rawaug.seeding import keyed_generator, rank_key

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
        self._order: Any = None
        self._next = self._at = Position(0, 0)
        self._has_pool = False
        self._resumed_generator: Tensor | None = None
        self._loaded: Mapping[str, Any] | None = None

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

        Without a call every pass counts as the next epoch. Call it with a fixed number before each pass over validation
        data to repeat the same noise, and with ``start`` if the wrapped loader itself resumes in the middle of an
        epoch. The epoch is forwarded to the wrapped loader's own ``set_epoch``, if there is one.
        """
        self._next = self._at = Position(require_epoch(epoch), require_epoch(start))
        self._loaded = None
        if self._order is not None:
            self._order.start_at(0)
        if hasattr(self.loader, "set_epoch"):
            self.loader.set_epoch(epoch)

    def state_dict(self) -> dict[str, Any]:
        """The state from which :meth:`load_state_dict` goes on with the next batch.

        It holds the epoch and the number of that batch. If the loader has these, it also holds the state of the
        loader's ``generator``, the order of the pass, or the loader's own ``state_dict``.

        In the middle of a shuffled pass, each process of a distributed run has a state of its own, unless the loader's
        order comes from ``shuffle`` alone.
        """
        if self._loaded is not None:  # nothing has been asked for since
            return dict(self._loaded)

        state: dict[str, Any] = {"epoch": self._at.epoch, "batch": self._at.batch}
        if self._generator is not None:
            state["generator"] = self._generator.get_state()
            state["pool"] = self._has_pool

        if hasattr(self.loader, "state_dict"):
            state["loader"] = self.loader.state_dict()
        elif self._at.batch and self._order is not None and is_drawn(self._order.sampler):
            state["order"] = pack_order(self._order.current or [])
            state["rank"] = rank_key()
        return state

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on with the batch after the last one that ``state`` knows of.

        A wrapped loader with its own ``load_state_dict`` goes on by itself. A DataLoader goes on in the order of the
        pass, and loads nothing twice. Any other loader loads its first batches again and they are passed over, so it
        must give the same ones.

        Raises:
            ValueError: if the state is that of another process, or the loader's order cannot be restored.
        """
        epoch, batch = require_epoch(state["epoch"]), require_epoch(state["batch"])
        self._loaded = None
        if "loader" in state and hasattr(self.loader, "load_state_dict"):
            self._next = self._at = Position(epoch, batch)
            self._load_loader(state, batch)
            self._loaded = state
            return

        _, order = self._prepare()
        if order is None:
            self._require_repeatable(batch)
            self._next = self._at = Position(epoch, batch, passed=batch)
            return

        if state.get("rank", rank_key()) != rank_key():
            raise ValueError("the state is that of another process; save and load one for each process")
        if batch and is_drawn(order.sampler) and "order" not in state:
            raise ValueError("the state does not hold the order of the pass; it was saved by another kind of loader")

        self._next = self._at = Position(epoch, batch)
        visits = None
        if batch and "order" in state:
            visits = unpack_order(state["order"])
        order.start_at(batch, visits)
        self._restore_generator(state, batch)
        self._loaded = state

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

    def _restore_generator(self, state: Mapping[str, Any], batch: int) -> None:
        """Restore the loader's generator, from which a new pool of workers draws once more than a reused one."""
        if self._generator is None or "generator" not in state:
            return
        if batch:
            self._resumed_generator = state["generator"]  # the order of this pass is drawn already
        elif state.get("pool"):
            self._order.draw_from(self._generator, state["generator"])
        else:
            self._generator.set_state(state["generator"])

    def _require_repeatable(self, batch: int) -> None:
        """Raise ValueError in the middle of a pass whose order is neither kept nor given by the epoch."""
        has_order = isinstance(self.loader, DataLoader) and not isinstance(self.loader.dataset, IterableDataset)
        if batch and has_order:
            raise ValueError(
                "the loader's sampler has no length, so its order cannot be kept; resume at the start of an epoch, or "
                "use torchdata's StatefulDataLoader"
            )

    @property
    def _generator(self) -> torch.Generator | None:
        return getattr(self.loader, "generator", None)

    def _prepare(self) -> tuple[Any, Any]:
        """Return the loader to iterate, and its order if that is kept."""
        if self._kept is None:
            self._kept, self._order = keep_order(self.share)
        return self._kept, self._order

    def __iter__(self) -> Iterator[Batch]:
        loader, _ = self._prepare()
        self._loaded = None
        epoch, start, passed = self._at = self._next
        self._next = Position(epoch + 1, 0)
        if self.share is not self.loader:
            self.share.sampler.set_epoch(epoch)
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
        if number < start and not start and hasattr(self.loader, "load_state_dict"):
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
        """Tell the epoch to a dataset that numbers its epochs; this is called before each pass."""
        dataset: Any = getattr(self.loader, "dataset", None)
        if hasattr(dataset, "set_epoch"):
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

    It numbers its passes and gives the number to a dataset with ``set_epoch``, such as :class:`rawaug.RawPairs`, so
    that a pair depends on (seed, epoch, index) alone. It keeps the order of a shuffled pass with its state.

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

    def _begin(self, epoch: int) -> None:
        """Do nothing: the pairs are drawn here, so the dataset keeps its own epochs."""

    def _convert(self, batch: Any, epoch: int, number: int) -> Batch:
        where = find_picture(batch, self.key, batched=True)
        pictures = self._with_channel(get_picture(batch, where))
        generator = keyed_generator(self.augment.seed, "wrap", epoch, number, *rank_key())

        pair = self._make_pair(pictures, generator)
        converted: Batch = replace_picture(batch, where, self.form(pair))
        return converted

    def _with_channel(self, batch: Any) -> Any:
        """Give batches of grey pictures ``(B, H, W)``, as a DataLoader collates them, an axis for their one channel."""
        if getattr(self.loader, "batch_size", None) is None:
            return batch
        if isinstance(batch, (Tensor, np.ndarray)) and batch.ndim == 3:
            return batch[:, None]
        return batch

    def _make_pair(self, pictures: Any, generator: torch.Generator) -> RawPair:
        if self.crop is None:
            whole = self.augment.as_batch(pictures, self.bgr).to(self.device, non_blocking=True)
            return self.augment.make_pair(whole, generator)

        patches, places = self._draw_crops(pictures, generator)
        return self.augment.make_pair(patches.to(self.device, non_blocking=True), generator, places)

    def _draw_crops(self, pictures: Any, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """Draw one crop of each picture ``(B, C, height, width)``, and their places ``(B, 5)``."""
        if is_picture(pictures):
            pictures = [pictures]

        patches, places = [], []
        for picture in pictures:
            patch, place = self.augment.draw_patch(picture, self.crop, False, generator, bgr=self.bgr)
            patches.append(patch)
            places.append(place)

        return self.augment.stack(patches), torch.stack(places)


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
