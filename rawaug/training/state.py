"""The state of a training: its first network, the running average, and the checkpoint that it resumes from.

``theta <- Adam(gradient of the loss)``, then ``average <- d average + (1 - d) theta``; the learning rate warms up and
falls.
"""

from __future__ import annotations

import copy
import io
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

import denoisers
from denoisers.files import find_denoiser
from denoisers.network import Denoiser
from rawaug.files import write_bytes
from rawaug.seeding import derive_seed
from rawaug.training.config import DenoiserConfig, TrainConfig


def first_network(config: DenoiserConfig, seed: int) -> Denoiser:
    """Make the network before its first step, in train mode; layers that its start lacks are drawn from ``seed``.

    Raises:
        ValueError: if the start is another network than the settings say.
    """
    settings = {"seed": derive_seed(seed, "network") % 2**31, **config.settings}
    if config.start is None:
        return denoisers.build(config.name, **settings)

    start, _ = denoisers.load(find_denoiser(config.start))
    if config == DenoiserConfig(start=config.start):
        return start.train()

    network = denoisers.build(config.name, **settings)
    source = start
    if not network.can_start_from(start):
        source = start.core
    if not network.can_start_from(source):
        raise ValueError(
            f"denoiser.start: {config.start} is a {type(start).__name__} with {start.config}, not a "
            f"{config.name} with {network.config}; leave denoiser.name and denoiser.settings out to take the file's"
        )
    network.start_from(source)
    return network.train()


