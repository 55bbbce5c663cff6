"""A Dataset of sRGB pictures as a Dataset of RAW pairs, with every draw keyed.

Sample i of epoch e comes from a generator seeded with BLAKE2b(seed, "pairs", e, i) alone. It draws the crop, then one
of eight flips and turns, then camera and noise. So the pairs do not depend on workers, start method or batch size.

The epoch advances by itself: it is the number of earlier requests for picture i (:mod:`rawaug.plugin.epochs`).
``set_epoch`` states it, and a picture that comes again in this epoch is drawn anew; ``freeze`` makes the same index the
same pair for good.
"""

from __future__ import annotations

import operator
from collections.abc import Sequence, Sized
from pathlib import Path
from typing import Any, Generic, Self, TypeVar, overload

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import Dataset, IterableDataset

from rawaug.camera.own import Camera
from rawaug.errors import count_of
from rawaug.isp.config import ISPParams
from rawaug.isp.model import DictionaryISP
from rawaug.plugin.augment import RawAugment
from rawaug.plugin.crops import crop_size, read_patch
from rawaug.plugin.epochs import Passes, Visits
from rawaug.plugin.maker import PairMaker
from rawaug.plugin.params import AugmentParams, Keys, RawPair, pair_form
from rawaug.plugin.pictures import Where, find_picture, get_picture, replace_picture
from rawaug.seeding import keyed_generator

Sample = TypeVar("Sample", covariant=True)

Maker = PairMaker | DictionaryISP | Camera | str | Path
"""Anything that makes pairs: an augmentation, or a camera for one with the default settings."""

Pictures = Dataset[Tensor] | Sequence[Tensor] | Sequence["np.ndarray[Any, Any]"] | str | Path
"""Pictures alone, without labels. The samples made of them are pairs."""


class Pairs(Dataset[Sample], Generic[Sample]):
    """The base of a Dataset and a stream of pairs: the settings, the epochs, and how a sample becomes a pair."""

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
    ) -> None:
        if not zoom >= 1.0 or (zoom > 1.0 and crop is None):
            raise ValueError(f"zoom must be at least 1, and 1 without a crop; got {zoom} with crop={crop}")

        self.augment = as_augment(augment)
        self.crop = crop_size(crop)
        self.form = pair_form(keys, fields, order)
        self.seed, self.key, self.views, self.bgr, self.zoom = seed, key, views, bgr, zoom
        self.dataset = self._open(dataset)
        self._epochs = self._make_epochs(self.dataset)
        if isinstance(self.augment, RawAugment):
            self.augment.load_kernels()

    def _open(self, dataset: Any) -> Any:
        """Open the folder of pictures if a path is given."""
        if isinstance(dataset, (str, Path)):
            return open_dataset(dataset, self.augment, self.crop)
        return dataset

    def _make_epochs(self, dataset: Any) -> Visits | Passes:
        raise NotImplementedError

    def set_epoch(self, epoch: int) -> None:
        """Begin an epoch: until the next call, a picture's first pair is that of this epoch.

        Call it before each pass to number the epochs yourself. A picture that comes again within the epoch, as from a
        sampler that draws with replacement, is drawn anew. It is forwarded to the dataset's own ``set_epoch``, if there
        is one. It does nothing after :meth:`freeze`.
        """
        self._epochs.pin(epoch)
        if hasattr(self.dataset, "set_epoch") and not self._epochs.frozen:
            self.dataset.set_epoch(epoch)

    def freeze(self, epoch: int = 0) -> Self:
        """Fix the pairs, as for validation: an index is the same pair whenever it is asked for, from now on.

        No later ``set_epoch`` changes that, by whichever library it is called.

        Args:
            epoch: the epoch whose pairs these are.

        Returns:
            The dataset itself.

        Example:
            >>> pairs = RawPairs([torch.rand(3, 32, 32)], "universal", crop=32).freeze()
            >>> torch.equal(pairs[0].noisy, pairs[0].noisy)
            True
        """
        self.set_epoch(epoch)
        self._epochs.freeze(epoch)
        return self

    def state_dict(self) -> dict[str, Any]:
        """The state from which :meth:`load_state_dict` goes on with the draws that follow.

        It is exact between passes, and in the middle of a pass without workers or with a pinned epoch. It cannot be
        exact once workers have fetched pictures ahead, and then :meth:`load_state_dict` refuses it.
        :func:`rawaug.resumable` makes a loader whose state is exact anywhere.
        """
        return self._epochs.state_dict()

    def load_state_dict(self, state: dict[str, Any], next_epoch: bool = False) -> None:
        """Go on from ``state``; call this while no loader is in the middle of a pass.

        Args:
            state: a state from :meth:`state_dict`.
            next_epoch: begin the next epoch if the state is from the middle of a pass.

        Raises:
            ValueError: if the state is of other pictures, or of the middle of a pass that cannot go on exactly.
        """
        self._epochs.load_state_dict(state, next_epoch)
        if self._epochs.pinned is not None and hasattr(self.dataset, "set_epoch"):
            self.dataset.set_epoch(self._epochs.pinned)

    def __len__(self) -> int:
        if not isinstance(self.dataset, Sized):
            raise TypeError(f"{type(self.dataset).__name__} has no length, so neither have its RAW pairs")
        return len(self.dataset)

    def __repr__(self) -> str:
        """Describe the pictures, the crop and the seed in a line, then what the augmentation draws."""
        pictures = type(self.dataset).__name__
        if isinstance(self.dataset, Sized):
            pictures = count_of(len(self.dataset), "picture")

        crop = "uncropped"
        if self.crop is not None:
            crop = f"crops of {self.crop[0]} x {self.crop[1]}"
        return f"{type(self).__name__} of {pictures}, {crop}, seed {self.seed}\n{self.augment!r}"

    def _sample_name(self, number: int | str) -> str:
        """The name of a picture: the name of its file if the dataset knows it, else its number."""
        if not isinstance(number, int):
            return str(number)
        if hasattr(self.dataset, "file"):
            return str(self.dataset.file(number))

        names = getattr(self.dataset, "names", None)
        if isinstance(names, Sequence):
            return str(names[number])
        return str(number)

    def __getattr__(self, name: str) -> Any:
        """Look up attributes of the dataset, such as ``classes``."""
        if name.startswith("_") or "dataset" not in self.__dict__:
            raise AttributeError(name)
        return getattr(self.dataset, name)


