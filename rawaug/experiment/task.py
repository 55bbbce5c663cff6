"""A task: how samples, validation and test frames of one kind of image are made, and how a network denoises them."""

from __future__ import annotations

import copy
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

from torch import nn

from denoisers.classical import FILTERS
from rawaug.bayer import CFA
from rawaug.denoising.denoiser import RawDenoiser, require_classical
from rawaug.evaluation.page import select_for_page
from rawaug.evaluation.scores import NOISY
from rawaug.evaluation.trials import Trial
from rawaug.experiment.settings import Recipe
from rawaug.isp.model import DictionaryISP
from rawaug.noise import noise_model
from rawaug.registry import Registry, Spec, split_spec
from rawaug.training.noisy_frames import noisy_frame
from rawaug.training.stream import TrainingStream

TASKS = Registry("task", "rawaug.tasks", "rawaug.experiment")
"""Subclasses of :class:`Task`, by their name in a recipe's key ``experiment``."""


class Task(ABC):
    """One kind of image; everything else is the same for all tasks.

    A table of results is of all trials with the same ``condition`` and ``strength``.

    Args:
        recipe: the settings of the experiment.
        isp: makes RAW of the pictures.
        frames: the data by part, see :func:`rawaug.experiment.data.open_frames`.

    Attributes:
        noise: the noise that is added to clean RAW.
        real: the real pairs, or a :class:`rawaug.training.noisy_frames.NoisyFrame` of each if no arm sees clean ones.
        watched: the validation frames in the same form.
    """

    settings: ClassVar[type[Recipe]] = Recipe
    """The dataclass of the task's recipes."""

    input: ClassVar[Any] = NOISY
    """The denoiser that stands for the noisy input in tables."""

    def __init__(self, recipe: Recipe, isp: DictionaryISP, frames: Mapping[str, Any]) -> None:
        self.recipe: Any = recipe
        self.isp = isp
        self.frames = frames
        self.noise = noise_model(recipe.noise_at_iso, info=isp.info)

        self.real: Sequence[Any] = frames["pairs"]
        self.watched: Sequence[Any] = frames["validation"]
        if recipe.self_supervised:
            levels = isp.info.get("noise")  # the fit may have measured them
            self.real = [noisy_frame(pair, levels) for pair in self.real]
            self.watched = [noisy_frame(pair, levels) for pair in self.watched]

    @abstractmethod
    def stream(self, arm: str, cfa: CFA, seed: int) -> TrainingStream:
        """Make the training samples of an arm.

        Args:
            arm: the arm's name in the recipe.
            cfa: the pattern that its network is trained for.
            seed: seed of the run.
        """

    @abstractmethod
    def validation(self, cfa: CFA) -> Sequence[Trial]:
        """Make the frozen samples that choose the weights of arms of this pattern."""

    @abstractmethod
    def test(self) -> Sequence[Trial]:
        """Give the test frames their frozen noise; each is made when it is first asked for."""

    @abstractmethod
    def denoiser(self, name: str, network: nn.Module, cfa: CFA, views: int = 1) -> Any:
        """Make the denoiser of an arm for the test; a network whose training diverged is scored as it is.

        Args:
            name: its name in tables.
            network: the trained network.
            cfa: the pattern that it is trained for.
            views: number of views of the self-ensemble; 1 for none.
        """

    def filters(self, table: str) -> list[Any]:
        """Make the filters that a table has."""
        return [RawDenoiser.of(spec) for spec in find_classical(self.recipe.classical)]

    def shown(self, trials: Sequence[Trial]) -> list[Trial]:
        """Choose the trials that the page of the run shows."""
        return list(select_for_page(trials))


def find_classical(specs: Sequence[Spec]) -> list[Spec]:
    """Find a recipe's classical denoisers, without BM3D if its wheel is missing.

    Raises:
        ValueError: if another filter's library is missing, or a filter or setting is unknown.
    """
    installed = []
    for spec in specs:
        name, _ = split_spec(spec)
        if name != "BM3D" or not FILTERS["BM3D"].missing():
            installed.append(spec)

    require_classical(installed)
    return installed


def change_cfa(isp: DictionaryISP, cfa: CFA) -> DictionaryISP:
    """Put the ISP of a camera behind a CFA: return itself, or a copy if it had another CFA."""
    if isp.cfa == cfa:
        return isp

    copied = copy.deepcopy(isp)
    copied.configure(cfa=str(cfa))
    return copied
