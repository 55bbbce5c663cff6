"""A run rehearsed on its own data in seconds: everything that could fail late, without writing anything.

Frames are read as long as :data:`READ_SECONDS` allow, the ISP is fitted for two steps, every arm takes one step of
training on the run's device and in its precision, and its network is validated and scored on the middle of a frame.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, replace
from importlib import import_module
from typing import Any

import torch
from torch.utils.data import default_collate

from denoisers.network import Denoiser
from rawaug.commands.fit import fit
from rawaug.data.folders import each_readable
from rawaug.data.pairs import Pair
from rawaug.errors import extra
from rawaug.evaluation.scores import classical_method, network_method, score_method
from rawaug.experiment.arms import estimator_of, frames_of, in_pattern, training_stream, validation_samples
from rawaug.experiment.plan import Plan, require_usable
from rawaug.experiment.recipe import Recipe
from rawaug.files import find_weights
from rawaug.isp.model import DictionaryISP
from rawaug.noise import NoiseModel
from rawaug.plugin.augment import noise_for
from rawaug.registry import LOSSES, Spec
from rawaug.training.criteria import weighed
from rawaug.training.noisy_frames import noisy_only
from rawaug.training.state import first_network, start_of
from rawaug.training.validation import validate

READ_SECONDS = 5.0
"""For the frames of each part; what then remains unread is counted."""
SIDE = 256
"""Of the middle of a frame that is fitted, validated or scored."""


def rehearse(recipe: Recipe, plan: Plan, classical: Sequence[Spec]) -> None:
    """Try a run with its installed classical denoisers, and print what was read of its frames.

    Raises:
        OSError, ValueError: for the first thing that would fail.
        MissingExtra: if a library is not installed.
    """
    with extra("train"):
        for name in ("torch.utils.tensorboard.writer", "matplotlib", "skimage"):
            import_module(name)
    parts = {"train": plan.pairs, "validate": plan.validation, "test": plan.test}
    pairs, validation, test = (
        list(each_readable(frames, f"the frames to {what}", READ_SECONDS)) for what, frames in parts.items()
    )
    read = (
        f"{what} {len(found)} of {len(parts[what])}"
        for what, found in zip(parts, (pairs, validation, test), strict=True)
    )
    if recipe.self_supervised:
        pairs, validation = ([noisy_only(pair) for pair in part] for part in (pairs, validation))
    require_usable(recipe, pairs, validation)
    isp = _isp(recipe, pairs)
    noise = noise_for(isp, recipe.noise)
    side = max(SIDE, recipe.train.crop + 8)
    frames = frames_of(recipe, [pair.middle(side) for pair in pairs], isp)
    watched_frames = frames_of(recipe, [pair.middle(SIDE) for pair in validation[:1]], isp)
    for arm in recipe.arms:
        start = start_of(recipe.network_of(arm))
        own = in_pattern(isp, isp.cfa if start is None else start.cfa)
        net = _one_step(recipe, arm, frames, plan.pictures, own, noise)
        watched = validation_samples(recipe, watched_frames, plan.pictures, own, noise)
        validate(net, watched[:1], torch.device("cpu"))
        _score(network_method(net.eval(), isp.cfa, own.cfa), test, noise, isp)
    for spec in classical:
        _score(classical_method(spec, noise, seed=0), test, noise, isp)
    print(f"tried: every arm for one step; frames read: {', '.join(read)}")


def _isp(recipe: Recipe, pairs: Sequence[Pair]) -> DictionaryISP:
    """The recipe's own, or a fit of two steps."""
    if recipe.camera is not None:
        return DictionaryISP.from_pretrained(find_weights(recipe.camera))
    quick = replace(recipe.isp.smoke(), joint_steps=0, encoders="off")
    return fit(pairs, progress=False, noise="on" if recipe.noise == "camera" else "off", **asdict(quick))


def _one_step(
    recipe: Recipe, arm: str, frames: Sequence[Any], pictures: Any, isp: DictionaryISP, noise: NoiseModel
) -> Denoiser:
    """The network of an arm after one step on its device; on a CPU with one real and one augmented sample."""
    with extra("train"):
        from lightning_fabric import Fabric

    config = recipe.loop_of(arm)
    if config.batch % recipe.devices:
        raise ValueError(f"train.batch={config.batch} must be a multiple of devices={recipe.devices}")
    stream = training_stream(recipe, recipe.arms[arm], frames, pictures, isp, noise, recipe.seed)
    fabric: Any = Fabric(accelerator=recipe.device, devices=1, precision=config.precision)
    estimator, net = estimator_of(recipe.arms[arm]), first_network(recipe.network_of(arm), recipe.seed)
    indices = sorted({0, config.batch - 1}) if fabric.device.type == "cpu" else range(config.batch // recipe.devices)
    batch: Any = default_collate([stream[index] for index in indices])
    try:
        model, optimiser = fabric.setup(net, torch.optim.Adam(net.parameters(), lr=config.learning_rate))
        sample = type(batch)(*(tensor.to(fabric.device) for tensor in batch))
        fabric.backward(estimator.loss(model, sample, weighed(LOSSES.make(config.loss), config.weigh, sample), 0.0))
        optimiser.step()
    except RuntimeError as error:  # memory, or an operation that the device or the precision lacks
        raise ValueError(f"arms.{arm}: a step of training fails on {fabric.device}: {error}") from error
    return net.float().cpu()


def _score(method: Any, test: Sequence[Pair], noise: NoiseModel, isp: DictionaryISP) -> None:
    middle = [pair.middle(SIDE) for pair in test[:1]]
    list(score_method(method, middle, noise, isp.cfa, 0, "dry run"))
