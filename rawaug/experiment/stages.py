"""The stages of a run, which fit the ISP, train an arm and score it; and what they need to know.

A stage writes a file with the hash of everything that it depends on; it is skipped if the file already has this hash.
"""

from __future__ import annotations

import copy
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import denoisers
from denoisers.network import Denoiser
from rawaug.bayer import CFA
from rawaug.data.opening import picture_stamp
from rawaug.data.pairs import stamps
from rawaug.errors import extra
from rawaug.evaluation.scores import Row, group_rows, score, summary
from rawaug.evaluation.trials import Trial
from rawaug.experiment.inputs import Inputs
from rawaug.files import fingerprint, sha256, write_json
from rawaug.isp.model import DictionaryISP
from rawaug.noise import NoiseModel, camera_law, noise_model
from rawaug.progress import progress
from rawaug.registry import Spec
from rawaug.tasks.base import Task
from rawaug.tasks.settings import Recipe
from rawaug.training.camera_fit import fit
from rawaug.training.config import weights_key
from rawaug.training.estimators import Supervised
from rawaug.training.loop import train
from rawaug.training.state import Start

_PLAIN, _ENSEMBLE = "plain", "self_ensemble"
"""A denoiser has these kinds of scores, in the order of tables."""

Summaries = dict[str, dict[str, Any]]
"""It maps :data:`_PLAIN` and :data:`_ENSEMBLE` to a summary of scores."""

Results = dict[str, Any]
"""It has, by arm, summaries ``plain`` and ``self_ensemble`` for each seed; several tables come first."""


@dataclass
class Experiment:
    """A recipe with everything that it names already opened.

    Attributes:
        recipe: the recipe that is run.
        task: everything that is special about its kind of image.
        folder: folder of the run.
        isp: the ISP that is used as it is; None if each seed fits one.
        inputs: the frames and pictures.
        unreadable: lines that name frames which cannot be read.
        classical: the filters to compare with.
        methods: the denoisers to compare with, see :meth:`rawaug.tasks.base.Task.open_methods`.
        estimators: estimator of each arm.
        starts: the weights that each arm continues from.
    """

    recipe: Recipe
    task: Task
    folder: Path
    isp: DictionaryISP | None
    inputs: Inputs
    unreadable: list[str]
    classical: list[Spec]
    methods: list[Any]
    estimators: dict[str, Supervised]
    starts: dict[str, Start | None]

    @property
    def seeds(self) -> range:
        """The seeds of the runs."""
        return range(self.recipe.seed, self.recipe.seed + self.recipe.seeds)

    def arm_folder(self, arm: str, seed: int) -> Path:
        """Return the folder of an arm's weights, log and scores."""
        return self.folder / f"seed{seed}" / arm


@dataclass
class Camera:
    """The ISP and the noise of a seed, and the frames and trials that have this noise.

    Attributes:
        experiment: the experiment that the frames belong to.
        isp: fitted with this seed, or the recipe's own.
        noise: the noise that is added to clean RAW.
        pairs: the real training frames, as the task's arms take them.
        validation: the validation frames, in the same form.
        trials: the test frames with their noise.
    """

    experiment: Experiment
    isp: DictionaryISP
    noise: NoiseModel
    pairs: Sequence[Any]
    validation: Sequence[Any]
    trials: Sequence[Trial]
    _noisy: dict[str, list[Row]] = field(default_factory=dict)
    _watched: dict[CFA, Sequence[Trial]] = field(default_factory=dict)

    @classmethod
    def of(cls, experiment: Experiment, isp: DictionaryISP) -> Camera:
        """Make the recipe's noise, which an ISP may have measured, and the frames and trials that have it."""
        task, inputs = experiment.task, experiment.inputs
        noise = noise_model(experiment.recipe.noise_at_iso, info=isp.info)
        pairs = task.training_frames(inputs.pairs, isp)
        validation = task.training_frames(inputs.validation, isp)
        return cls(experiment, isp, noise, pairs, validation, task.test_trials(inputs.test, isp, noise))

    def with_isp(self, isp: DictionaryISP) -> Camera:
        """Take the ISP of another seed; frames and trials stay, unless the ISP has measured their noise."""
        if self.experiment.recipe.noise == "camera":
            return Camera.of(self.experiment, isp)

        return replace(self, isp=isp, _watched={})

    def pattern(self, arm: str) -> CFA:
        """Return the CFA that an arm is trained for."""
        return self.experiment.task.pattern(self.experiment.starts[arm], self.isp)

    def isp_of(self, arm: str) -> DictionaryISP:
        """Return the ISP in the CFA that an arm is trained for."""
        return change_cfa(self.isp, self.pattern(arm))

    def validation_trials(self, arm: str) -> Sequence[Trial]:
        """Make the frozen samples by which the weights of an arm are chosen."""
        cfa = self.pattern(arm)
        if cfa not in self._watched:
            task, pictures = self.experiment.task, self.experiment.inputs.pictures
            self._watched[cfa] = task.validation_trials(self.validation, pictures, self.isp_of(arm), self.noise)

        return self._watched[cfa]

    def noisy_rows(self, group: str) -> list[Row]:
        """Score the input itself in a table."""
        if not self._noisy:
            rows = score([self.experiment.task.input], self.trials)
            self._noisy.update(_group_by_table(self.experiment.task, rows))

        return self._noisy[group]