class TrainingState:
    """A network in training, with the running average of its weights, Adam and the schedule of its rate."""

    def __init__(self, net: Denoiser, config: TrainConfig) -> None:
        self.net = net
        self.config = config
        self.step = 0
        self.losses = torch.zeros(2)
        self.best: dict[str, Any] = {"psnr": float("-inf"), "step": 0}

        def factor(step: int) -> float:
            return learning_rate_factor(step, config)

        self.average = torch.optim.swa_utils.AveragedModel(net, multi_avg_fn=running_average(config.ema))
        self.optimiser: Any = torch.optim.Adam(net.parameters(), lr=config.learning_rate)
        self.schedule = torch.optim.lr_scheduler.LambdaLR(self.optimiser, factor)

        self.layout = torch.contiguous_format
        if config.channels_last:
            self.layout = torch.channels_last

        self.start: dict[str, Tensor] = {}
        if config.start_share:
            self.start = copy.deepcopy(net.state_dict())
            self.blend = copy.deepcopy(net)

    @property
    def average_network(self) -> Any:
        """The network of the running average."""
        return self.average.module

    @torch.no_grad()
    def network_to_keep(self) -> Any:
        """Return the network that is validated and kept: the running average, or a blend of it with the start."""
        if not self.start:
            return self.average_network

        average = self.average_network.state_dict()
        for name, value in self.blend.state_dict().items():
            if value.is_floating_point():
                start = self.start[name].to(average[name].device)
                value.copy_(average[name].lerp(start, self.config.start_share))
            else:
                value.copy_(average[name])
        return self.blend

    @property
    def _parts(self) -> dict[str, Any]:
        return {"net": self.net, "average": self.average, "optimiser": self.optimiser, "schedule": self.schedule}

    def load(self, path: Path, key: str) -> None:
        """Resume from the checkpoint at ``path``, if there is one that was saved with the same ``key``."""
        if not path.is_file():
            return

        try:
            state = torch.load(path, map_location="cpu", weights_only=True)
            if state.get("key") != key:
                return

            for name, part in self._parts.items():
                part.load_state_dict(state[name])
            self.step = int(state["step"])
            self.best = state["best"]
            self.losses = state["losses"]
        except Exception as error:  # the unpickler may raise nearly anything
            reason = " ".join(str(error).split())[:120]
            raise ValueError(f"{path}: damaged ({reason}); delete it to train this arm from its first step") from error

    def save(self, path: Path, key: str) -> None:
        """Write a checkpoint, completely or not at all; after a kill or on a full disk, the previous one stays."""
        state: dict[str, Any] = {name: part.state_dict() for name, part in self._parts.items()}
        state["key"] = key
        state["step"] = self.step
        state["best"] = self.best
        state["losses"] = self.losses.cpu()

        content = io.BytesIO()  # PyTorch's own writer does not say that a disk is full
        torch.save(state, content)
        write_bytes(content.getbuffer(), path)

    def set_up(self, fabric: Any) -> Any:
        """Move everything to Fabric's device, and return the model to train, compiled if the settings say so."""
        self.fabric = fabric
        net = self.net.to(memory_format=self.layout)  # type: ignore[call-overload]
        self.model, self.optimiser = fabric.setup(net, self.optimiser)
        self.average.to(fabric.device)
        if self.start:
            self.blend.to(fabric.device)
        self.losses = self.losses.to(fabric.device)

        if self.config.compile:
            mode = "reduce-overhead" if fabric.device.type == "cuda" else None  # steps are launched as CUDA graphs
            return torch.compile(self.model, mode=mode)
        return self.model

    def update(self, loss: Tensor) -> float:
        """Step down the gradient of ``loss``, a scalar, and return the learning rate of the step."""
        self.optimiser.zero_grad(set_to_none=True)
        self.fabric.backward(loss)
        if self.config.clip_norm:
            self.fabric.clip_gradients(self.model, self.optimiser, max_norm=self.config.clip_norm)
        self.optimiser.step()

        learning_rate = float(self.schedule.get_last_lr()[0])
        self.schedule.step()

        if self.config.ema:
            self.average.update_parameters(self.net)
        else:
            self.average_network.load_state_dict(self.net.state_dict())

        self.losses += torch.stack([loss.detach().float(), self.losses.new_ones(())])
        self.step += 1
        return learning_rate

    def mean_loss(self) -> float:
        """Return the mean loss since the last call, and begin anew."""
        mean = float(self.losses[0] / self.losses[1])
        self.losses = torch.zeros_like(self.losses)
        return mean

    def keep_average(self, score: float, choose: bool) -> None:
        """Keep the current network if its ``score`` is the highest so far, or ``choose`` is off."""
        if score > self.best["psnr"] or not choose:
            weights = copy.deepcopy(self.network_to_keep().state_dict())
            self.best = {"psnr": score, "step": self.step, "net": weights}

    def best_network(self, label: str) -> Any:
        """Return the network with the best weights, on the CPU; raise ValueError if no score was a number."""
        if not math.isfinite(self.best["psnr"]):
            raise ValueError(f"{label}: diverged, every validation score is NaN; lower train.learning_rate")

        self.average_network.load_state_dict(self.best["net"])
        return self.average_network.cpu().to(memory_format=torch.contiguous_format)


def running_average(decay: float) -> Any:
    """Update ``average <- d average + (1 - d) weights``; d is ``decay``, at first (1 + n) / (10 + n) after n steps."""

    @torch.no_grad()
    def update(averages: Sequence[Tensor], weights: Sequence[Tensor], steps: Tensor | int) -> None:
        n = int(steps)
        current_decay = min(decay, (1 + n) / (10 + n))
        torch._foreach_lerp_(list(averages), list(weights), 1.0 - current_decay)

    return update


def learning_rate_factor(step: int, config: TrainConfig) -> float:
    """Compute the share of the highest learning rate at a step.

    It rises linearly during the warm-up; then it falls as a cosine to 1%, or by half every ``halve_every`` steps.
    """
    if step < config.warmup:
        return (step + 1) / config.warmup

    if config.schedule == "step":
        return float(0.5 ** (step // config.halve_every))

    progress = (step - config.warmup) / max(1, config.steps - config.warmup)
    cosine = math.cos(math.pi * min(1.0, progress))
    return 0.01 + 0.99 * 0.5 * (1.0 + cosine)