class RawPairs(Pairs[Sample]):
    """A Dataset of pictures as a Dataset of RAW pairs.

    Args:
        dataset: has ``len`` and an index, and yields pictures in any form that :mod:`rawaug.plugin.pictures` lists, or
            tuples or mappings that contain one. All other fields pass through, and the dataset's attributes can be read
            from the pairs. It may also be the path of a folder of pictures, or ``kind:path``
            (:func:`rawaug.data.open_pictures`).
        augment: makes the pairs; it must be on the CPU if workers are to run it. An ISP, its name or its path, or a
            :class:`rawaug.Camera` stands for a :class:`RawAugment` of it with the default settings. A
            :class:`rawaug.RawNoise` makes pairs of clean RAW: ``dataset`` then yields frames, or is the path of a
            folder of RAW files.
        crop: side of the square crop in pixels of the picture, or (height, width), even; None keeps whole pictures
            (made even by dropping a line). Packed RAW has half as many rows and columns: a BasicSR ``gt_size`` of 128
            packed pixels is a crop of 256.
        seed: decides all draws, together with the epoch and the index.
        key: name of the picture in samples that are mappings, its index in tuples (0 by default).
        views: whether to draw flips and quarter turns; a crop that is not square is only flipped.
        keys: names for the pair's noisy, clean, variance and params, in this order, as many as are wanted. The pair is
            then a dict of these; in samples that are mappings they replace the picture. Or a mapping from names to
            these fields, to ``name`` (the picture's name), ``level`` (the strength of its noise) or ``picture`` (the
            crop as it was cut and turned, in [0, 1]), such as ``{"L": "noisy", "H": "clean", "L_path": "name"}``.
        fields: as many of the same fields as are wanted, such as ``("clean", "noisy")``. The pair is then a tuple.
        order: order of the planes of packed RAW: a CFA, for the order that ``pixel_unshuffle`` of such a mosaic gives;
            ``"RGBG"`` or the like, in which the first G is Gr; or four names of R, Gr, Gb, B. By default R, Gr, Gb, B.
        bgr: whether pictures have their channels in the order B, G, R, as ``cv2.imread`` gives them.
        zoom: half of the crops are enlarged by up to this factor (bicubic), drawn log-uniformly; 1 for none. Pictures
            scaled down for the screen are sharper, pixel by pixel, than RAW of a lens and an optical low-pass filter.

    Raises:
        TypeError: if ``augment`` is none of these, or ``dataset`` has no index; for that, use a :class:`RawPairStream`.
        ValueError: if the crop is odd, the zoom is less than 1 or has no crop, or, on access, if a sample is smaller
            than the crop or is no picture.

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

    # The type of a sample follows from the pictures and from how pairs are handed over.
    @overload
    def __init__(
        self: RawPairs[RawPair],
        dataset: Pictures,
        augment: Maker,
        crop: int | tuple[int, int] | None = 256,
        *,
        seed: int = 0,
        key: None = None,
        views: bool = True,
        keys: None = None,
        fields: None = None,
        order: str | Sequence[str] | None = None,
        bgr: bool = False,
        zoom: float = 1.0,
    ) -> None: ...
    @overload
    def __init__(
        self: RawPairs[dict[str, Any]],
        dataset: Pictures,
        augment: Maker,
        crop: int | tuple[int, int] | None = 256,
        *,
        seed: int = 0,
        key: None = None,
        views: bool = True,
        keys: Keys,
        fields: None = None,
        order: str | Sequence[str] | None = None,
        bgr: bool = False,
        zoom: float = 1.0,
    ) -> None: ...
    @overload
    def __init__(
        self: RawPairs[Any],
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
    ) -> None: ...
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

    def _make_epochs(self, dataset: Any) -> Visits:
        has_index = hasattr(dataset, "__getitem__")
        if isinstance(dataset, IterableDataset):  # MosaicML's StreamingDataset has an index, too
            has_index = type(dataset).__getitem__ is not Dataset.__getitem__
        if not has_index:
            raise TypeError(
                f"{type(dataset).__name__} has no index; use RawPairStream(dataset, augment) for an iterable"
            )
        if not isinstance(dataset, Sized):
            return Visits(0)
        return Visits(len(dataset))

    def __getitem__(self, index: int) -> Sample:
        return self.__getitems__([index])[0]

    def __getitems__(self, indices: Sequence[int]) -> list[Sample]:
        """Make the pairs of a batch, as a DataLoader asks for them: the same bits as one by one, and faster."""
        length = len(self)
        numbers = []
        for index in indices:
            number = operator.index(index)
            if not -length <= number < length:  # an IndexError ends iteration, too
                raise IndexError(f"there is no pair {number}: the dataset has {count_of(length, 'picture')}")
            numbers.append(number % length)

        self._epochs.fetch(len(numbers))
        generators = [keyed_generator(self.seed, "pairs", *self._epochs.key(number)) for number in numbers]
        return self._draw_samples(numbers, generators)

    def draw(self, index: int, generator: torch.Generator) -> Sample:
        """Draw the pair of picture ``index`` from a generator on the CPU; no epoch is counted.

        Returns:
            The dataset's sample with the pair, without the leading B, in place of the picture.
        """
        return self._draw_samples([index], [generator])[0]

    def draw_batch(self, indices: Sequence[int], generators: Sequence[torch.Generator]) -> RawPair:
        """Draw the same pairs as :meth:`draw`, bit for bit, but as one batch.

        Args:
            indices: B indices of a dataset whose samples are pictures alone; ``crop`` must be set.
            generators: one generator for each index.
        """
        pair: RawPair = self.augment.apply(*self.cut_batch(indices, generators))
        return pair

    def cut_batch(self, indices: Sequence[int], generators: Sequence[torch.Generator]) -> tuple[Tensor, AugmentParams]:
        """Draw the crops ``(B, 3, h, w)`` and the parameters of :meth:`draw_batch`, whose pairs any device can make."""
        _, patches, places, chosen = self._cut(indices, generators)
        batch = torch.stack(patches)
        return batch, self.augment.sample_each(batch, generators, torch.stack(places), chosen)

    def _draw_samples(self, indices: Sequence[int], generators: Sequence[torch.Generator]) -> list[Sample]:
        samples, patches, places, chosen = self._cut(indices, generators)

        groups = [range(len(patches))]
        if not self.augment.is_row_exact or len({(patch.shape, patch.dtype) for patch in patches}) > 1:
            groups = [range(number, number + 1) for number in range(len(patches))]

        finished: list[Any] = []
        for group in groups:
            batch = torch.stack([patches[number] for number in group])
            crops = torch.stack([places[number] for number in group])
            drawn_by, of_group = [generators[number] for number in group], [chosen[number] for number in group]
            try:
                pairs = self.augment.make_each(batch, drawn_by, crops, of_group)
            except ValueError as error:
                names = ", ".join(str(indices[number]) for number in group)
                raise ValueError(f"picture {names}: {error}") from error

            for row, number in enumerate(group):
                pair = RawPair(pairs.noisy[row], pairs.clean[row], pairs.variance[row], pairs.params)
                if self.form.reads_params:  # to take a row of ten small tensors costs as much as to make its pixels
                    pair = pair._replace(params=pairs.params.map(operator.itemgetter(row)))
                name = None
                if self.form.fields and "name" in self.form.fields:
                    name = self._sample_name(indices[number])
                form = self.form(pair, name, batch[row])
                finished.append(replace_picture(*samples[number], form))
        return finished

    def _cut(
        self, indices: Sequence[int], generators: Sequence[torch.Generator]
    ) -> tuple[list[tuple[Any, Where]], list[Tensor], list[Tensor], list[ISPParams | None]]:
        """Draw a crop of each picture and cut it out.

        Returns:
            The samples and where their pictures are, the patches ``(3, h, w)``, their places ``(5,)``, and the settings
            ``(1, ...)`` that were chosen for the whole pictures.
        """
        samples: list[tuple[Any, Where]] = []
        patches, places, settings = [], [], []
        for index, generator in zip(indices, generators, strict=True):
            sample: Any = None
            picture_key: Where = None
            chosen: ISPParams | None = None
            try:
                if self._reads_parts and self.crop is not None:
                    cut = read_patch(self.dataset, index, self.crop, self.views, generator, self.zoom, self.bgr)
                else:
                    sample = self.dataset[index]
                    picture_key = find_picture(sample, self.key)
                    picture = get_picture(sample, picture_key)
                    cut = self.augment.draw_patch(picture, self.crop, self.views, generator, self.zoom, self.bgr)
                    chosen = self.augment.look(picture, self.bgr)
            except ValueError as error:
                raise ValueError(f"picture {index}: {error}") from error

            samples.append((sample, picture_key))
            patches.append(cut[0])
            places.append(cut[1])
            settings.append(chosen)
        return samples, patches, places, settings

    @property
    def _reads_parts(self) -> bool:
        """Whether only the crops of pictures have to be read: nothing is chosen by what whole pictures show."""
        if not hasattr(self.dataset, "read_part") or not isinstance(self.augment, RawAugment):
            return False
        return not self.augment.settings.looks

    def replay(self, index: int, params: AugmentParams) -> RawPair:
        """Make the pair of picture ``index`` again from its parameters, without the leading B, whatever the seed is.

        Raises:
            ValueError: if the parameters were drawn for a picture of another size.
        """
        sample = self.dataset[index]
        picture = get_picture(sample, find_picture(sample, self.key))
        patch = self.augment.cut_patch(picture, params.crop, self.crop, self.bgr)
        pair: RawPair = self.augment.apply(patch, params)
        return pair


def as_augment(augment: Maker) -> PairMaker:
    """Return an augmentation as it is, or make one with the default settings of an ISP, its name or path, or a camera.

    Raises:
        TypeError: if it is something else.
    """
    if isinstance(augment, PairMaker):
        return augment
    if isinstance(augment, (DictionaryISP, Camera, str, Path)):
        return RawAugment.from_pretrained(augment)
    raise TypeError(
        f"augment must be a RawAugment, a RawNoise, a Camera, or an ISP, its name or path; got {type(augment).__name__}"
    )


def open_dataset(path: str | Path, augment: PairMaker, size: tuple[int, int] | None) -> Any:
    """Open the pictures, or the clean RAW, of a folder or of ``kind:path``, with an index.

    Args:
        path: path of a folder or a file, or ``kind:path``.
        augment: decides whether these are pictures or RAW.
        size: size of the crops; smaller pictures are left out, and the folder reports them.
    """
    return augment.open_folder(path, size)
