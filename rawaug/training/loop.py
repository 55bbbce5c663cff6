"""The training loop: one denoiser, one stream of samples, and its validation.

``theta <- Adam(grad loss(net(noisy, variance; theta), target))`` with a warm-up, a cosine and a running average of the
weights. Lightning Fabric places model and data, so the same code runs on a CPU, on one GPU, or in the processes of
several nodes, as ``torchrun`` or ``fabric run`` start them.

The validation is the PSNR on frozen frames, in RAW and developed to sRGB.
"""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from statistics import fmean
from typing import Any

import torch
from torch import nn
from torch.utils.data import DataLoader

import denoisers
from denoisers.network import Denoiser
from rawaug.evaluation.trials import Trial
from rawaug.metrics import psnr
from rawaug.progress import progress
from rawaug.training.config import DenoiserConfig, TrainConfig
from rawaug.training.estimators import Supervised
from rawaug.training.journal import Journal
from rawaug.training.launch import launch, make_loggers
from rawaug.training.losses import LOSSES, Criterion
from rawaug.training.state import TrainingState, first_network
from rawaug.training.stream import StepSampler, TrainingStream
from rawaug.training.weighing import weigh_loss

MAKE_PAIRS = {"cuda"}
"""Devices of these kinds make the pairs of pictures themselves, of crops in bytes; for others the workers make them."""


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
    """Train a denoiser, or continue its training from the checkpoint in ``folder`` if there is one.

    Args:
        stream: the training samples.
        validation: frozen images ``(1, 4, h, w)``, scored every ``validate_every`` steps.
        network: the network to train.
        config: the settings of the loop.
        folder: gets ``last.pt`` (all that a resume needs) and ``log.csv``.
        seed: seed of the initial weights.
        device: Fabric's accelerator.
        devices: number of devices; under torchrun, its processes count instead.
        label: heading of the progress bar.
        estimator: makes the loss of a batch, and the denoiser of the trained network; by default supervised.
        choose: whether the averaged weights of the best validation are kept; otherwise those of the last step are.
        key: hash of what the weights depend on; a checkpoint that was saved with another key is overwritten.

    Returns:
        The network with the weights that are kept, in eval mode, on the CPU.

    Raises:
        ValueError: if the checkpoint is damaged, or no validation score was a number: the training has diverged.
    """
    estimator = estimator or Supervised()
    criterion: Criterion = LOSSES.make(config.loss)
    checkpoint = folder / "last.pt"

    fabric = launch(device, devices, config.precision, make_loggers(config.logger, folder, label))
    folder.mkdir(parents=True, exist_ok=True)
    state = TrainingState(first_network(network, seed), config)
    state.load(checkpoint, key)
    start = state.step
    model = state.set_up(fabric)

    is_first = fabric.is_global_zero
    if start and is_first:
        print(f"{label}: resumed after step {start} of {config.steps}")
    journal = Journal(folder, start) if is_first else None
    make_pairs = stream.leave_pairs_to(fabric.device) if fabric.device.type in MAKE_PAIRS else None
    loader = _load_batches(stream, start, config, fabric)
    bar = progress(loader, label=label, unit="step", total=config.steps, initial=start, leave=True, shown=is_first)

    begin = time.perf_counter()
    for step, batch in enumerate(bar, start=start + 1):
        if make_pairs is not None:
            crops, params = batch
            batch = make_pairs(crops.to(fabric.device, non_blocking=True), params)
        sample = _place(batch, fabric.device, state.layout)
        loss = estimator.loss(model, sample, weigh_loss(criterion, config.weigh, sample), step / config.steps)
        learning_rate = state.update(loss)

        is_last = step == config.steps
        validates = is_last or step % config.validation_period == 0
        saves = is_last or step % config.checkpoint_every == 0
        if validates or saves:
            state.losses = fabric.all_reduce(state.losses, reduce_op="mean")

        if validates:
            scores = validate(estimator.correct_network(state.network_to_keep()), validation, fabric.device)
            state.keep_average(scores["psnr"], choose)

            row = {"loss": state.mean_loss(), **scores, "learning_rate": learning_rate}
            row["samples_per_second"] = (step - start) * stream.batch / (time.perf_counter() - begin)
            if journal is not None:
                journal.log(step, **row)
            fabric.log_dict(row, step)
            bar.set_postfix_str(_status(row, state.best["step"]), refresh=False)

        if saves and is_first:
            state.save(checkpoint, key)

    for logger in fabric.loggers:
        logger.finalize("success")
    return estimator.correct_network(state.best_network(label)).eval()


def _load_batches(stream: TrainingStream, start: int, config: TrainConfig, fabric: Any) -> DataLoader[Any]:
    """Load this process's share of every step from ``start`` on."""
    sampler = StepSampler(start, config.steps, stream.batch, fabric.global_rank, fabric.world_size)
    pins_memory = fabric.device.type == "cuda"
    return DataLoader(stream, batch_sampler=sampler, num_workers=config.workers, pin_memory=pins_memory)


def _place(batch: Any, device: torch.device, layout: torch.memory_format) -> Any:
    """Put a batch, a named tuple of tensors, on a device and in a memory format."""
    tensors = [tensor.to(device, memory_format=layout, non_blocking=True) for tensor in batch]
    return type(batch)(*tensors)


def _status(row: dict[str, float], best_step: int) -> str:
    """Write what the progress bar shows after a validation."""
    scores = f"loss {row['loss']:.4f}, validation {row['psnr']:.2f} dB (kept: step {best_step})"
    return f"{row['samples_per_second']:.0f} images/s, {scores}"


@torch.no_grad()
def validate(net: nn.Module, frames: Sequence[Trial], device: torch.device) -> dict[str, float]:
    """Compute the mean PSNR in dB of a network, which denoises large frames in tiles.

    Returns:
        ``psnr`` over all frames; ``psnr_srgb`` if every frame can be developed; and ``psnr_CONDITION`` by condition.
    """
    raw_scores = []
    srgb_scores = []
    by_condition: dict[str, list[float]] = defaultdict(list)

    net.eval()
    for frame in frames:
        variance = frame.variance
        if variance is None:
            variance = torch.zeros_like(frame.noisy)  # zero stands for an unknown variance
        denoised = denoisers.denoise_tiles(net, frame.noisy.to(device), variance.to(device)).cpu()

        score = psnr(denoised, frame.clean).mean().item()
        raw_scores.append(score)
        if frame.condition:
            by_condition[frame.condition].append(score)
        if frame.develop is not None:
            srgb = frame.develop(denoised)[None]
            clean_srgb = frame.develop(frame.clean)[None]
            srgb_scores.append(psnr(srgb, clean_srgb).item())
    net.train()

    scores = {"psnr": fmean(raw_scores)}
    for condition, values in by_condition.items():
        scores[f"psnr_{condition}"] = fmean(values)
    if len(srgb_scores) == len(frames):
        scores["psnr_srgb"] = fmean(srgb_scores)
    return scores
