"""The training loop: one denoiser, one stream of samples, one page.

``theta <- Adam(grad loss(net(noisy, variance; theta), target))`` with a warm-up, a cosine and a running average of the
weights. Lightning Fabric places model and data: the same code on a CPU, one GPU, or the processes of several nodes, as
``torchrun`` or ``fabric run`` start them.
"""

from __future__ import annotations

import copy
import csv
import math
import os
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.utils.data import DataLoader

from denoisers.network import Denoiser
from rawaug.extras import extra
from rawaug.files import replacing
from rawaug.progress import progress
from rawaug.registry import LOSSES
from rawaug.training.criteria import Criterion, weighed
from rawaug.training.estimators import Supervised
from rawaug.training.start import first_network
from rawaug.training.stream import StepSampler, TrainingStream
from rawaug.training.train_config import DenoiserConfig, TrainConfig
from rawaug.training.validation import Watched, panels, validate


SHOWN, SHOWINGS = 3, 20
"""Validation frames of which TensorBoard shows crops, and how often at most."""


def train(
    stream: TrainingStream,
    validation: Sequence[Watched],
    network: DenoiserConfig,
    config: TrainConfig,
    folder: Path,
    seed: int = 0,
    device: str = "auto",
    devices: int = 1,
    label: str = "train",
    estimator: Supervised | None = None,
    choose: bool = True,
) -> Denoiser:
    """Train a denoiser, resuming from the last checkpoint in ``folder``, if any.

    Args:
        stream: keyed samples.
        validation: frozen crops ``(1, 4, h, w)``, looked at every ``validate_every`` steps.
        network, config: what is trained, and how.
        folder: gets ``last.pt`` (all that a resume needs), ``log.csv`` and TensorBoard's files.
        seed: of the initial weights.
        device, devices: Fabric's accelerator and number of devices; torchrun's processes count instead where it runs.
        label: heads the progress bar.
        estimator: makes the loss of a batch, and of the trained network the denoiser; by default supervised.
        choose: keep the averaged weights of the best validation; if not, those of the end.

    Returns:
        The network with the weights that are kept, in eval mode, on the CPU.

    Raises:
        ValueError: if no validation score was a number: the training has diverged.
    """
    estimator = estimator or Supervised()
    norm: Criterion = LOSSES.make(config.loss)
    fabric = launched(device, devices, config.precision)
    folder.mkdir(parents=True, exist_ok=True)
    net = first_network(network, seed)
    average = torch.optim.swa_utils.AveragedModel(net, multi_avg_fn=running_average(config.ema))
    optimiser = torch.optim.Adam(net.parameters(), lr=config.learning_rate)
    schedule = torch.optim.lr_scheduler.LambdaLR(optimiser, lambda step: learning_rate_factor(step, config))
    start, best, losses = resume(folder / "last.pt", net, average, optimiser, schedule)

    layout = torch.channels_last if config.channels_last else torch.contiguous_format
    model, optimiser = fabric.setup(net.to(memory_format=layout), optimiser)  # type: ignore[call-overload]
    step_model: Any = torch.compile(model) if config.compile else model
    trained: Any = average.to(fabric.device).module
    losses = losses.to(fabric.device)
    sampler = StepSampler(start, config.steps, stream.batch, fabric.global_rank, fabric.world_size)
    pinned = fabric.device.type == "cuda"
    loader = DataLoader(stream, batch_sampler=sampler, num_workers=config.workers, pin_memory=pinned)
    journal = Journal(folder, start) if fabric.is_global_zero else None
    began = time.perf_counter()

    bar = progress(
        loader, label=label, unit="step", total=config.steps, initial=start, leave=True, shown=journal is not None
    )
    for step, batch in enumerate(bar, start=start + 1):
        sample = type(batch)(*(x.to(fabric.device, memory_format=layout) for x in batch))
        loss = estimator.loss(step_model, sample, weighed(norm, config.weigh, sample), step / config.steps)
        optimiser.zero_grad(set_to_none=True)
        fabric.backward(loss)
        if config.clip_norm:
            fabric.clip_gradients(model, optimiser, max_norm=config.clip_norm)
        optimiser.step()
        learning_rate = schedule.get_last_lr()[0]
        schedule.step()
        average.update_parameters(net) if config.ema else trained.load_state_dict(net.state_dict())
        losses += torch.stack([loss.detach().float(), losses.new_ones(())])

        looks, saves = (step % n == 0 or step == config.steps for n in (config.validate_every, config.checkpoint_every))
        if looks or saves:
            losses = fabric.all_reduce(losses, reduce_op="mean")
        if looks:
            scores = validate(estimator.corrected(trained), validation, fabric.device)
            if scores["psnr"] > best["psnr"] or not choose:
                best = {"psnr": scores["psnr"], "step": step, "net": copy.deepcopy(trained.state_dict())}
            row: dict[str, float] = {
                "loss": float(losses[0] / losses[1]),
                **scores,
                "learning_rate": float(learning_rate),
            }
            row["samples_per_second"] = (step - start) * stream.batch / (time.perf_counter() - began)
            losses = torch.zeros_like(losses)
            if journal is not None:
                journal.log(step, **row)
                journal.show(step, config.steps, estimator.corrected(trained), validation)
            told = f"loss {row['loss']:.4f}, validation {scores['psnr']:.2f} dB (kept: step {best['step']})"
            bar.set_postfix_str(f"{row['samples_per_second']:.0f} images/s, {told}", refresh=False)
        if saves and journal is not None:
            parts = {"net": net, "average": average, "optimiser": optimiser, "schedule": schedule}
            state = {key: part.state_dict() for key, part in parts.items()}
            write_atomically({**state, "step": step, "best": best, "losses": losses.cpu()}, folder / "last.pt")
    if journal is not None:
        journal.close()
    if not math.isfinite(best["psnr"]):
        raise ValueError(f"{label}: diverged, every validation score is NaN; lower train.learning_rate")
    trained.load_state_dict(best["net"])
    trained.cpu().to(memory_format=torch.contiguous_format)
    return estimator.corrected(trained).eval()