def is_leader() -> bool:
    """Tell whether this is the training process, among several, that writes and evaluates."""
    with extra("train"):
        from lightning_fabric.utilities.rank_zero import rank_zero_only

    return getattr(rank_zero_only, "rank", 0) == 0


def change_cfa(isp: DictionaryISP, cfa: CFA) -> DictionaryISP:
    """Put the ISP of a camera behind a CFA: return itself, or a copy if it had another CFA."""
    if isp.cfa == cfa:
        return isp

    other = copy.deepcopy(isp)
    other.configure(cfa=str(cfa))
    return other


# -- fit ---------------------------------------------------------------------------------------------------------------


def fit_isp(experiment: Experiment, seed: int) -> DictionaryISP:
    """Fit the ISP to the few pairs, or take the recipe's own."""
    recipe, pairs = experiment.recipe, experiment.inputs.pairs
    if experiment.isp is not None:
        return experiment.isp

    path = experiment.folder / f"seed{seed}" / "isp.safetensors"
    settings = {**asdict(recipe.fit), "seed": seed}
    measures_noise = recipe.noise == "camera"
    key = fingerprint("isp", settings, stamps(pairs), measures_noise, recipe.self_supervised)

    if path.is_file():
        isp = DictionaryISP.from_pretrained(path)
        if isp.info.get("key") == key:
            if is_leader():
                print(f"already fitted: {path}")
            return isp

    noise: Literal["on", "off"] = "off"
    if measures_noise:
        noise = "on"

    isp = fit(pairs, noise=noise, **settings)
    isp.info["key"] = key
    isp.save(path)
    return isp


# -- train -------------------------------------------------------------------------------------------------------------


def train_arm(experiment: Experiment, camera: Camera, arm: str, seed: int) -> Denoiser:
    """Train the network of an arm, or load it if it has been trained with the same settings."""
    recipe, inputs = experiment.recipe, experiment.inputs
    folder = experiment.arm_folder(arm, seed)
    path = folder / "denoiser.safetensors"
    key = _arm_key(experiment, camera, arm, seed)

    if path.is_file():
        model, info = denoisers.load(path)
        if info.get("key") == key:
            print(f"already trained: {path}")
            return model

    others = {"pictures": inputs.pictures, "own": camera.pairs, "noise": camera.pairs, "more": inputs.more}
    source = others[recipe.arms[arm].source]
    stream = experiment.task.stream(arm, camera.pairs, source, camera.isp_of(arm), camera.noise, seed)
    model = train(
        stream,
        camera.validation_trials(arm),
        recipe.network(arm),
        recipe.loop(arm),
        folder,
        seed,
        device=recipe.device,
        devices=recipe.devices,
        label=f"seed {seed}, {arm}",
        estimator=experiment.estimators[arm],
        choose=bool(inputs.validation),
        key=key,
    )

    if is_leader():
        denoisers.save(model, path, _info_of_arm(experiment, camera, arm, seed, key))
        (folder / "last.pt").unlink(missing_ok=True)

    return model


def _info_of_arm(experiment: Experiment, camera: Camera, arm: str, seed: int, key: str) -> dict[str, Any]:
    """Collect what the file of an arm's weights says about its training."""
    recipe, inputs, start = experiment.recipe, experiment.inputs, experiment.starts[arm]
    noise = recipe.noise_at_iso
    if recipe.noise == "camera":
        noise = camera_law(camera.isp.info["noise"]).spec()

    steps = recipe.loop(arm).steps
    cfa = str(camera.pattern(arm))
    info = {"key": key, "cfa": cfa, "noise": noise, "steps": steps, "seed": seed, "arm": arm}
    if recipe.arms[arm].estimator != "supervised":
        info["estimator"] = recipe.arms[arm].estimator
    if start is not None:
        info["start"] = recipe.network(arm).start
        info["start_sha256"] = start.sha256
    info["real_pairs"] = [pair.name for pair in inputs.pairs]
    info["pictures"] = recipe.data.pictures
    return info


