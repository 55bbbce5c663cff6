"""A Dataset of sRGB pictures as a Dataset of RAW pairs, every draw keyed.

Sample i of epoch e comes from a generator seeded with BLAKE2b(seed, "pairs", e, i) alone: its crop, then one of eight
flips and turns, then camera and noise. So the pairs do not depend on workers, start method or batch size.

The epoch advances by itself: it is the number of times that picture i was asked for before
(:mod:`rawaug.plugin.epochs`). ``set_epoch`` pins it: from then on the same index is the same pair.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Iterator, Sequence, Sized
from pathlib import Path
from typing import Any, SupportsIndex

import torch
from torch import Tensor
from torch.nn import functional as F
from torch.utils.data import Dataset, IterableDataset, get_worker_info

from rawaug import bayer
from rawaug.isp.model import DictionaryISP
from rawaug.kernels.runtime import one_thread
from rawaug.plugin.augment import RawAugment
from rawaug.plugin.epochs import Passes, Visits
from rawaug.plugin.params import AugmentParams, RawPair, require_keys
from rawaug.plugin.pictures import find_picture, get_picture, replace_picture, to_rgb_tensor, trim_to_even
from rawaug.seeding import keyed_generator


class _Pairs(Dataset[Any]):
    """What a Dataset of pairs and a stream of them share: the settings, the epochs, and how a sample becomes a pair."""

    def __init__(
        self,
        dataset: Any,
        augment: RawAugment | DictionaryISP | str | Path,
        crop: int | tuple[int, int] | None = 256,
        *,
        seed: int = 0,
        key: str | int | None = None,
        turns: bool = True,
        keys: Sequence[str] | None = None,
        zoom: float = 1.0,
    ) -> None:
        if not zoom >= 1.0 or (zoom > 1.0 and crop is None):
            raise ValueError(f"zoom must be at least 1, and 1 without a crop; got {zoom} with crop={crop}")
        self._epochs = self._make_epochs(dataset)
        self.dataset, self.augment = dataset, as_augment(augment)
        self.crop, self.seed, self.turns, self.zoom = crop_size(crop), seed, turns, zoom
        self.key, self.keys = key, require_keys(keys)

    def _make_epochs(self, dataset: Any) -> Visits | Passes:
        raise NotImplementedError

    def set_epoch(self, epoch: int) -> None:
        """Pin the epoch: from now on an index is the same pair whenever it is asked for, until the next call.

        Call it before each pass to number the epochs yourself, or once for validation data. It is forwarded to the
        dataset's own ``set_epoch``, if there is one.
        """
        self._epochs.pin(epoch)
        if hasattr(self.dataset, "set_epoch"):
            self.dataset.set_epoch(epoch)

    def state_dict(self) -> dict[str, Any]:
        """The state from which :meth:`load_state_dict` goes on with the draws that follow.

        It is exact between passes, and in the middle of a pass without workers or with a pinned epoch. With workers,
        pictures that they had fetched ahead go on with their next draw.
        """
        return self._epochs.state_dict()

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from ``state``; call this while no loader is in the middle of a pass."""
        self._epochs.load_state_dict(state)
        if self._epochs.pinned is not None:
            self.set_epoch(self._epochs.pinned)

    def __len__(self) -> int:
        if not isinstance(self.dataset, Sized):
            raise TypeError(f"{type(self.dataset).__name__} has no length, so neither have its RAW pairs")
        return len(self.dataset)

    def __repr__(self) -> str:
        """The pictures, the crop and the seed in a line, then what the augmentation draws."""
        count = f"{len(self.dataset)} pictures" if isinstance(self.dataset, Sized) else type(self.dataset).__name__
        crop = "uncropped" if self.crop is None else f"crops of {self.crop[0]} x {self.crop[1]}"
        return f"{type(self).__name__} of {count}, {crop}, seed {self.seed}\n{self.augment!r}"

    def _generator(self, epoch: int, *names: int | str) -> torch.Generator:
        return keyed_generator(self.seed, "pairs", epoch, *names)

    def _make_pair(self, sample: Any, name: int | str, generator: torch.Generator) -> Any:
        where = find_picture(sample, self.key)
        try:
            patch, crop = draw_patch(get_picture(sample, where), self.crop, self.turns, generator, self.zoom)
            batch = self.augment.make_pair(patch[None], generator, crop[None])
        except ValueError as error:
            raise ValueError(f"picture {name}: {error}") from error
        pair = batch.map(lambda t: t[0])
        return replace_picture(sample, where, pair if self.keys is None else pair.as_dict(self.keys))


