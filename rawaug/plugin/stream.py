"""An iterable Dataset of sRGB pictures as an iterable Dataset of RAW pairs, with every draw keyed.

Sample n of epoch e comes from a generator seeded with BLAKE2b(seed, "pairs", e, n) alone, as in
:mod:`rawaug.plugin.dataset`; the epoch is the number of earlier passes (:mod:`rawaug.plugin.epochs`).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import torch
from torch.utils.data import IterableDataset, get_worker_info

from rawaug.plugin.dataset import Maker, Pairs
from rawaug.plugin.epochs import Passes
from rawaug.plugin.params import Keys
from rawaug.plugin.pictures import find_picture, get_picture, replace_picture
from rawaug.seeding import keyed_generator


class RawPairStream(Pairs[Any], IterableDataset[Any]):
    """An iterable Dataset of pictures as an iterable Dataset of RAW pairs.

    A stream has no index. Without ``identity`` the n-th sample that worker w of W meets has the number nW + w. No two
    samples share a draw, and if sample i goes to worker i mod W, each keeps its draws whatever W is. A dataset that
    distributes whole shards needs ``identity`` for that. Without ``identity``, the processes of a distributed run draw
    differently, by their rank. Each pass is a new epoch, unless one is pinned.

    Args:
        dataset: an iterable of samples, which are as for :class:`RawPairs`. It divides itself between workers, as
            datasets of WebDataset and Hugging Face do, or ``divide`` does. Or the path of a folder of pictures.
        augment, crop, seed, key, views, keys, fields, order, bgr, zoom: as for :class:`RawPairs`.
        identity: name or index of the field that identifies a sample, such as ``"__key__"``; it keys the draws.
        divide: give sample i to worker i mod W, for a dataset that every worker would otherwise go through in full.

    Example:
        >>> from rawaug import DictionaryISP, RawAugment
        >>> stream = RawPairStream(iter([torch.rand(3, 40, 48)]), RawAugment(DictionaryISP()), crop=32)
        >>> [pair.noisy.shape for pair in stream]
        [torch.Size([4, 16, 16])]
    """

    _epochs: Passes

    def __init__(
        self,
        dataset: Any,
        augment: Maker,
        crop: int | tuple[int, int] | None = 256,
        *,
        seed: int = 0,
        key: str | int | None = None,
        views: bool = True,
        keys: Keys | None = None,
        fields: Sequence[str] | None = None,
        order: str | Sequence[str] | None = None,
        bgr: bool = False,
        zoom: float = 1.0,
        identity: str | int | None = None,
        divide: bool = False,
    ) -> None:
        super().__init__(
            dataset,
            augment,
            crop,
            seed=seed,
            key=key,
            views=views,
            keys=keys,
            fields=fields,
            order=order,
            bgr=bgr,
            zoom=zoom,
        )
        self.identity = identity
        self.divide = divide or isinstance(self.dataset, _InOrder)

    def _open(self, dataset: Any) -> Any:
        if isinstance(dataset, (str, Path)):
            return _InOrder(super()._open(dataset))
        return dataset

    def _make_epochs(self, dataset: Any) -> Passes:
        return Passes()

    def __iter__(self) -> Iterator[Any]:
        info = get_worker_info()
        worker = 0 if info is None else info.id
        workers = 0 if info is None else info.num_workers
        epoch, start = self._epochs.begin(workers, worker)  # the pass begins now, not with its first sample
        return self._samples(epoch, start, worker, max(workers, 1))

    def _samples(self, epoch: int, start: int, worker: int, workers: int) -> Iterator[Any]:
        for count, sample in enumerate(self.dataset):
            number = count
            if not self.divide:
                number = count * workers + worker
            elif count % workers != worker:
                continue
            if number < start:
                continue

            name: tuple[int | str, ...] = (number, *self._epochs.rank())
            if self.identity is not None:
                name = (self._read_identity(sample),)
            pair = self._make_pair(sample, name[0], keyed_generator(self.seed, "pairs", epoch, *name))
            self._epochs.at(number + 1)
            yield pair

        self._epochs.end()

    def _make_pair(self, sample: Any, name: int | str, generator: torch.Generator) -> Any:
        picture_key = find_picture(sample, self.key)
        picture = get_picture(sample, picture_key)

        try:
            patch, crop = self.augment.draw_patch(picture, self.crop, self.views, generator, self.zoom, self.bgr)
            chosen = self.augment.look(picture, self.bgr)
            batch = self.augment.make_pair(patch[None], generator, crop[None], chosen)
        except ValueError as error:
            raise ValueError(f"picture {name}: {error}") from error

        pair = batch.map(lambda tensor: tensor[0])
        return replace_picture(sample, picture_key, self.form(pair, self._sample_name(name), patch))

    def _read_identity(self, sample: Any) -> int | str:
        try:
            value = sample[self.identity]
        except (KeyError, IndexError, TypeError) as error:
            raise ValueError(f"identity={self.identity!r}: the samples have no such field") from error

        return value if isinstance(value, int) else str(value)


class _InOrder(IterableDataset[Any]):
    """The pictures of a folder as a stream."""

    def __init__(self, pictures: Any) -> None:
        self.pictures = pictures

    def __iter__(self) -> Iterator[Any]:
        for index in range(len(self.pictures)):
            yield self.pictures[index]

    def __len__(self) -> int:
        return len(self.pictures)

    def file(self, index: int) -> Path:
        path: Path = self.pictures.file(index)
        return path
