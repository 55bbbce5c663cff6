"""A Dataset of sRGB pictures as a Dataset of RAW pairs, every draw keyed.

Sample i of epoch e comes from a generator seeded with BLAKE2b(seed, "pairs", e, i) alone: first its
crop, then one of eight flips and turns, then camera and noise. So the pairs are the same with any number of workers,
any start method, any batch size, and after a resume in the middle of an epoch.
"""

from __future__ import annotations

from collections.abc import Iterator, Sized
from typing import Any, SupportsIndex

import torch
from torch import Tensor
from torch.utils.data import Dataset, IterableDataset, get_worker_info

from rawaug import bayer
from rawaug.plugin.augment import RawAugment
from rawaug.plugin.params import AugmentParams, RawPair
from rawaug.plugin.pictures import even_sided, find_picture, picked, replaced, to_rgb_tensor
from rawaug.seeding import keyed_generator


class RawPairs(Dataset[Any]):
    """Any Dataset of pictures as a Dataset of RAW pairs; of an iterable one it is a :class:`RawPairStream`.

    Args:
        dataset: yields pictures (tensor, NumPy array or PIL picture, HWC or CHW, grey or RGBA too: see
            :mod:`rawaug.plugin.pictures`), or tuples or mappings that have one. All other fields pass through.
        augment: makes the pair; on the CPU where workers are to run it.
        crop: side of the square crop in pixels, even; None keeps whole pictures (made even by dropping a line).
        seed: of all draws.
        key: name of the picture in samples that are mappings, its index in tuples (0 by default).
        turns: whether to draw flips and quarter turns; whole pictures are only flipped.

    Raises:
        ValueError: if the crop is odd, or, on access, if a picture is smaller than the crop or none.

    Example:
        >>> from rawaug.isp.model import DictionaryISP
        >>> pictures = [torch.rand(3, 40, 48), torch.rand(3, 33, 64)]
        >>> pairs = RawPairs(pictures, RawAugment(DictionaryISP()), crop=32)
        >>> pairs[1].noisy.shape
        torch.Size([4, 16, 16])
    """

    def __new__(cls, dataset: Any = None, *args: Any, **settings: Any) -> RawPairs:
        iterable = isinstance(dataset, IterableDataset) or (dataset is not None and not hasattr(dataset, "__getitem__"))
        return super().__new__(RawPairStream if cls is RawPairs and iterable else cls)

    def __init__(
        self,
        dataset: Any,
        augment: RawAugment,
        crop: int | None = 256,
        seed: int = 0,
        key: str | int | None = None,
        turns: bool = True,
    ) -> None:
        self.dataset, self.augment, self.crop, self.seed, self.key = dataset, augment, crop, seed, key
        self.turns = turns
        if crop is not None:
            bayer.RandomCrop(int(crop))  # raises for an odd crop here, not in a worker
        self._epoch = torch.zeros(1, dtype=torch.int64).share_memory_()  # persistent workers see it change

    def set_epoch(self, epoch: int) -> None:
        """Select the epoch's draws; call before each epoch. Forwarded to the dataset's own ``set_epoch``, if any."""
        self._epoch[0] = epoch
        if hasattr(self.dataset, "set_epoch"):
            self.dataset.set_epoch(epoch)

    def __len__(self) -> int:
        if not isinstance(self.dataset, Sized):
            raise TypeError(f"{type(self.dataset).__name__} has no length, so neither have its RAW pairs")
        return len(self.dataset)

    def __getitem__(self, index: int) -> Any:
        if not isinstance(index, SupportsIndex):
            raise TypeError(
                f"the index must be an integer, got {type(index).__name__}; for slices use torch.utils.data.Subset"
            )
        index = range(len(self))[index]  # IndexError ends iteration
        return self.draw(index, self._generator(index))

    def draw(self, index: int, generator: torch.Generator) -> Any:
        """The pair of picture ``index`` with all that is random taken from ``generator``."""
        return self._paired(self.dataset[index], index, generator)

    def replay(self, index: int, params: AugmentParams) -> RawPair:
        """The pair that ``params`` (those of one pair, without B) make of picture ``index``, whatever the seed is."""
        sample = self.dataset[index]
        picture = even_sided(to_rgb_tensor(picked(sample, find_picture(sample, self.key))))
        pair: RawPair = self.augment.apply(placed(picture, params.place, self.crop), params)
        return pair

    def _generator(self, key: int | str) -> torch.Generator:
        return keyed_generator(self.seed, "pairs", int(self._epoch), key)

    def _paired(self, sample: Any, name: int | str, generator: torch.Generator) -> Any:
        where = find_picture(sample, self.key)
        try:
            picture = even_sided(to_rgb_tensor(picked(sample, where)))
            place = random_place(picture, self.crop, self.turns, generator)
        except ValueError as error:
            raise ValueError(f"picture {name}: {error}") from error
        patch = placed(picture, place, self.crop)[None]
        pair: RawPair = self.augment.apply(patch, self.augment.sample(patch, generator, place[None]))
        return replaced(sample, where, pair.map(lambda t: t[0]))


