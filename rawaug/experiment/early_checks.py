"""What would stop a training run late, found before any work: one line, within seconds.

Data, networks, noise and starting weights are opened or built besides, when the run itself is prepared.
"""

from __future__ import annotations

from importlib.util import find_spec

import torch

from rawaug.errors import MissingExtra, extra
from rawaug.evaluation.scores import require_classical
from rawaug.experiment.recipe import Recipe
from rawaug.experiment.run_folder import require_free
from rawaug.kernels.runtime import find_device
from rawaug.registry import name_and_settings

NEEDED = ("lightning_fabric", "tensorboard", "matplotlib", "PIL")
"""Of the extra ``train``: the loop, its log, the page and the picture."""


def require_runnable(recipe: Recipe, overwrite: bool = False) -> None:
    """Check libraries, device, precision, classical denoisers and the run's folder.

    Args:
        recipe: what is to be run.
        overwrite: replace another run of that name.

    Raises:
        MissingExtra: if a library is not installed.
        ValueError, OSError: in one line, naming the key and what to do.
    """
    for name in NEEDED:
        if find_spec(name) is None:
            raise MissingExtra(f"{name} is not installed; run: pip install 'rawaug[train]'")
    require_training_device(recipe.device, recipe.devices)
    require_precision(recipe.train.precision)
    if recipe.train.compile:
        require_compiler(find_device(recipe.device))
    estimate = ["NonLocalMeans"] if recipe.self_supervised else []  # of what noisy frames show
    require_classical([spec for spec in (*recipe.classical, *estimate) if name_and_settings(spec)[0] != "BM3D"])
    require_free(recipe, overwrite)


def require_training_device(device: str, devices: int = 1) -> None:
    """Check the device of a training.

    Raises:
        ValueError: if it is unknown or absent, there are fewer than ``devices``, or it is one GPU by number.
    """
    if devices < 1:
        raise ValueError(f"devices must be at least 1, got {devices}")
    if ":" in device:
        raise ValueError(
            f"device {device!r}: training takes a kind of device, as cuda; choose which by CUDA_VISIBLE_DEVICES"
        )
    find_device(device, count=devices)


def require_compiler(device: torch.device) -> None:
    """Check that ``torch.compile`` works on a device, by a function of one operation.

    Raises:
        ValueError: if it does not, for want of a C++ compiler above all.
    """
    try:
        torch.compile(torch.neg)(torch.zeros(8, device=device))
    except RuntimeError as error:
        raise ValueError(
            f"train.compile: PyTorch cannot compile here ({str(error).splitlines()[0]}); install a C++ compiler, or "
            "train without train.compile"
        ) from None


def require_precision(precision: str) -> None:
    """Check the precision of a training by the library that provides it.

    Raises:
        ValueError: if it is unknown, or needs a library that is not installed.
    """
    with extra("train"):
        from lightning_fabric import Fabric
    try:
        Fabric(accelerator="cpu", devices=1, precision=precision)
    except (ModuleNotFoundError, ValueError) as error:
        raise ValueError(f"train.precision: {' '.join(str(error).split())}") from None
