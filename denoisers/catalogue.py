"""The networks by name: ``build("UNet", width=16)``. Nothing else can be named in a file of weights or a recipe."""

from __future__ import annotations

import inspect
from types import MappingProxyType
from typing import Any

from denoisers.dhdn import DHDN
from denoisers.dncnn import DnCNN
from denoisers.nafnet import NAFNet
from denoisers.network import Denoiser
from denoisers.pmrid import PMRID
from denoisers.unet import UNet

DENOISERS = MappingProxyType({"UNet": UNet, "DHDN": DHDN, "DnCNN": DnCNN, "PMRID": PMRID, "NAFNet": NAFNet})
"""Name to class."""


def build(name: str, **config: Any) -> Denoiser:
    """A new network of the class ``name``, with ``config`` as its constructor's arguments.

    Raises:
        ValueError: if the name or a key is unknown, or a value is of the wrong type or out of range.

    Example:
        >>> build("DnCNN", width=8, depth=3).config["depth"]
        3
    """
    if name not in DENOISERS:
        raise ValueError(f"denoiser {name!r} is unknown; use one of {', '.join(DENOISERS)}")
    settings = inspect.signature(DENOISERS[name]).parameters
    for key, value in config.items():
        if key not in settings:
            raise ValueError(f"{name} has no setting {key!r}; use one of {', '.join(settings)}")
        expected = type(settings[key].default)
        if expected is tuple and isinstance(value, list):  # as JSON and YAML have it
            config[key] = value = tuple(value)
        if type(value) is not expected:
            raise ValueError(f"{name}: {key} must be {expected.__name__}, got {value!r}")
    return DENOISERS[name](**config)
