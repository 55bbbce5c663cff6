"""Lightning Fabric for a training: its devices and processes, its loggers, and whether it can run here at all."""

from __future__ import annotations

import os
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path
from typing import Any

import torch

from rawaug.errors import extra
from rawaug.kernels.runtime import find_device


def require_trainable(device: str, devices: int, precision: str, logger: str | None = None) -> None:
    """Raise ValueError or ImportError if a training's libraries, device, precision or logger are unavailable."""
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


def is_leader() -> bool:
    """Tell whether this is the training process, among several, that writes and evaluates."""
    with extra("train"):
        from lightning_fabric.utilities.rank_zero import rank_zero_only

    return getattr(rank_zero_only, "rank", 0) == 0


def make_loggers(kind: str | None, folder: Path, label: str) -> list[Any]:
    """Make the loggers of Fabric that ``train.logger`` names.

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
    if os.environ.get("LT_CLI_USED") != "1":  # otherwise ``fabric run`` has launched it
        fabric.launch()
    return fabric
