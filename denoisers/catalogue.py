"""The networks by name: ``build("UNet", width=16)``. Nothing else can be named in a file of weights or a recipe."""

from __future__ import annotations

from typing import Any

from denoisers.network import Denoiser
from rawaug.registry import DENOISERS

__all__ = ["DENOISERS", "build"]


def build(name: str, **config: Any) -> Denoiser:
    """A new network of the class ``name``, with ``config`` as its constructor's arguments.

    Raises:
        ValueError: if the name or a key is unknown, or a value is of the wrong type or out of range.

    Example:
        >>> build("DnCNN", width=8, depth=3).config["depth"]
        3
    """
    network: Denoiser = DENOISERS.make({"name": name, "settings": config})
    return network
