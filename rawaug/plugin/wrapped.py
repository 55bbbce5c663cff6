"""A DataLoader of sRGB pictures as a loader of RAW pairs: one line, on the device of the training.

Batch n of epoch e is drawn from a generator seeded with BLAKE2b(seed, "wrap", e, n), where the seed is the
augmentation's. So the same batches make the same pairs, whatever the loader's workers do. Each pass is a new epoch. In
a distributed run each process has its share of the pictures (:mod:`rawaug.plugin.resume`), and the keys of all
processes but the first also contain their rank.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, overload

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import DataLoader

from rawaug.isp.config import ISPParams
from rawaug.kernels.runtime import find_device
from rawaug.plugin.crops import crop_size
from rawaug.plugin.dataset import Maker, as_augment, open_dataset
from rawaug.plugin.loader import Batch, ResumableLoader
from rawaug.plugin.maker import PairMaker
from rawaug.plugin.params import Keys, PairForm, RawPair, pair_form
from rawaug.plugin.pictures import find_picture, get_picture, is_picture, replace_picture
from rawaug.seeding import keyed_generator, rank_key


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
