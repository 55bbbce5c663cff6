"""A task: its input and output, how truth and noise are made, and how results are compared and shown."""

from __future__ import annotations

import json
import shlex
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

from torch import nn

from denoisers.network import Denoiser
from rawaug.bayer import CFA
from rawaug.data import open_pairs
from rawaug.data.folders import Kept
from rawaug.data.pairs import Binned, Middles, Pair, SomePairs
from rawaug.evaluation.comparison import compare_raw
from rawaug.evaluation.evaluate import evaluate_raw
from rawaug.evaluation.figures import Panels, panels_of, save_picture
from rawaug.evaluation.page import select_for_page
from rawaug.evaluation.scores import NOISY
from rawaug.evaluation.trials import Measured, Trial
from rawaug.isp.model import DictionaryISP
from rawaug.noise import NoiseModel
from rawaug.registry import Registry, Spec, spec_label
from rawaug.tasks.settings import Recipe
from rawaug.training.state import Start
from rawaug.training.stream import TrainingStream

TASKS = Registry("task", "rawaug.tasks", "rawaug.tasks")
"""This maps the name in a recipe's key ``experiment`` to a subclass of :class:`Task`."""

_MOST_ROWS = 3
"""``picture.png`` has at most this many test frames."""


def task_of(data: str) -> type[Task]:
    """Find the task whose images a test set, ``kind:path``, holds: RAW, unless another task reads it."""
    for name in TASKS:
        task: type[Task] = TASKS[name]
        if task.reads(data):
            return task

    return Task