class RawPairs(_Pairs):
    """A Dataset of pictures as a Dataset of RAW pairs.

    Args:
        dataset: has ``len`` and an index, and yields pictures in any form that :mod:`rawaug.plugin.pictures` lists, or
            tuples or mappings that have one. All other fields pass through.
        augment: makes the pair, on the CPU where workers are to run it; or an ISP, its name or its path, for a
            :class:`RawAugment` of it with the default settings.
        crop: side of the square crop in pixels, or (height, width), even; None keeps whole pictures (made even by
            dropping a line).
        seed: decides all draws, together with the epoch and the index.
        key: name of the picture in samples that are mappings, its index in tuples (0 by default).
        turns: whether to draw flips and quarter turns; what is not square is only flipped.
        keys: names for the pair's noisy, clean, variance and params, in this order, as many as are wanted: the pair is
            then a dict of these. In samples that are mappings they stand in place of the picture.
        zoom: half of the crops are enlarged by up to this factor (bicubic), drawn log-uniformly; 1 for none. Pictures
            scaled down for the screen are sharper, pixel by pixel, than RAW of a lens and an optical low-pass filter.

    Raises:
        TypeError: if ``augment`` is none of these, or ``dataset`` has no index: a :class:`RawPairStream` takes it.
        ValueError: if the crop is odd, the zoom less than 1 or without a crop, or, on access, if a picture is smaller
            than the crop or none.

    Example:
        >>> from rawaug.isp.model import DictionaryISP
        >>> pictures = [torch.rand(3, 40, 48), torch.rand(3, 33, 64)]
        >>> pairs = RawPairs(pictures, RawAugment(DictionaryISP()), crop=32)
        >>> pairs[1].noisy.shape
        torch.Size([4, 16, 16])
        >>> sample = RawPairs(pictures, RawAugment(DictionaryISP()), crop=(16, 32), keys=("noisy", "clean"))[0]
        >>> sample["noisy"].shape
        torch.Size([4, 8, 16])
    """

    _epochs: Visits

    def _make_epochs(self, dataset: Any) -> Visits:
        if isinstance(dataset, IterableDataset) or not hasattr(dataset, "__getitem__"):
            raise TypeError(
                f"{type(dataset).__name__} has no index; use RawPairStream(dataset, augment) for an iterable"
            )
        return Visits(len(dataset) if isinstance(dataset, Sized) else 0)

    def __getitem__(self, index: int) -> Any:
        index = range(len(self))[operator.index(index)]  # an IndexError ends iteration
        return self.draw(index, self._generator(*self._epochs.key(index)))

    def draw(self, index: int, generator: torch.Generator) -> Any:
        """Draw the pair of picture ``index`` from a generator on the CPU; no epoch is counted.

        Returns:
            The sample of the dataset with the pair, without B, in place of the picture.
        """
        return self._make_pair(self.dataset[index], index, generator)

    def draw_batch(self, indices: Sequence[int], generators: Sequence[torch.Generator]) -> RawPair:
        """Draw the pairs of :meth:`draw`, bit for bit, as one batch, which is faster for small crops.

        Args:
            indices: B indices of a dataset whose samples are pictures alone; ``crop`` must be set.
            generators: one for each.
        """
        drawn, patches = [], []
        for index, generator in zip(indices, generators, strict=True):
            patch, crop = draw_patch(self.dataset[index], self.crop, self.turns, generator, self.zoom)
            patches.append(patch[None])
            drawn.append(self.augment.sample(patches[-1], generator, crop[None]))
        pair: RawPair = self.augment.apply(torch.cat(patches), AugmentParams.concatenate(drawn))
        return pair

    def replay(self, index: int, params: AugmentParams) -> RawPair:
        """Make the pair of picture ``index`` again from the parameters of one pair, without B, whatever the seed is.

        Raises:
            ValueError: if the picture is of another size than the one that they were drawn for.
        """
        sample = self.dataset[index]
        picture = trim_to_even(to_rgb_tensor(get_picture(sample, find_picture(sample, self.key))))
        pair: RawPair = self.augment.apply(cut_patch(picture, params.crop, self.crop), params)
        return pair


