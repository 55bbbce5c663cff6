"""The training loop: one denoiser, one stream of samples; its validation, and its log.

``theta <- Adam(grad loss(net(noisy, variance; theta), target))`` with a warm-up, a cosine and a running average of the
weights. Lightning Fabric places model and data: the same code on a CPU, one GPU, or the processes of several nodes, as
``torchrun`` or ``fabric run`` start them.

The validation is the PSNR on frozen frames, in RAW and developed to sRGB.
"""

from __future__ import annotations

import csv
import os
import time
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path
from statistics import fmean
from typing import Any

import torch
from torch import nn
from torch.utils.data import DataLoader

import denoisers
from denoisers.network import Denoiser
from rawaug.errors import extra
from rawaug.evaluation.trials import Trial
from rawaug.files import replacing
from rawaug.kernels.runtime import find_device
from rawaug.metrics import psnr
from rawaug.progress import progress
from rawaug.training.config import DenoiserConfig, TrainConfig
from rawaug.training.estimators import LOSSES, Criterion, Supervised, weigh_loss
from rawaug.training.state import TrainingState, first_network
from rawaug.training.stream import StepSampler, TrainingStream


class Journal:
    """The log of a training, ``log.csv``.

    A row has the mean loss since the row before, the validation PSNR, the learning rate of the step and the speed.

    Args:
        folder: of this file. A training from its first step clears what another one has left there.
        start: the step from which the training goes on; rows that a killed one wrote beyond it are dropped.
    """

    def __init__(self, folder: Path, start: int) -> None:
        self.path = folder / "log.csv"
        if self.path.is_file():
            head, *rows = self.path.read_text().splitlines(keepends=True)
            kept = [row for row in rows if row.endswith("\n") and int(row.split(",")[0]) <= start]
            with replacing(self.path) as partial:
                partial.write_text("".join([head, *kept]) if kept else "")

    def log(self, step: int, **values: float) -> None:
        """Write a row."""
        begun = self.path.is_file() and self.path.stat().st_size
        with self.path.open("a", newline="") as file:
            rows = csv.writer(file, lineterminator="\n")
            if not begun:
                rows.writerow(["step", *values])
            rows.writerow([step, *(f"{value:.6g}" for value in values.values())])


def train(
    stream: TrainingStream,
    validation: Sequence[Trial],
    network: DenoiserConfig,
    config: TrainConfig,
    folder: Path,
    seed: int = 0,
    device: str = "auto",
    devices: int = 1,
    label: str = "train",
    estimator: Supervised | None = None,
    choose: bool = True,
    key: str = "",
) -> Denoiser:
    """Train a denoiser; if there is a checkpoint in ``folder``, from there on.

    Args:
        stream: the training samples.
        validation: frozen images ``(1, 4, h, w)``, scored every ``validate_every`` steps.
        network: what is trained.
        config: how it is trained.
        folder: gets ``last.pt`` (all that a resume needs) and ``log.csv``.
        seed: of the initial weights.
        device: Fabric's accelerator.
        devices: number of devices; where torchrun runs, its processes count instead.
        label: heads the progress bar.
        estimator: makes the loss of a batch, and the denoiser of the trained network; by default supervised.
        choose: whether the averaged weights of the best validation are kept, or else those of the last step.
        key: what the weights depend on; a checkpoint that was saved with another key is written over.

    Returns:
        The network with the weights that are kept, in eval mode, on the CPU.

    Raises:
        ValueError: if the checkpoint is damaged, or no validation score was a number: the training has diverged.
    """
    estimator = estimator or Supervised()
    norm: Criterion = LOSSES.make(config.loss)
    fabric = launch(device, devices, config.precision, make_loggers(config.logger, folder, label))
    folder.mkdir(parents=True, exist_ok=True)
    state = TrainingState(first_network(network, seed), config)
    state.load(folder / "last.pt", key)
    start, model = state.step, state.set_up(fabric)
    loader = _batches(stream, start, config, fabric)
    journal = Journal(folder, start) if fabric.is_global_zero else None
    began, shown = time.perf_counter(), journal is not None
    bar = progress(loader, label=label, unit="step", total=config.steps, initial=start, leave=True, shown=shown)
    for step, batch in enumerate(bar, start=start + 1):
        sample = type(batch)(*(x.to(fabric.device, memory_format=state.layout) for x in batch))
        loss = estimator.loss(model, sample, weigh_loss(norm, config.weigh, sample), step / config.steps)
        learning_rate = state.update(loss)
        last = step == config.steps
        looks = last or step % config.validation_period == 0
        saves = last or step % config.checkpoint_every == 0
        if looks or saves:
            state.losses = fabric.all_reduce(state.losses, reduce_op="mean")
        if looks:
            net = estimator.correct_network(state.average_network)
            scores = validate(net, validation, fabric.device)
            state.keep_average(scores["psnr"], choose)
            row = {"loss": state.mean_loss(), **scores, "learning_rate": learning_rate}
            row["samples_per_second"] = (step - start) * stream.batch / (time.perf_counter() - began)
            if journal is not None:
                journal.log(step, **row)
            fabric.log_dict(row, step)
            bar.set_postfix_str(_status(row, state.best["step"]), refresh=False)
        if saves and journal is not None:
            state.save(folder / "last.pt", key)
    for logger in fabric.loggers:
        logger.finalize("success")
    return estimator.correct_network(state.best_network(label)).eval()


