"""A task: what goes in and comes out, how truth and noise are made, how results are compared and shown."""

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
"""Subclasses of :class:`Task`, by the name in a recipe's key ``experiment``."""

_MOST_ROWS = 3
"""Maximum number of test frames in ``picture.png``."""


def task_of(data: str) -> type[Task]:
    """The task whose images a test set, ``kind:path``, holds: RAW, unless another task reads it."""
    for name in TASKS:
        task: type[Task] = TASKS[name]
        if task.reads(data):
            return task

    return Task


class Task(ABC):
    """One kind of image with all that is special about it; everything else is the same for all tasks.

    Args:
        recipe: the settings of the experiment.
    """

    settings: ClassVar[type[Recipe]] = Recipe
    """The dataclass with the keys of its recipes."""

    upscale: ClassVar[int] = 1
    """The factor by which results have longer sides than packed RAW has; 2 if networks demosaic."""

    together: ClassVar[bool] = False
    """Whether frames are binned so that the four sites of a cell make a pixel of full colour."""

    compared_in: ClassVar[str] = ""
    """The end of the titles of tables: the domain of the scores, if it is not RAW."""

    developed: ClassVar[bool] = False
    """Whether frames may be pairs of developed pictures."""

    input: ClassVar[Any] = NOISY
    """The denoiser that stands for the noisy input in tables."""

    ensembles: ClassVar[bool] = True
    """Whether the self-ensemble is scored, too."""

    def __init__(self, recipe: Recipe) -> None:
        self.recipe: Any = recipe

    # -- files

    @classmethod
    def reads(cls, data: str) -> bool:
        """Whether a name of a test set is one of this kind of image alone."""
        return False

    def open(self, spec: str | Sequence[Pair] | None, split: str, clean: bool) -> Sequence[Any]:
        """Open the frames that a key of ``data`` names, or a sequence of them.

        Args:
            spec: a path, ``kind:path``, a sequence of pairs, or None for none.
            split: of a dataset that has several.
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
        """Frames of a part, "validation" or "test", counted, binned and cropped as the recipe says; each is read once.

        The own noise of test frames is measured on whole frames, of which binning takes most.
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
    """Scores a denoiser on a test set, see :mod:`rawaug.evaluation.evaluate`."""

    benchmark = staticmethod(compare_raw)
    """Compares denoisers on a test set, see :mod:`rawaug.evaluation.comparison`."""

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
        """The CFA that an arm is trained for: that of the weights that it starts from, else the ISP's."""
        if start is not None:
            return start.cfa

        return isp.cfa

    # -- samples

    @abstractmethod
    def stream(
        self, arm: str, frames: Sequence[Any], pictures: Any, isp: DictionaryISP, noise: NoiseModel, seed: int
    ) -> TrainingStream:
        """The training samples of an arm.

        Args:
            arm: its name in the recipe.
            frames: the real frames, as :meth:`training_frames` gives them.
            pictures: the sRGB pictures.
            isp: makes RAW of them, in the CFA of the arm's network.
            noise: is added to clean RAW.
            seed: of the run.
        """

    def training_frames(self, pairs: Sequence[Pair], isp: DictionaryISP) -> Sequence[Any]:
        """The real frames as :meth:`stream` and :meth:`validation_trials` take them."""
        return pairs

    @abstractmethod
    def validation_trials(
        self, frames: Sequence[Any], pictures: Any, isp: DictionaryISP, noise: NoiseModel
    ) -> Sequence[Trial]:
        """The frozen samples by which the weights of every arm are chosen; arguments as of :meth:`stream`."""

    @abstractmethod
    def test_trials(self, frames: Sequence[Any], isp: DictionaryISP, noise: NoiseModel) -> Sequence[Trial]:
        """The test frames with their frozen noise, each made when it is first asked for."""

    def samples_key(self) -> Sequence[Any]:
        """What the weights depend on besides the settings that all tasks have."""
        return ()

    def validation_key(self) -> Any:
        """What the validation depends on besides its frames."""
        return None

    def trials_key(self) -> Sequence[Any]:
        """What the scores depend on besides weights, frames and views."""
        return ()

    def test_noise(self) -> Any:
        """The noise of test frames without a capture, as the recipe says it."""
        return self.recipe.noise

    # -- methods and scores

    @abstractmethod
    def denoiser(self, name: str, network: nn.Module, pattern: CFA, views: int = 1) -> Any:
        """The network of an arm as it is tested; one whose training diverged is scored as it is."""

    @abstractmethod
    def open_methods(self, classical: Sequence[Spec], untouched: Sequence[Path]) -> list[Any]:
        """The denoisers that arms are compared with.

        Args:
            classical: filters.
            untouched: files of trained denoisers.

        Raises:
            ValueError: if one gives another kind of image.
        """

    def group(self, trial: Any) -> str:
        """The table that a trial, or a row of its scores, belongs to; "" where there is one table."""
        return ""

    def methods_for(self, group: str, methods: Sequence[Any], validation: Sequence[Any]) -> list[Any]:
        """The methods of a table; ``validation`` are the frames by which settings of filters are chosen."""
        return list(methods)

    def can_denoise(self, denoiser: Any, trial: Trial) -> bool:
        """Whether a denoiser takes the image of a trial."""
        return True

    # -- what is shown

    def panels(self, methods: Mapping[str, Sequence[Any]], trials: Sequence[Trial]) -> list[Panels]:
        """The frames of the page: test frames, denoised by the methods of their table."""
        panels = []
        for trial in select_for_page(trials):
            denoisers = [one for one in methods[self.group(trial)] if self.can_denoise(one, trial)]
            panels.append(panels_of(denoisers, trial, self.input))

        return panels

    def save_picture(self, panels: Sequence[Panels], path: Path) -> Path:
        """Write ``picture.png``, which has some of the frames of the page."""
        return save_picture(panels[:_MOST_ROWS], path)

    def command_of_weights(self, path: Path) -> str:
        """The command that uses the weights of an arm."""
        return f"rawaug denoise IN.dng OUT.dng --denoiser {path}"

    def command_of_method(self, name: str) -> str:
        """The command that uses another method, by the name of its row; empty if it is the noisy input."""
        for trained in self.recipe.untouched:
            if name.partition(", ")[0] == Path(trained).stem:
                return f"rawaug denoise IN.dng OUT.dng --denoiser {trained}"

        for spec in self.recipe.classical:
            if f"{name}, ".startswith(f"{spec_label(spec)}, "):
                text = spec
                if not isinstance(spec, str):
                    text = shlex.quote(json.dumps(spec))
                return f"rawaug denoise IN.dng OUT.dng --classical {text}"

        return ""

    def notes(self, test: Sequence[Any]) -> dict[str, Any]:
        """What ``results.json`` says besides scores."""
        return {}