class RawPairStream(_Pairs, IterableDataset[Any]):
    """An iterable Dataset of pictures as one of RAW pairs.

    A stream has no index. Without ``identity`` the n-th sample that worker w of W meets is number nW + w: no two share
    a draw, and where sample i goes to worker i mod W, each keeps its draws whatever W is. A dataset that distributes
    whole shards needs ``identity`` for that. Processes of a distributed run draw apart, by their rank, unless it is
    given. Each pass is a new epoch, unless one is pinned.

    Args:
        dataset: an iterable of samples, which are as for :class:`RawPairs`. It divides itself between workers, as those
            of WebDataset and Hugging Face do, or ``divide`` does.
        augment, crop, seed, key, turns, keys, zoom: as for :class:`RawPairs`.
        identity: name or index of the field that identifies a sample, such as ``"__key__"``; it keys the draws.
        divide: give sample i to worker i mod W, of a dataset that every worker would go through in full.

    Example:
        >>> from rawaug.isp.model import DictionaryISP
        >>> stream = RawPairStream(iter([torch.rand(3, 40, 48)]), RawAugment(DictionaryISP()), crop=32)
        >>> [pair.noisy.shape for pair in stream]
        [torch.Size([4, 16, 16])]
    """

    _epochs: Passes

    def __init__(
        self,
        dataset: Any,
        augment: RawAugment | DictionaryISP | str | Path,
        crop: int | tuple[int, int] | None = 256,
        *,
        seed: int = 0,
        key: str | int | None = None,
        turns: bool = True,
        keys: Sequence[str] | None = None,
        zoom: float = 1.0,
        identity: str | int | None = None,
        divide: bool = False,
    ) -> None:
        super().__init__(dataset, augment, crop, seed=seed, key=key, turns=turns, keys=keys, zoom=zoom)
        self.identity, self.divide = identity, divide

    def _make_epochs(self, dataset: Any) -> Passes:
        return Passes()

    def __iter__(self) -> Iterator[Any]:
        info = get_worker_info()
        epoch, start = self._epochs.begin(info.num_workers if info else 0, info.id if info else 0)  # now, not at next()
        return self._samples(epoch, start, *((info.id, info.num_workers) if info else (0, 1)))

    def _samples(self, epoch: int, start: int, worker: int, workers: int) -> Iterator[Any]:
        for n, sample in enumerate(self.dataset):
            number = n if self.divide else n * workers + worker
            if number < start or (self.divide and n % workers != worker):
                continue
            name = (number, *self._epochs.rank()) if self.identity is None else (self._read_identity(sample),)
            pair = self._make_pair(sample, name[0], self._generator(epoch, *name))
            self._epochs.at(number + 1)
            yield pair
        self._epochs.end()

    def _read_identity(self, sample: Any) -> int | str:
        try:
            value = sample[self.identity]
        except (KeyError, IndexError, TypeError) as error:
            raise ValueError(f"identity={self.identity!r}: the samples have no such field") from error
        return value if isinstance(value, int) else str(value)


def as_augment(augment: RawAugment | DictionaryISP | str | Path) -> RawAugment:
    """An augmentation as it is, or one of an ISP, its name or its path, with the default settings.

    Raises:
        TypeError: if it is something else.
    """
    if isinstance(augment, RawAugment):
        return augment
    if isinstance(augment, (DictionaryISP, str, Path)):
        return RawAugment.from_pretrained(augment)
    raise TypeError(f"augment must be a RawAugment, or an ISP, its name or path; got {type(augment).__name__}")


