"""The base of everything that makes pairs: parameters are drawn first and applied afterwards.

:class:`rawaug.RawAugment` makes pairs from pictures, :class:`rawaug.RawNoise` from clean RAW. Each defines its inputs,
how their parameters are drawn (:meth:`PairMaker.draw_params`), and how the parameters make a pair
(:meth:`PairMaker.apply_params`). What surrounds these two is written here once: single inputs and batches, tuples and
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, overload

import torch
from torch import Tensor, nn
from torch.utils.data import get_worker_info

from rawaug.isp.config import ISPParams
from rawaug.kernels.runtime import eager
from rawaug.plugin.params import AugmentParams, RawPair
from rawaug.plugin.pictures import Where, find_picture, get_picture, replace_picture
from rawaug.seeding import keyed_generator, rank_key


class PairMaker(nn.Module, ABC):
    """Base of the modules that make pairs from batches.

    Args:
        seed: seed of the module's own draws, used where no generator is passed. They are counted from its construction:
            to resume, pass a generator, or use RawPairs or wrap.
    """

    stream: ClassVar[str]
    """Key of the module's own draws, in addition to the seed."""

    def __init__(self, seed: int) -> None:
        super().__init__()
        self.seed = seed
        self._calls = 0
        self._rank: tuple[int, ...] = ()

    # -- what a subclass says -----------------------------------------------------------------------------------------

    @property
    @abstractmethod
    def device(self) -> torch.device:
        """The device that pairs are made on."""

    @property
    def is_row_exact(self) -> bool:
        """Whether the pairs of a batch have the bits that each has alone."""
        return True

    @abstractmethod
    def open_folder(self, path: str | Path, size: tuple[int, int] | None) -> Any:
        """Open the inputs of a folder, or of ``kind:path``, as a Dataset; ``size`` is the size of the crops."""

    @abstractmethod
    def is_single(self, inputs: Any) -> bool:
        """Whether this is one input, and not a batch."""

    @abstractmethod
    def as_batch(self, inputs: Any, bgr: bool = False) -> Tensor:
        """Convert inputs of one size, in any form, to a batch ``(B, C, H, W)``."""

    @abstractmethod
    def stack(self, patches: Sequence[Tensor]) -> Tensor:
        """Stack patches of one size to a batch ``(B, C, H, W)``; ValueError if they differ."""

    @abstractmethod
    def draw_patch(
        self,
        whole: Any,
        size: tuple[int, int] | None,
        views: bool,
        generator: torch.Generator,
        zoom: float = 1.0,
        bgr: bool = False,
    ) -> tuple[Tensor, Tensor]:
        """Draw a crop of an input and cut it out; return the patch and its place as :class:`AugmentParams` keeps it."""

    @abstractmethod
    def cut_patch(self, whole: Any, place: Tensor, size: tuple[int, int] | None, bgr: bool = False) -> Tensor:
        """Cut the patch of a drawn place out of an input."""

    def look(self, whole: Any, bgr: bool = False) -> ISPParams | None:
        """Choose the setting of a whole input, for the draws of its crops; None if they do not look at the input.

        Args:
            whole: the input, or None if it is unknown.
            bgr: as for :meth:`as_batch`.
        """
        return None

    @abstractmethod
    def draw_params(
        self, batch: Tensor, generator: torch.Generator, crop: Tensor | None, chosen: ISPParams | None = None
    ) -> AugmentParams:
        """Draw the parameters of a batch ``(B, C, H, W)``; the rest is as for :meth:`sample`."""

    @abstractmethod
    def apply_params(self, batch: Tensor, params: AugmentParams) -> RawPair:
        """Make the pairs of a batch ``(B, C, H, W)`` that the parameters describe."""

    def find(self, sample: Any, key: str | int | None) -> Where:
        """Find the inputs in a loader's batch; None if the batch is nothing else."""
        return find_picture(sample, key, batched=True)

    # -- draw, apply --------------------------------------------------------------------------------------------------

    @eager
    def sample(
        self,
        inputs: Any,
        generator: torch.Generator | None = None,
        crop: Tensor | None = None,
        chosen: ISPParams | None = None,
    ) -> AugmentParams:
        """Draw the parameters of a batch; the parameters of a single input have no leading B.

        Args:
            inputs: a batch or a single input, in any form that the class lists.
            generator: a generator on the CPU; the module's own by default.
            crop: ``(B, 5)`` if the inputs lie in larger frames, as in :class:`AugmentParams`; by default they are full
                frames.
            chosen: what :meth:`look` chose for the whole inputs; by default it is what the inputs themselves suggest,
                or the constants if they lie in larger frames.
        """
        params = self.draw_params(self._batch(inputs), generator or self._own_generator(), crop, chosen)
        if self.is_single(inputs):
            return params.map(_first)
        return params

    @eager
    def sample_each(
        self,
        batch: Tensor,
        generators: Sequence[torch.Generator],
        crops: Tensor,
        chosen: Sequence[ISPParams | None],
    ) -> AugmentParams:
        """Draw the parameters of each input from a generator of its own: the same numbers as of each alone.

        Args:
            batch: ``(B, C, H, W)``.
            generators: B generators on the CPU.
            crops: ``(B, 5)``, as for :meth:`sample`.
            chosen: what :meth:`look` chose for each of the whole inputs.
        """
        inputs = zip(batch.split(1), generators, crops.split(1), chosen, strict=True)
        return AugmentParams.concatenate([self.draw_params(*each) for each in inputs])

    @eager
    def make_each(
        self,
        batch: Tensor,
        generators: Sequence[torch.Generator],
        crops: Tensor,
        chosen: Sequence[ISPParams | None],
    ) -> RawPair:
        """Make pairs, each drawn from a generator of its own; the arguments are as for :meth:`sample_each`."""
        return self.apply_params(batch, self.sample_each(batch, generators, crops, chosen))

    @eager
    def apply(self, inputs: Any, params: AugmentParams | None = None) -> Any:
        """Make the :class:`RawPair` that the parameters describe, bit for bit the same at every call.

        Args:
            inputs: as for :meth:`sample`. A function alone, as a surrounding module may pass it, goes to
                ``nn.Module.apply``.
            params: parameters of as many inputs; for a single one they and the pair have no leading B.

        Raises:
            ValueError: if there is no batch, or ``params`` are for another number of inputs.
        """
        if params is None:
            return super().apply(inputs)
        if not isinstance(params, AugmentParams):
            raise ValueError(f"apply takes the params of a pair, pair.params, got {type(params).__name__}")

        batch = self._batch(inputs)
        if self.is_single(inputs):
            return self.apply_params(batch, params.map(_as_batch)).map(_first)
        return self.apply_params(batch, params)

    @eager
    def make_pair(
        self,
        batch: Tensor,
        generator: torch.Generator,
        crop: Tensor | None = None,
        chosen: ISPParams | None = None,
    ) -> RawPair:
        """Sample, then apply, without converting the inputs.

        Args:
            batch: ``(B, C, H, W)`` as :meth:`as_batch` gives it, on the module's device.
            generator: a generator on the CPU.
            crop, chosen: as for :meth:`sample`.
        """
        return self.apply_params(batch, self.draw_params(batch, generator, crop, chosen))

    @overload
    def forward(self, batch: Tensor, generator: torch.Generator | None = None, key: None = None) -> RawPair: ...
    @overload
    def forward(self, batch: Any, generator: torch.Generator | None = None, key: str | int | None = None) -> Any: ...
    @eager
    def forward(self, batch: Any, generator: torch.Generator | None = None, key: str | int | None = None) -> Any:
        """Draw parameters for a batch and apply them.

        Args:
            batch: inputs as for :meth:`sample`, or a tuple or mapping that contains them. A single input makes a single
                pair, without the leading B.
            generator: a generator on the CPU for all draws; the module's own by default.
            key: name or index of the inputs in a mapping or tuple.

        Returns:
            A :class:`RawPair`; for a tuple or mapping, the same with the pair in place of the inputs.

        Raises:
            ValueError: if there are no inputs.
        """
        picture_key = self.find(batch, key)
        inputs = get_picture(batch, picture_key)

        pair = self.make_pair(self._batch(inputs), generator or self._own_generator())
        if self.is_single(inputs):
            pair = pair.map(_first)
        return replace_picture(batch, picture_key, pair)

    if TYPE_CHECKING:  # nn.Module's own call has no types

        @overload
        def __call__(self, batch: Tensor, generator: torch.Generator | None = None, key: None = None) -> RawPair: ...
        @overload
        def __call__(
            self, batch: Any, generator: torch.Generator | None = None, key: str | int | None = None
        ) -> Any: ...
        def __call__(
            self, batch: Any, generator: torch.Generator | None = None, key: str | int | None = None
        ) -> Any: ...

    def _batch(self, inputs: Any) -> Tensor:
        """Turn inputs into a batch; anything that is not yet a tensor is moved to the module's device."""
        batch = self.as_batch(inputs)
        if isinstance(inputs, Tensor):
            return batch
        return batch.to(self.device)

    def _require_as_many(self, batch: Tensor, params: AugmentParams) -> None:
        if len(params.crop) != len(batch):
            raise ValueError(f"the parameters describe a batch of {len(params.crop)}, this one has {len(batch)}")

    def _own_generator(self) -> torch.Generator:
        """Make a new generator for each call, worker and process."""
        self._calls += 1
        worker = get_worker_info()
        worker_seed = worker.seed if worker else 0
        rank = rank_key() or self._rank
        return keyed_generator(self.seed, self.stream, worker_seed, self._calls, *rank)

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_rank": rank_key() or self._rank}  # a spawned worker has no process group


def _first(tensor: Tensor) -> Tensor:
    return tensor[0]


def _as_batch(tensor: Tensor) -> Tensor:
    return tensor[None]