def launched(device: str, devices: int, precision: str) -> Any:
    """Fabric in the processes that torchrun or ``fabric run`` started, or in those that it starts itself.

    All have met here when it returns, so that none looks for a checkpoint before the first has put away an old one.
    """
    with extra("train"):
        from lightning_fabric import Fabric

    nodes = 1
    if torch.distributed.is_torchelastic_launched():
        devices = int(os.environ["LOCAL_WORLD_SIZE"])
        nodes = int(os.environ["WORLD_SIZE"]) // devices
    fabric: Any = Fabric(accelerator=device, devices=devices, num_nodes=nodes, precision=precision)
    if os.environ.get("LT_CLI_USED") != "1":  # ``fabric run`` has launched it
        fabric.launch()
    fabric.barrier()
    return fabric


def running_average(decay: float) -> Any:
    """``average <- d average + (1 - d) weights`` with d = ``decay``, at first (1 + n) / (10 + n) after n steps."""

    @torch.no_grad()
    def update(averages: Sequence[Tensor], weights: Sequence[Tensor], steps: Tensor | int) -> None:
        n = int(steps)
        torch._foreach_lerp_(list(averages), list(weights), 1.0 - min(decay, (1 + n) / (10 + n)))

    return update


def learning_rate_factor(step: int, config: TrainConfig) -> float:
    """Linear warm-up, then a cosine to 1% of the highest rate, or a halving every ``halve_every`` steps."""
    if step < config.warmup:
        return (step + 1) / config.warmup
    if config.schedule == "step":
        return float(0.5 ** (step // config.halve_every))
    progress = (step - config.warmup) / max(1, config.steps - config.warmup)
    return 0.01 + 0.99 * 0.5 * (1.0 + math.cos(math.pi * min(1.0, progress)))


def resume(
    path: Path, net: nn.Module, average: nn.Module, optimiser: Any, schedule: Any
) -> tuple[int, dict[str, Any], Tensor]:
    """Load the checkpoint at ``path`` if there is one.

    Returns:
        The steps already done, the best weights until then, and the sum and the number of losses not yet logged.
    """
    if not path.is_file():
        return 0, {"psnr": float("-inf"), "step": 0}, torch.zeros(2)
    state = torch.load(path, map_location="cpu", weights_only=True)
    for key, target in {"net": net, "average": average, "optimiser": optimiser, "schedule": schedule}.items():
        target.load_state_dict(state[key])
    return int(state["step"]), state["best"], state.get("losses", torch.zeros(2))


def write_atomically(state: dict[str, Any], path: Path) -> None:
    """A checkpoint is there whole or not at all: a kill leaves the one before."""
    with replacing(path) as partial:
        torch.save(state, partial)


class Journal:
    """``log.csv`` and TensorBoard's files of a run from ``start`` on; what a killed run logged beyond it is dropped.

    A row has the mean loss since the row before, the validation PSNR, the learning rate of the step and the speed.
    TensorBoard shows the middles of :data:`SHOWN` validation frames besides. A run from its beginning clears what
    another one has left.
    """

    def __init__(self, folder: Path, start: int) -> None:
        with extra("train"):
            from torch.utils.tensorboard.writer import SummaryWriter

        self.path = folder / "log.csv"
        if self.path.is_file():
            head, *rows = self.path.read_text().splitlines(keepends=True)
            kept = [row for row in rows if row.endswith("\n") and int(row.split(",")[0]) <= start]
            self.path.write_text("".join([head, *kept]) if kept else "")
        for events in folder.glob("events.out.tfevents.*") if not start else ():
            events.unlink()
        self.next_shown = 0
        self.writer = SummaryWriter(str(folder), purge_step=start + 1 if start else None)

    def log(self, step: int, **values: float) -> None:
        """One row in the CSV file and one point in each TensorBoard curve."""
        head = ["step", *values]
        known = self.path.read_text().splitlines() if self.path.is_file() else []
        if known and known[0] != ",".join(head):  # begun by a version with other columns
            write_rows(self.path, head, list(csv.DictReader(known)))
        with self.path.open("a", newline="") as file:
            rows = csv.writer(file, lineterminator="\n")
            if not known:
                rows.writerow(head)
            rows.writerow([step, *(f"{value:.6g}" for value in values.values())])
        for name, value in values.items():
            self.writer.add_scalar(name, value, step)

    def show(self, step: int, steps: int, net: nn.Module, frames: Sequence[Watched]) -> None:
        """Noisy, denoised and clean crops in TensorBoard, at most :data:`SHOWINGS` times in ``steps``."""
        if self.next_shown <= step:
            self.next_shown = step + steps // SHOWINGS
            for k, frame in enumerate(frames[:SHOWN]):
                self.writer.add_image(f"noisy_denoised_clean/{k}", panels(net, frame), step)

    def close(self) -> None:
        """Write what is left."""
        self.writer.close()


def write_rows(path: Path, head: Sequence[str], rows: Sequence[dict[str, str]]) -> None:
    """A CSV file with the columns ``head``; what a row lacks is empty, what ``head`` lacks is left out."""
    with replacing(path) as partial, partial.open("w", newline="") as file:
        writer = csv.DictWriter(file, head, restval="", extrasaction="ignore", lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