def crop_size(crop: int | Sequence[int] | None) -> tuple[int, int] | None:
    """Height and width of a crop that is given as a side or as both; None means whole pictures.

    Raises:
        ValueError: if a side is odd, or it is neither.
    """
    if crop is None:
        return None
    sides = (crop, crop) if isinstance(crop, SupportsIndex) else tuple(crop) if isinstance(crop, Sequence) else ()
    if len(sides) != 2 or not all(isinstance(side, SupportsIndex) for side in sides):
        raise ValueError(f"crop must be an even side or (height, width), got {crop!r}")
    height, width = (int(side) for side in sides)
    return bayer.RandomCrop((height, width)).size


def draw_crop(
    picture: Tensor, size: tuple[int, int] | None, turns: bool, generator: torch.Generator, zoom: float = 1.0
) -> Tensor:
    """Draw where a picture is cropped and how the crop is turned, as :class:`AugmentParams` keeps it.

    Args:
        picture: ``(3, H, W)`` with even sides.
        size: height and width of the crop; None for the whole picture.
        turns: whether flips are drawn, and, of a square, quarter turns.
        generator: on the CPU.
        zoom: half of the crops are enlarged by up to this factor.

    Returns:
        ``(5,)`` top, left, H, W, view; with a zoom ``(6,)``, where the last is the number of rows that are enlarged.
    """
    height, width = picture.shape[-2:]
    region = size or (height, width)
    if size and zoom > 1.0:
        share, drawn = torch.rand(2, generator=generator).tolist()
        rows = size[0] if share < 0.5 else math.ceil(size[0] / 2 * zoom**-drawn) * 2
        return torch.cat([draw_crop(picture, _region(size, rows), turns, generator), torch.tensor([rows])])
    corner = bayer.RandomCrop(region).sample(height, width, generator)
    turn = bayer.RandomTurn(bayer.CFA.RGGB, quarter=region[0] == region[1])
    view = turn.sample(generator) if turns else torch.tensor(0)
    return torch.cat([corner, torch.tensor([height, width]), view[None]])


def draw_patch(
    picture: Any, size: tuple[int, int] | None, turns: bool, generator: torch.Generator, zoom: float = 1.0
) -> tuple[Tensor, Tensor]:
    """Draw a crop of a picture in any form, and cut it out.

    Args:
        picture: in any form that :mod:`rawaug.plugin.pictures` lists.
        size: height and width of the crop; None for the whole picture.
        turns, generator, zoom: as for :func:`draw_crop`.

    Returns:
        The patch ``(3, *size)``, uint8 or float32, and its crop ``(5,)`` or ``(6,)``.
    """
    whole = trim_to_even(to_rgb_tensor(picture))
    crop = draw_crop(whole, size, turns, generator, zoom)
    return cut_patch(whole, crop, size), crop


def cut_patch(picture: Tensor, crop: Tensor, size: tuple[int, int] | None) -> Tensor:
    """Cut the patch ``(3, *size)`` that a drawn crop ``(5,)`` or ``(6,)`` means out of a whole picture ``(3, H, W)``.

    Raises:
        ValueError: if the crop was drawn for a picture of another size.
    """
    top, left, height, width, view, rows = (*crop.tolist(), 0)[:6]
    if picture.shape[-2:] != (height, width):
        raise ValueError(f"the parameters belong to a picture of {height} x {width}, got {tuple(picture.shape[-2:])}")
    patch = bayer.crop(picture, top, left, *(_region(size, rows) if size else (height, width)))
    if size and patch.shape[-2:] != size:
        patch = enlarge(patch, size)
    return bayer.turn(patch, view).contiguous()


def _region(size: tuple[int, int], rows: int) -> tuple[int, int]:
    """Even height and width of the ``rows`` that are enlarged to the crop; 0 rows for the crop itself."""
    return (rows, math.ceil(size[1] * rows / size[0] / 2) * 2) if rows else size


def enlarge(patch: Tensor, size: tuple[int, int]) -> Tensor:
    """Enlarge a patch ``(3, h, w)`` to ``(3, *size)`` by bicubic interpolation; it keeps its type, uint8 or float."""
    with one_thread():  # the same bits everywhere
        larger = F.interpolate(patch[None].float(), size=size, mode="bicubic", align_corners=False)[0]
    if patch.dtype == torch.uint8:
        return larger.round_().clamp_(0, 255).to(torch.uint8)
    return larger.clamp_(0.0, 1.0).to(patch.dtype)