class RawPairStream(RawPairs, IterableDataset[Any]):
    """An iterable Dataset of pictures as one of RAW pairs; what :class:`RawPairs` makes of it.

    A stream has no index. Without ``identity`` the n-th sample that worker w of W meets is number nW + w: no two share
    a draw, and where sample i goes to worker i mod W, each keeps its draws whatever W is. A dataset that hands out
    whole shards needs ``identity`` for that. Processes of a distributed run need it too, or a seed for each.

    Args:
        dataset: an iterable of samples, as for :class:`RawPairs`. It divides itself between workers, as those of
            WebDataset and Hugging Face do, or ``divide`` does.
        identity: name or index of the field that identifies a sample, such as ``"__key__"``; it keys the draws.
        divide: give sample i to worker i mod W, of a dataset that every worker would go through in full.
        augment, crop, seed, key, turns: as for :class:`RawPairs`.

    Example:
        >>> from rawaug.isp.model import DictionaryISP
        >>> stream = RawPairStream(iter([torch.rand(3, 40, 48)]), RawAugment(DictionaryISP()), crop=32)
        >>> [pair.noisy.shape for pair in stream]
        [torch.Size([4, 16, 16])]
    """

    def __init__(
        self,
        dataset: Any,
        augment: RawAugment,
        crop: int | None = 256,
        seed: int = 0,
        key: str | int | None = None,
        turns: bool = True,
        identity: str | int | None = None,
        divide: bool = False,
    ) -> None:
        super().__init__(dataset, augment, crop, seed, key, turns)
        self.identity, self.divide = identity, divide

    def __iter__(self) -> Iterator[Any]:
        info = get_worker_info()
        worker, workers = (info.id, info.num_workers) if info else (0, 1)
        for n, sample in enumerate(self.dataset):
            if self.divide and n % workers != worker:
                continue
            number = n if self.divide else n * workers + worker
            name = number if self.identity is None else self._identity(sample)
            yield self._paired(sample, name, self._generator(name))

    def __getitem__(self, index: int) -> Any:
        raise TypeError("a stream of RAW pairs cannot be indexed; iterate over it")

    def _identity(self, sample: Any) -> int | str:
        try:
            value = sample[self.identity]
        except (KeyError, IndexError, TypeError) as error:
            raise ValueError(f"identity={self.identity!r}: the samples have no such field") from error
        return value if isinstance(value, int) else str(value)


def random_place(picture: Tensor, crop: int | None, turns: bool, generator: torch.Generator) -> Tensor:
    """Position and turn of a crop of ``(3, H, W)``: ``(5,)`` top, left, height, width (H, W) and view.

    Raises:
        ValueError: if the picture is smaller than the crop.
    """
    height, width = picture.shape[-2:]
    size = (crop, crop) if crop else (height, width)
    corner = bayer.RandomCrop(size).sample(height, width, generator)
    turn = bayer.RandomTurn(bayer.CFA.RGGB, quarter=size[0] == size[1])
    view = turn.sample(generator) if turns else torch.tensor(0)
    return torch.cat([corner, torch.tensor([height, width]), view[None]])


def placed(picture: Tensor, place: Tensor, crop: int | None) -> Tensor:
    """The patch of a whole picture ``(3, H, W)`` at ``place``.

    Raises:
        ValueError: if the picture does not have the size it was drawn for.
    """
    top, left, height, width, view = place.tolist()
    if picture.shape[-2:] != (height, width):
        raise ValueError(f"the parameters belong to a picture of {height} x {width}, got {tuple(picture.shape[-2:])}")
    patch = bayer.crop(picture, top, left, crop or height, crop or width)
    return bayer.turn(patch, view).contiguous()
