"""A DataLoader of sRGB pictures as a loader of RAW pairs: one line, on the device of the training.

Batch n of epoch e is drawn from a generator seeded with BLAKE2b(seed, "wrap", e, n), where the seed is the
augmentation's: whatever the loader's workers do, the same batches make the same pairs. Each pass is a new epoch. In a
distributed run each process has its share of the pictures (:mod:`rawaug.plugin.epochs`), and the keys of processes but
the first have their rank as well.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence, Sized
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import IterableDataset

from rawaug.isp.model import DictionaryISP
from rawaug.kernels.runtime import find_device
from rawaug.plugin.augment import RawAugment
from rawaug.plugin.dataset import as_augment, crop_size, draw_patch
from rawaug.plugin.epochs import own_share, require_epoch, world_size
from rawaug.plugin.params import RawPair, require_keys
from rawaug.plugin.pictures import (
    find_picture,
    get_picture,
    is_picture,
    replace_picture,
    stack_pictures,
    to_rgb_batch,
    trim_to_even,
)
from rawaug.seeding import keyed_generator, rank_key


class Position(NamedTuple):
    """The next batch of a pass, and the number of batches before it that the wrapped loader gives once more."""

    epoch: int
    batch: int
    passed: int = 0


class WrappedLoader:
    """A loader of RAW pairs, made by :func:`wrap`; its other attributes are the wrapped loader's own.

    Args:
        loader, augment, crop, key, keys, device: as for :func:`wrap`, which converts and checks them.
    """

    def __init__(
        self,
        loader: Iterable[Any],
        augment: RawAugment,
        crop: tuple[int, int] | None,
        key: str | int | None,
        keys: tuple[str, ...] | None,
        device: torch.device | str | None,
    ) -> None:
        self.loader, self.key, self.crop, self.keys = loader, key, crop, keys
        named = find_device(device) if isinstance(device, str) else device
        self.device = named if named is not None else augment.device
        self.augment = augment.to(self.device)
        self._share: Any = None
        self._next = self._at = Position(0, 0)
        self._order: Tensor | None = None

    @property
    def share(self) -> Any:
        """The wrapped loader, or in a distributed run this process's part of it."""
        if self._share is None and world_size() > 1:
            self._share = own_share(self.loader, self.augment.seed)
        return self.loader if self._share is None else self._share

    def __len__(self) -> int:
        return len(self.share)

    def set_epoch(self, epoch: int, start: int = 0) -> None:
        """Set the epoch of the next pass and the number of its first batch.

        Without it every pass counts as the next epoch. Call it with a fixed number before each pass over validation
        data, to repeat the same noise, and with ``start`` where the wrapped loader itself resumes in the middle of
        an epoch. It is forwarded to the wrapped loader's own ``set_epoch``, if there is one.
        """
        self._next = self._at = Position(require_epoch(epoch), require_epoch(start))
        if hasattr(self.loader, "set_epoch"):
            self.loader.set_epoch(epoch)

    def state_dict(self) -> dict[str, Any]:
        """The state from which :meth:`load_state_dict` goes on with the next batch.

        It holds the epoch and the number of that batch, and, where the wrapped loader has these, the state of its own
        ``generator`` at the start of the pass and its ``state_dict``.
        """
        state: dict[str, Any] = {"epoch": self._at.epoch, "batch": self._at.batch}
        if self._generator is not None:
            state["order"] = self._generator.get_state() if self._order is None else self._order
        if hasattr(self.loader, "state_dict"):
            state["loader"] = self.loader.state_dict()
        return state

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on with the batch after the last one that ``state`` knows of.

        A wrapped loader with a ``load_state_dict`` of its own goes on by itself; of any other the first batches are
        loaded again and passed over. Their order is the same if it is sequential, drawn from the loader's own
        ``generator``, or that of a distributed run; what a script shuffles from PyTorch's global state it restores.
        """
        goes_on = "loader" in state and hasattr(self.loader, "load_state_dict")
        self._next = self._at = Position(state["epoch"], state["batch"], 0 if goes_on else state["batch"])
        if goes_on:
            self.loader.load_state_dict(state["loader"])  # type: ignore[attr-defined]
        if self._generator is not None and "order" in state:
            self._generator.set_state(state["order"])

    @property
    def _generator(self) -> torch.Generator | None:
        return getattr(self.loader, "generator", None)

    def __iter__(self) -> Iterator[Any]:
        epoch, start, passed = self._at = self._next
        self._next = Position(epoch + 1, 0)
        self._order = None if self._generator is None else self._generator.get_state()
        if self.share is not self.loader:
            self.share.sampler.set_epoch(epoch)
        first = start - passed
        length = self._length()
        for number, batch in enumerate(self.share, first):
            if number < start:
                continue
            where = find_picture(batch, self.key, batched=True)
            generator = keyed_generator(self.augment.seed, "wrap", epoch, number, *rank_key())
            pair = self._make_pair(self._with_channel(get_picture(batch, where)), generator)
            last = number - first + 1 == length  # where training loops stop, before the end of the iterator
            self._advance(Position(epoch + 1, 0) if last else Position(epoch, number + 1))
            yield replace_picture(batch, where, pair if self.keys is None else pair.as_dict(self.keys))
        self._advance(Position(epoch + 1, 0))

    def _length(self) -> int | None:
        """Batches of a pass, where they can be counted on."""
        if isinstance(getattr(self.loader, "dataset", None), IterableDataset):
            return None
        return len(self) if isinstance(self.loader, Sized) else None

    def _advance(self, position: Position) -> None:
        self._at = position
        if not position.batch:
            self._order = None

    def _with_channel(self, batch: Any) -> Any:
        """Batches of grey pictures ``(B, H, W)``, which a DataLoader collates, with an axis for their one channel."""
        grey = isinstance(batch, (Tensor, np.ndarray)) and batch.ndim == 3
        return batch[:, None] if grey and getattr(self.loader, "batch_size", None) is not None else batch

    def _make_pair(self, pictures: Any, generator: torch.Generator) -> RawPair:
        whole = trim_to_even(to_rgb_batch(pictures)) if self.crop is None else None
        srgb, crop = (whole, None) if whole is not None else self._draw_crops(pictures, generator)
        return self.augment.make_pair(srgb.to(self.device, non_blocking=True), generator, crop)

    def _draw_crops(self, pictures: Any, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """One crop of each picture ``(B, 3, crop, crop)``, and their places ``(B, 5)``."""
        listed = [pictures] if is_picture(pictures) else pictures
        drawn = [draw_patch(picture, self.crop, False, generator) for picture in listed]
        return stack_pictures([patch for patch, _ in drawn]), torch.stack([crop for _, crop in drawn])

    def __getattr__(self, name: str) -> Any:
        if "_share" not in self.__dict__:  # asked for before anything is set, by copy and pickle
            raise AttributeError(name)
        return getattr(self.share, name)


def wrap(
    loader: Iterable[Any],
    augment: RawAugment | DictionaryISP | str | Path,
    crop: int | tuple[int, int] | None = None,
    *,
    key: str | int | None = None,
    keys: Sequence[str] | None = None,
    device: torch.device | str | None = None,
) -> WrappedLoader:
    """Make a loader of RAW pairs of any loader of sRGB batches; the rest of the training script stays as it is.

    Args:
        loader: a DataLoader, or what iterates like one. Its batches are pictures ``(B, 3, H, W)`` in any form that
            :mod:`rawaug.plugin.pictures` accepts, lists of pictures, or tuples or mappings that have these. The
            :class:`RawPair` takes their place, all else passes through.
        augment: makes the pairs, and moves to ``device``; or an ISP, its name or its path.
        crop: even side of a square crop, or (height, width), drawn for each picture: makes a batch of pictures of
            different sizes. By default whole pictures, without their last row or column where a side is odd.
        key: name of the pictures in batches that are mappings, their index in tuples (0 by default).
        keys: names for noisy, clean, variance and params, as for :class:`rawaug.RawPairs`.
        device: where the pairs are made, by default where ``augment`` is; a ``torch.device``, or a name that
            :func:`rawaug.kernels.runtime.find_device` knows, ``auto`` among them. uint8 pictures travel
            there as uint8.

    Raises:
        TypeError: if ``augment`` is none of these.
        ValueError: if the crop is odd, the machine has no such device, or, on iteration, if there are no pictures, or
            they do not form a batch.

    Example:
        >>> from rawaug.isp.model import DictionaryISP
        >>> loader = wrap([(torch.rand(2, 3, 64, 64), ["cat", "dog"])], RawAugment(DictionaryISP()))
        >>> [(pair.noisy.shape, labels) for pair, labels in loader]
        [(torch.Size([2, 4, 32, 32]), ['cat', 'dog'])]
    """
    return WrappedLoader(loader, as_augment(augment), crop_size(crop), key, require_keys(keys), device)