def _arm_key(experiment: Experiment, camera: Camera, arm: str, seed: int) -> str:
    """Hash the settings and frames that the weights of an arm depend on."""
    recipe, inputs, task = experiment.recipe, experiment.inputs, experiment.task
    data, start = recipe.data, experiment.starts[arm]

    real = camera.isp.info["key"], asdict(recipe.draw), recipe.noise_at_iso, data.pairs, stamps(inputs.pairs)
    pictures: tuple[Any, ...] = data.pictures, picture_stamp(data.pictures), data.max_pixels
    start_hash = None
    if start is not None:
        start_hash = start.sha256
    if recipe.arms[arm].source == "more":
        pictures = (*pictures, *stamps(inputs.more))
    how = recipe.target, asdict(recipe.arms[arm]), experiment.estimators[arm].revision, start_hash

    validation = None
    if inputs.validation:
        validation = data.validation, data.validation_crop, stamps(inputs.validation), task.validation_key()

    key = weights_key(recipe.network(arm), recipe.loop(arm), (seed, *real, *pictures, *how), validation)
    more = task.samples_key()
    if more:
        key = fingerprint(key, *more)

    return key


# -- score -------------------------------------------------------------------------------------------------------------


def score_arm(experiment: Experiment, camera: Camera, arm: str, seed: int, network: Denoiser) -> dict[str, Summaries]:
    """Compute the arm's summaries by table; those in its file are kept."""
    recipe, task = experiment.recipe, experiment.task
    path = experiment.arm_folder(arm, seed) / "evaluation.json"
    key = _scores_key(experiment, sha256(path.with_name("denoiser.safetensors")))

    kinds = [_PLAIN]
    if recipe.self_ensemble and task.ensembles:
        kinds.append(_ENSEMBLE)

    tables = _read_scores(path, key)
    missing = [kind for kind in kinds if not _all_have(tables, kind)]
    if not missing:
        print(f"already evaluated: {path}")

    for kind in missing:
        views = 1
        if kind == _ENSEMBLE:
            views = recipe.views

        denoiser = task.denoiser(arm, network, camera.pattern(arm), views)
        for group, result in _score_tables(camera, denoiser, f"evaluate {arm}, {kind}").items():
            tables.setdefault(group, {})[kind] = result
            name = ", ".join(filter(None, [arm, f"seed {seed}", kind, group]))
            print(f"evaluated {name}: {result.get('psnr', math.nan):.2f} dB: {path}")
        write_json({"key": key, **without_tables(tables)}, path)

    requested = {}
    for group, table in tables.items():
        requested[group] = {kind: table[kind] for kind in kinds}

    return requested


def _all_have(tables: Mapping[str, Summaries], kind: str) -> bool:
    """Tell whether there are tables and each has summaries of this kind."""
    return bool(tables) and all(kind in table for table in tables.values())


def _read_scores(path: Path, key: str) -> dict[str, Summaries]:
    """Read the summaries by table from a file of this key; there are none without such a file."""
    if not path.is_file():
        return {}

    content = json.loads(path.read_text())
    if content.pop("key", None) != key:
        return {}

    tables: dict[str, Summaries] = content
    if _PLAIN in content:
        tables = {"": content}

    return tables


def _score_tables(camera: Camera, denoiser: Any, label: str) -> dict[str, dict[str, Any]]:
    """Compute the summaries of a denoiser by table; tables whose images it does not take are left out."""
    task = camera.experiment.task
    trials = (trial for trial in camera.trials if task.can_denoise(denoiser, trial))
    rows = _group_by_table(task, score([denoiser], trials, label))

    summaries = {}
    for group, of_group in rows.items():
        summaries[group] = summary(of_group, camera.noisy_rows(group))

    return summaries


def _group_by_table(task: Task, rows: Any) -> dict[str, list[Row]]:
    """Group rows by the table that they belong to."""
    groups: dict[str, list[Row]] = {}
    for row in rows:
        groups.setdefault(task.group(row), []).append(row)

    return groups


def _scores_key(experiment: Experiment, digest: str) -> str:
    """Hash what the scores of an arm depend on besides the noise and the arm's own settings.

    ``digest`` is the digest of its weights.
    """
    recipe = experiment.recipe
    frames = recipe.data.test, recipe.data.test_crop, recipe.data.bin, stamps(experiment.inputs.test)
    return fingerprint(digest, *frames, recipe.views, *experiment.task.trials_key())


def score_methods(camera: Camera, methods: Mapping[str, Sequence[Any]]) -> dict[str, dict[str, Any]]:
    """Score the denoisers that arms are compared with, by table and name, with one trial in memory at a time."""
    task = camera.experiment.task
    rows: dict[str, list[Row]] = {group: [] for group in methods}
    for trial in progress(camera.trials, label="other denoisers", unit="image"):
        group = task.group(trial)
        denoisers = [one for one in methods[group] if task.can_denoise(one, trial)]
        rows[group] += score(denoisers, [trial])

    others: dict[str, dict[str, Any]] = {}
    for group, of_group in rows.items():
        others[group] = {}
        for name, of_one in group_rows(of_group).items():
            others[group][name] = summary(of_one, camera.noisy_rows(group))

    return others


def without_tables(by_table: Mapping[str, Any]) -> Any:
    """Choose what a file holds: all tables by name, or only the table itself if there is one without a name."""
    if set(by_table) == {""}:
        return by_table[""]

    return dict(by_table)
