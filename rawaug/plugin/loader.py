"""A DataLoader of sRGB pictures as a loader of RAW pairs: one line, on the device of the training.

Batch n of epoch e is drawn from a generator seeded with BLAKE2b(seed, "wrap", e, n), where the seed is the
augmentation's: whatever the loader's workers do, the same batches make the same pairs. In a distributed run the keys of
processes but the first have their rank as well.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np
import torch
from torch import Tensor

from rawaug.bayer import RandomCrop
from rawaug.plugin.augment import RawAugment
from rawaug.plugin.dataset import placed, random_place
from rawaug.plugin.params import RawPair
from rawaug.plugin.pictures import (
    even_sided,
    find_picture,
    is_picture,
    picked,
    replaced,
    stacked,
    to_rgb_batch,
    to_rgb_tensor,
)
from rawaug.seeding import keyed_generator, rank_key


class WrappedLoader:
    """A loader of RAW pairs, made by :func:`wrap`; its other attributes are the wrapped loader's own."""

    def __init__(
        self,
        loader: Iterable[Any],
        augment: RawAugment,
        device: torch.device | str | None,
        key: str | int | None,
        crop: int | None,
    ) -> None:
        self.loader, self.key, self.crop = loader, key, crop
        self.device = torch.device(device) if device is not None else augment.device
        self.augment = augment.to(self.device)
        self._epoch, self._start = 0, 0

    def __len__(self) -> int:
        return len(self.loader)  # type: ignore[arg-type]

    def set_epoch(self, epoch: int, start: int = 0) -> None:
        """Set the next pass's epoch and first batch number; forwarded to the wrapped loader's ``set_epoch``, if any.

        Without it every pass counts as the next epoch. Call it with a fixed number before each pass over validation
        data, to meet the same noise again, and with ``start`` where a loader goes on in the middle of an epoch.
        """
        self._epoch, self._start = epoch, start
        if hasattr(self.loader, "set_epoch"):
            self.loader.set_epoch(epoch)

    def __iter__(self) -> Iterator[Any]:
        batches = self._pairs(self._epoch, self._start)
        self._epoch, self._start = self._epoch + 1, 0
        return batches

    def _pairs(self, epoch: int, start: int) -> Iterator[Any]:
        for number, batch in enumerate(self.loader, start):
            where = find_picture(batch, self.key, batched=True)
            generator = keyed_generator(self.augment.seed, "wrap", epoch, number, *rank_key())
            yield replaced(batch, where, self._pair(self._pictures(picked(batch, where)), generator))

    def _pictures(self, batch: Any) -> Any:
        """Batches of grey pictures ``(B, H, W)``, which a DataLoader collates, with an axis for their one channel."""
        grey = isinstance(batch, (Tensor, np.ndarray)) and batch.ndim == 3
        return batch[:, None] if grey and getattr(self.loader, "batch_size", None) is not None else batch

    def _pair(self, pictures: Any, generator: torch.Generator) -> RawPair:
        whole = even_sided(to_rgb_batch(pictures)) if self.crop is None else None
        srgb, place = (whole, None) if whole is not None else self._crops(pictures, generator)
        srgb = srgb.to(self.device, non_blocking=True)
        pair: RawPair = self.augment.apply(srgb, self.augment.sample(srgb, generator, place))
        return pair

    def _crops(self, pictures: Any, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """One crop of each picture ``(B, 3, crop, crop)``, and their places ``(B, 5)``."""
        listed = [pictures] if is_picture(pictures) else pictures
        whole = [even_sided(to_rgb_tensor(picture)) for picture in listed]
        places = [random_place(picture, self.crop, False, generator) for picture in whole]
        patches = [placed(picture, place, self.crop) for picture, place in zip(whole, places, strict=True)]
        return stacked(patches), torch.stack(places)

    def __getattr__(self, name: str) -> Any:
        if name == "loader":  # asked for before it is set, by copy and pickle
            raise AttributeError(name)
        return getattr(self.loader, name)


def wrap(
    loader: Iterable[Any],
    augment: RawAugment,
    device: torch.device | str | None = None,
    key: str | int | None = None,
    crop: int | None = None,
) -> WrappedLoader:
    """Any loader of sRGB batches as a loader of RAW pairs; the rest of the training script stays as it is.

    Args:
        loader: a DataLoader, or what iterates like one. Its batches are pictures ``(B, 3, H, W)`` in any form that
            :mod:`rawaug.plugin.pictures` accepts, lists of pictures, or tuples or mappings that have these. The
            :class:`RawPair` takes their place, all else passes through.
        augment: moves to ``device``.
        device: where the pairs are made, by default where ``augment`` is. Pictures travel there as uint8, if they are.
        key: name of the pictures in batches that are mappings, their index in tuples (0 by default).
        crop: even side of a square crop, drawn for each picture: makes a batch of pictures of different sizes. By
            default whole pictures, without their last row or column where a side is odd.

    Raises:
        ValueError: if the crop is odd, or, on iteration, if there are no pictures, or they make no batch.

    Example:
        >>> from rawaug.isp.model import DictionaryISP
        >>> loader = wrap([(torch.rand(2, 3, 64, 64), ["cat", "dog"])], RawAugment(DictionaryISP()))
        >>> [(pair.noisy.shape, labels) for pair, labels in loader]
        [(torch.Size([2, 4, 32, 32]), ['cat', 'dog'])]
    """
    if crop is not None:
        RandomCrop(crop)  # raises for an odd crop here
    return WrappedLoader(loader, augment, device, key, crop)