def _batches(stream: TrainingStream, start: int, config: TrainConfig, fabric: Any) -> DataLoader[Any]:
    """This process's share of every step from ``start`` on."""
    sampler = StepSampler(start, config.steps, stream.batch, fabric.global_rank, fabric.world_size)
    pinned = fabric.device.type == "cuda"
    return DataLoader(stream, batch_sampler=sampler, num_workers=config.workers, pin_memory=pinned)


def _status(row: dict[str, float], kept: int) -> str:
    scores = f"loss {row['loss']:.4f}, validation {row['psnr']:.2f} dB (kept: step {kept})"
    return f"{row['samples_per_second']:.0f} images/s, {scores}"


@torch.no_grad()
def validate(net: nn.Module, frames: Sequence[Trial], device: torch.device) -> dict[str, float]:
    """Mean PSNR in dB of a network, which denoises large frames in tiles.

    Returns:
        ``psnr`` over all frames; ``psnr_srgb`` where every frame can be developed; and ``psnr_CONDITION`` by condition.
    """
    net.eval()
    raw, srgb = [], []
    for frame in frames:
        # a variance of 0 stands for an unknown one
        variance = torch.zeros_like(frame.noisy) if frame.variance is None else frame.variance
        denoised = denoisers.denoise_tiles(net, frame.noisy.to(device), variance.to(device)).cpu()
        raw.append(psnr(denoised, frame.clean).mean().item())
        if frame.develop is not None and frame.domain != "srgb":
            srgb.append(psnr(*(frame.develop(x)[None] for x in (denoised, frame.clean))).item())
    net.train()
    scores = {"psnr": fmean(raw)}
    for kind in dict.fromkeys(frame.condition for frame in frames if frame.condition):
        scores[f"psnr_{kind}"] = fmean(x for x, frame in zip(raw, frames, strict=True) if frame.condition == kind)
    return scores | ({"psnr_srgb": fmean(srgb)} if len(srgb) == len(frames) else {})


def require_trainable(device: str, devices: int, precision: str, logger: str | None = None) -> None:
    """Raise ValueError or ImportError if a training's libraries, device, precision or logger are not there."""
    with extra("train"):
        for name in ("matplotlib", "skimage", "PIL"):
            import_module(name)
        from lightning_fabric import Fabric
    if devices < 1:
        raise ValueError(f"devices must be at least 1, got {devices}")
    if ":" in device:
        raise ValueError(f"device {device!r}: give the kind, such as cuda, and choose the GPU by CUDA_VISIBLE_DEVICES")
    find_device(device, count=devices)
    make_loggers(logger, Path(), label="")
    try:
        Fabric(accelerator="cpu", devices=1, precision=precision)
    except (ModuleNotFoundError, ValueError) as error:
        raise ValueError(f"train.precision: {' '.join(str(error).split())}") from None


def make_loggers(kind: str | None, folder: Path, label: str) -> list[Any]:
    """The loggers of Fabric that ``train.logger`` names.

    Args:
        kind: tensorboard, wandb, csv, or None for none.
        folder: gets the logs, in a subfolder named after the kind.
        label: the name of a run in Weights & Biases.

    Raises:
        MissingExtra: if the library of the logger is not installed.
    """
    if kind is None:
        return []

    if kind == "csv":
        from lightning_fabric.loggers import CSVLogger

        return [CSVLogger(folder, name="", version=kind, flush_logs_every_n_steps=1)]

    if kind == "tensorboard":
        from lightning_fabric.loggers import TensorBoardLogger

        with extra("tensorboard"):
            return [TensorBoardLogger(folder, name="", version=kind)]

    with extra("wandb"):
        from wandb.integration.lightning.fabric import WandbLogger

    return [WandbLogger(name=label, save_dir=folder, project="rawaug")]


def launch(device: str, devices: int, precision: str, loggers: Sequence[Any] = ()) -> Any:
    """Start Fabric in the processes that torchrun or ``fabric run`` started, or in those that it starts itself."""
    with extra("train"):
        from lightning_fabric import Fabric

    nodes = 1
    if torch.distributed.is_torchelastic_launched():
        devices = int(os.environ["LOCAL_WORLD_SIZE"])
        nodes = int(os.environ["WORLD_SIZE"]) // devices
    fabric: Any = Fabric(accelerator=device, devices=devices, num_nodes=nodes, precision=precision, loggers=loggers)
    if os.environ.get("LT_CLI_USED") != "1":  # ``fabric run`` has launched it
        fabric.launch()
    return fabric
