"""A task: how samples, validation and test frames of one kind of image are made, and how a network denoises them."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any, ClassVar

from torch import nn

from rawaug.bayer import CFA
from rawaug.denoising.denoiser import RawDenoiser
from rawaug.evaluation.page import select_for_page
from rawaug.evaluation.scores import NOISY
from rawaug.evaluation.trials import Trial
from rawaug.experiment.settings import Recipe
from rawaug.isp.model import DictionaryISP
from rawaug.noise import NoiseModel
from rawaug.registry import Registry
from rawaug.training.stream import TrainingStream

TASKS = Registry("task", "rawaug.tasks", "rawaug.experiment")
"""This maps the name in a recipe's key ``experiment`` to a subclass of :class:`Task`."""


class Task(ABC):
    """One kind of image; everything else is the same for all tasks.

    A table of results is of all trials with the same ``condition`` and ``strength``.

    Args:
        recipe: the settings of the experiment.
    """

    settings: ClassVar[type[Recipe]] = Recipe
    """This dataclass has the keys of the task's recipes."""

    input: ClassVar[Any] = NOISY
    """This denoiser stands for the noisy input in tables."""

    def __init__(self, recipe: Recipe) -> None:
        self.recipe: Any = recipe

    @abstractmethod
    def stream(
        self, arm: str, frames: Sequence[Any], pictures: Any, isp: DictionaryISP, noise: NoiseModel, seed: int
    ) -> TrainingStream:
        """Make the training samples of an arm.

        Args:
            arm: the arm's name in the recipe.
            frames: the real pairs, or a :class:`rawaug.training.noisy_frames.NoisyFrame` of each if no arm sees clean
                ones.
            pictures: the sRGB pictures, or the pairs that the arm's ``source`` names.
            isp: makes RAW of the pictures, in the CFA of the arm's network.
            noise: the noise that is added to clean RAW.
            seed: seed of the run.
        """

    @abstractmethod
    def validation(
        self, frames: Sequence[Any], pictures: Any, isp: DictionaryISP, noise: NoiseModel
    ) -> Sequence[Trial]:
        """Make the frozen samples that choose the weights of arms; the arguments are as in :meth:`stream`."""

    @abstractmethod
    def test(self, frames: Sequence[Any], isp: DictionaryISP, noise: NoiseModel) -> Sequence[Trial]:
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

    def filters(self, table: str, validation: Sequence[Trial]) -> list[Any]:
        """Make the filters of a table; ``validation`` are the trials by which their settings may be chosen."""
        return [RawDenoiser.of(spec) for spec in self.recipe.classical]

    def shown(self, trials: Sequence[Trial]) -> list[Trial]:
        """Choose the trials that the page of the run shows."""
        return list(select_for_page(trials))
