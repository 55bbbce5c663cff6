"""The training loop: one denoiser, one stream of samples; and what it logs, to ``log.csv`` and for TensorBoard.

``theta <- Adam(grad loss(net(noisy, variance; theta), target))`` with a warm-up, a cosine and a running average of the
weights. Lightning Fabric places model and data: the same code on a CPU, one GPU, or the processes of several nodes, as
``torchrun`` or ``fabric run`` start them.
"""

from __future__ import annotations

import csv
import os
import time
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path
from typing import Any

import torch
from torch import nn
from torch.utils.data import DataLoader

from denoisers.network import Denoiser
from rawaug.errors import extra
from rawaug.evaluation.trials import Trial
from rawaug.files import replacing
from rawaug.kernels.runtime import find_device
from rawaug.progress import progress
from rawaug.registry import LOSSES
from rawaug.training.config import DenoiserConfig, TrainConfig
from rawaug.training.criteria import Criterion, weighed
from rawaug.training.estimators import Supervised
from rawaug.training.state import TrainingState, first_network
from rawaug.training.stream import StepSampler, TrainingStream
from rawaug.training.validation import panels, validate

SHOWN, SHOWINGS = 3, 20
"""Validation frames of which TensorBoard shows crops, and how often at most."""


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
            with replacing(self.path) as partial:
                partial.write_text("".join([head, *kept]) if kept else "")
        for events in folder.glob("events.out.tfevents.*") if not start else ():
            events.unlink()
        self.next_shown = 0
        self.writer = SummaryWriter(str(folder), purge_step=start + 1 if start else None)

    def log(self, step: int, **values: float) -> None:
        """One row in the CSV file and one point in each TensorBoard curve."""
        begun = self.path.is_file() and self.path.stat().st_size
        with self.path.open("a", newline="") as file:
            rows = csv.writer(file, lineterminator="\n")
            if not begun:
                rows.writerow(["step", *values])
            rows.writerow([step, *(f"{value:.6g}" for value in values.values())])
        for name, value in values.items():
            self.writer.add_scalar(name, value, step)

    def show(self, step: int, steps: int, net: nn.Module, frames: Sequence[Trial]) -> None:
        """Noisy, denoised and clean crops in TensorBoard, at most :data:`SHOWINGS` times in ``steps``."""
        if self.next_shown <= step:
            self.next_shown = step + steps // SHOWINGS
            for k, frame in enumerate(frames[:SHOWN]):
                self.writer.add_image(f"noisy_denoised_clean/{k}", panels(net, frame), step)

    def close(self) -> None:
        self.writer.close()


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
        key: what the weights depend on; a checkpoint that was saved with another one is written over.

    Returns:
        The network with the weights that are kept, in eval mode, on the CPU.

    Raises:
        ValueError: if the checkpoint is damaged, or no validation score was a number: the training has diverged.
    """
    estimator = estimator or Supervised()
    norm: Criterion = LOSSES.make(config.loss)
    fabric = launched(device, devices, config.precision)
    folder.mkdir(parents=True, exist_ok=True)
    state = TrainingState(first_network(network, seed), config)
    state.load(folder / "last.pt", key)
    start, model = state.step, state.place(fabric)
    loader = _batches(stream, start, config, fabric)
    journal = Journal(folder, start) if fabric.is_global_zero else None
    began, shown = time.perf_counter(), journal is not None
    bar = progress(loader, label=label, unit="step", total=config.steps, initial=start, leave=True, shown=shown)
    for step, batch in enumerate(bar, start=start + 1):
        sample = type(batch)(*(x.to(fabric.device, memory_format=state.layout) for x in batch))
        loss = estimator.loss(model, sample, weighed(norm, config.weigh, sample), step / config.steps)
        learning_rate = state.update(loss)
        looks, saves = (step % n == 0 or step == config.steps for n in (config.validate_every, config.checkpoint_every))
        if looks or saves:
            state.losses = fabric.all_reduce(state.losses, reduce_op="mean")
        if looks:
            scores = validate(estimator.corrected(state.averaged), validation, fabric.device)
            state.note(scores["psnr"], choose)
            row = {"loss": state.mean_loss(), **scores, "learning_rate": learning_rate}
            row["samples_per_second"] = (step - start) * stream.batch / (time.perf_counter() - began)
            if journal is not None:
                journal.log(step, **row)
                journal.show(step, config.steps, estimator.corrected(state.averaged), validation)
            bar.set_postfix_str(_status(row, state.best["step"]), refresh=False)
        if saves and journal is not None:
            state.save(folder / "last.pt", key)
    if journal is not None:
        journal.close()
    return estimator.corrected(state.kept(label)).eval()


def _batches(stream: TrainingStream, start: int, config: TrainConfig, fabric: Any) -> DataLoader[Any]:
    """This process's share of every step from ``start`` on."""
    sampler = StepSampler(start, config.steps, stream.batch, fabric.global_rank, fabric.world_size)
    pinned = fabric.device.type == "cuda"
    return DataLoader(stream, batch_sampler=sampler, num_workers=config.workers, pin_memory=pinned)


def _status(row: dict[str, float], kept: int) -> str:
    scores = f"loss {row['loss']:.4f}, validation {row['psnr']:.2f} dB (kept: step {kept})"
    return f"{row['samples_per_second']:.0f} images/s, {scores}"


def require_trainable(device: str, devices: int, precision: str) -> None:
    """Check a training's libraries, device and precision before any work."""
    with extra("train"):
        for name in ("torch.utils.tensorboard.writer", "matplotlib", "skimage", "PIL"):
            import_module(name)
        from lightning_fabric import Fabric
    if devices < 1:
        raise ValueError(f"devices must be at least 1, got {devices}")
    if ":" in device:
        raise ValueError(f"device {device!r}: give the kind, such as cuda, and choose the GPU by CUDA_VISIBLE_DEVICES")
    find_device(device, count=devices)
    try:
        Fabric(accelerator="cpu", devices=1, precision=precision)
    except (ModuleNotFoundError, ValueError) as error:
        raise ValueError(f"train.precision: {' '.join(str(error).split())}") from None


def launched(device: str, devices: int, precision: str) -> Any:
    """Fabric in the processes that torchrun or ``fabric run`` started, or in those that it starts itself."""
    with extra("train"):
        from lightning_fabric import Fabric

    nodes = 1
    if torch.distributed.is_torchelastic_launched():
        devices = int(os.environ["LOCAL_WORLD_SIZE"])
        nodes = int(os.environ["WORLD_SIZE"]) // devices
    fabric: Any = Fabric(accelerator=device, devices=devices, num_nodes=nodes, precision=precision)
    if os.environ.get("LT_CLI_USED") != "1":  # ``fabric run`` has launched it
        fabric.launch()
    return fabric