class Task(ABC):
    """One kind of image with everything special about it; all else is the same for all tasks.

    Args:
        recipe: the settings of the experiment.
    """

    settings: ClassVar[type[Recipe]] = Recipe
    """This dataclass has the keys of the task's recipes."""

    upscale: ClassVar[int] = 1
    """The sides of results are this many times those of packed RAW; 2 if networks demosaic."""

    together: ClassVar[bool] = False
    """This says whether frames are binned so that the four sites of a cell make a pixel of full colour."""

    compared_in: ClassVar[str] = ""
    """Titles of tables end with this: the domain of the scores, if it is not RAW."""

    synthetic: ClassVar[str] = "RAW made from pictures"
    """The page of a run says that arms are trained on this, if they are trained on no real frames."""

    developed: ClassVar[bool] = False
    """This says whether frames may be pairs of developed pictures."""

    input: ClassVar[Any] = NOISY
    """This denoiser stands for the noisy input in tables."""

    ensembles: ClassVar[bool] = True
    """This says whether the self-ensemble is also scored."""

    def __init__(self, recipe: Recipe) -> None:
        self.recipe: Any = recipe

    # -- files

    @classmethod
    def reads(cls, data: str) -> bool:
        """Tell whether the name of a test set is only for this kind of image."""
        return False

    def open(self, spec: str | Sequence[Pair] | None, split: str, clean: bool) -> Sequence[Any]:
        """Open the frames that a key of ``data`` names, or a sequence of them.

        Args:
            spec: a path, ``kind:path``, a sequence of pairs, or None for none.
            split: split of a dataset that has several.
            clean: whether the frames of a bare folder are taken for clean ones.

        Raises:
            FileNotFoundError: if there is no such file.
            ValueError: if it holds another kind of image.
        """
        if spec is None:
            return []

        data = self.recipe.data
        settings = data.settings_of(spec)
        return open_pairs(spec, split, clean, data.max_pixels, developed=self.developed, **settings)

    def prepare(self, frames: Sequence[Any], part: str) -> Sequence[Any]:
        """Count, bin and crop the frames of a part, "validation" or "test", as the recipe says; each is read once.

        The test frames' own noise is measured on whole frames; binning removes most of it.
        """
        data = self.recipe.data
        count = getattr(data, f"{part}_count")
        crop = getattr(data, f"{part}_crop")

        frames = SomePairs(frames, range(len(frames))[:count])
        if part == "test":
            frames = Measured(frames)
        if data.bin > 1 or self.together:
            frames = Binned(frames, data.bin, self.together)
        if crop is not None:
            frames = Middles(frames, crop)

        return Kept(frames)

    # -- one denoiser on a test set, and several

    evaluate = staticmethod(evaluate_raw)
    """This scores a denoiser on a test set, see :mod:`rawaug.evaluation.evaluate`."""

    benchmark = staticmethod(compare_raw)
    """This compares denoisers on a test set, see :mod:`rawaug.evaluation.comparison`."""

    # -- networks

    def require_network(self, network: Denoiser, name: str) -> None:
        """Raise ValueError if a network, which ``name`` stands for, gives another kind of image."""
        if network.upscale == self.upscale:
            return

        gives = "no full colour"
        if network.upscale > 1:
            gives = "full colour: rawaug run demosaic trains it"
        raise ValueError(f"denoiser: {name} gives {gives}; take another network")

    def pattern(self, start: Start | None, isp: DictionaryISP) -> CFA:
        """Find the CFA that an arm is trained for: that of the weights that it starts from, else the ISP's."""
        if start is not None:
            return start.cfa

        return isp.cfa

    # -- samples

    @abstractmethod
    def stream(
        self, arm: str, frames: Sequence[Any], pictures: Any, isp: DictionaryISP, noise: NoiseModel, seed: int
    ) -> TrainingStream:
        """Make the training samples of an arm.

        Args:
            arm: the arm's name in the recipe.
            frames: the real frames, as :meth:`training_frames` gives them.
            pictures: the sRGB pictures, or the pairs that the arm's ``source`` names.
            isp: makes RAW of the pictures, in the CFA of the arm's network.
            noise: the noise that is added to clean RAW.
            seed: seed of the run.
        """

    def training_frames(self, pairs: Sequence[Pair], isp: DictionaryISP) -> Sequence[Any]:
        """Prepare the real frames as :meth:`stream` and :meth:`validation_trials` take them."""
        return pairs

    @abstractmethod
    def validation_trials(
        self, frames: Sequence[Any], pictures: Any, isp: DictionaryISP, noise: NoiseModel
    ) -> Sequence[Trial]:
        """Make the frozen samples that choose every arm's weights; the arguments are as in :meth:`stream`."""

    @abstractmethod
    def test_trials(self, frames: Sequence[Any], isp: DictionaryISP, noise: NoiseModel) -> Sequence[Trial]:
        """Give the test frames their frozen noise; each is made when it is first asked for."""

    def samples_key(self) -> Sequence[Any]:
        """Return what the weights depend on besides the settings that all tasks have."""
        return ()

    def validation_key(self) -> Any:
        """Return what the validation depends on besides its frames."""
        return None

    def trials_key(self) -> Sequence[Any]:
        """Return what the scores depend on besides weights, frames and views."""
        return ()

    def test_noise(self) -> Any:
        """Return the noise of test frames without a capture, as the recipe states it."""
        return self.recipe.noise_at_iso

    # -- methods and scores

    @abstractmethod
    def denoiser(self, name: str, network: nn.Module, pattern: CFA, views: int = 1) -> Any:
        """Make the denoiser of an arm for the test; a network whose training diverged is scored as it is."""

    @abstractmethod
    def open_methods(self, classical: Sequence[Spec], baselines: Sequence[Path]) -> list[Any]:
        """Open the denoisers that arms are compared with.

        Args:
            classical: filters.
            baselines: files of trained denoisers.

        Raises:
            ValueError: if one gives another kind of image.
        """

    def group(self, trial: Any) -> str:
        """Name the table that a trial, or a row of its scores, belongs to; it is "" if there is only one."""
        return ""

    def methods_for(self, group: str, methods: Sequence[Any], validation: Sequence[Any]) -> list[Any]:
        """Choose the methods of a table; ``validation`` are the frames by which settings of filters are chosen."""
        return list(methods)

    def can_denoise(self, denoiser: Any, trial: Trial) -> bool:
        """Tell whether a denoiser takes the image of a trial."""
        return True

    # -- what is shown

    def panels(self, methods: Mapping[str, Sequence[Any]], trials: Sequence[Trial]) -> list[Panels]:
        """Make the frames of the page: test frames, denoised by the methods of their table."""
        panels = []
        for trial in select_for_page(trials):
            denoisers = [one for one in methods[self.group(trial)] if self.can_denoise(one, trial)]
            panels.append(panels_of(denoisers, trial, self.input))

        return panels

    def save_picture(self, panels: Sequence[Panels], path: Path) -> Path:
        """Write ``picture.png``, which has some of the frames of the page."""
        return save_picture(panels[:_MOST_ROWS], path)

    def command_of_weights(self, path: Path) -> str:
        """Write the command that uses the weights of an arm."""
        return f"rawaug denoise IN.dng OUT.dng --denoiser {shlex.quote(str(path))}"

    def command_of_method(self, name: str) -> str:
        """Write the command that uses another method, by the name of its row; it is empty for the noisy input."""
        for trained in self.recipe.baselines:
            if name.partition(", ")[0] == Path(trained).stem:
                return f"rawaug denoise IN.dng OUT.dng --denoiser {shlex.quote(trained)}"

        for spec in self.recipe.classical:
            if f"{name}, ".startswith(f"{spec_label(spec)}, "):
                text = spec if isinstance(spec, str) else json.dumps(spec)
                return f"rawaug denoise IN.dng OUT.dng --classical {shlex.quote(text)}"

        return ""

    def notes(self, test: Sequence[Any]) -> dict[str, Any]:
        """Return what ``results.json`` says besides scores."""
        return {}
