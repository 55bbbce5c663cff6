"""Where a training starts: at weights drawn from the seed, or at those of a trained denoiser."""

from __future__ import annotations

from typing import NamedTuple

import torch

import denoisers
from denoisers.network import Denoiser
from denoisers.pretrained import find
from rawaug.bayer import CFA
from rawaug.files import sha256
from rawaug.seeding import derived_seed
from rawaug.training.train_config import DenoiserConfig


class Start(NamedTuple):
    """The file that a training continues from.

    Args:
        sha256: of the file.
        cfa: the pattern that its network was trained for.
    """

    sha256: str
    cfa: CFA


def start_of(config: DenoiserConfig) -> Start | None:
    """What ``config.start`` names; None if the training starts from nothing.

    Raises:
        FileNotFoundError, ValueError: if there is no such denoiser, or the file is not one.
    """
    if config.start is None:
        return None
    path = find(config.start)
    return Start(sha256(path), CFA(denoisers.load(path)[1].get("cfa", "RGGB")))


def first_network(config: DenoiserConfig, seed: int) -> Denoiser:
    """The network before its first step, in train mode.

    Args:
        config: with ``start``, name and settings may be left at their defaults: the file's are taken.
        seed: draws the weights of a network without ``start``.

    Raises:
        FileNotFoundError: if there is no such denoiser.
        ValueError: if name or settings are unknown, or differ from those of the file.
    """
    if config.start is None:
        drawn = {"seed": derived_seed(seed, "network") % 2**31, **config.settings}
        return denoisers.build(config.name, **drawn)
    model, _ = denoisers.load(find(config.start))
    unnamed = DenoiserConfig(start=config.start)
    if config != unnamed:
        with torch.device("meta"):
            wanted = denoisers.build(config.name, **config.settings)
        if (type(wanted), wanted.config) != (type(model), model.config):
            raise ValueError(
                f"denoiser.start: {config.start} is a {type(model).__name__} with {model.config}, not a "
                f"{config.name} with {wanted.config}; leave denoiser.name and denoiser.settings out to take the file's"
            )
    return model.train()
