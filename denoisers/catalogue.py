"""The networks by name: ``build("UNet", width=16)``. Nothing else can be named in a file of weights or a recipe."""

from __future__ import annotations

from typing import Any

import torch

from denoisers.network import Denoiser
from rawaug.registry import DENOISERS

__all__ = ["DENOISERS", "build"]

MOST_WEIGHTS = 2**30
"""Of a network: 4 GiB. Larger ones are refused before they take memory."""


def build(name: str, **config: Any) -> Denoiser:
    """A new network of the class ``name``, with ``config`` as its constructor's arguments.

    Raises:
        ValueError: if the name or a key is unknown, a value is of the wrong type or out of range, or the network has
            more than :data:`MOST_WEIGHTS`.

    Example:
        >>> build("DnCNN", width=8, depth=3).config["depth"]
        3
    """
    spec = {"name": name, "settings": config}
    with torch.device("meta"):
        network: Denoiser = DENOISERS.make(spec)
    size = sum(weight.numel() for weight in network.parameters())
    if size > MOST_WEIGHTS:
        raise ValueError(f"denoiser {name}: {config} has {size:.3g} weights; choose a smaller one")
    if torch.get_default_device().type != "meta":
        network = DENOISERS.make(spec)
    return network
