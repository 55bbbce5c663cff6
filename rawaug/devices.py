"""Devices by name, found or refused before any work."""

from __future__ import annotations

import torch

from rawaug.registry import nearest

KINDS = ("auto", "cpu", "cuda", "gpu", "mps")
"""What may be asked for: ``gpu`` is CUDA or Apple's MPS, whichever there is, and ``auto`` that or else the CPU."""


def find_device(name: str, key: str = "device", count: int = 1) -> torch.device:
    """The device called ``name``, which this machine has.

    Args:
        name: one of :data:`KINDS`; of several GPUs one is chosen by number, as in ``cuda:1``.
        key: opens the messages.
        count: how many such devices are needed.

    Raises:
        ValueError: if there is no such kind of device, or this machine has none of it, or fewer.

    Example:
        >>> find_device("cpu")
        device(type='cpu')
        >>> find_device("cdua")
        Traceback (most recent call last):
        ValueError: device 'cdua' is unknown; use one of auto, cpu, cuda, gpu, mps (nearest: cuda)
    """
    kind, _, number = name.partition(":")
    if kind not in KINDS or (number and not number.isdigit()):
        raise ValueError(f"{key} {name!r} is unknown; use one of {', '.join(KINDS)}{nearest(kind, KINDS)}")
    found = {"cuda": torch.cuda.device_count(), "mps": int(torch.backends.mps.is_available())}
    present = next((gpu for gpu, devices in found.items() if devices), None)
    if kind in ("auto", "gpu"):
        kind = present or ("cpu" if kind == "auto" else "cuda")
    if kind != "cpu" and int(number or 0) + count > found[kind]:
        raise ValueError(f"{key} {name!r}: {count} needed, this machine has {found[kind] or 'none'}; use cpu or auto")
    return torch.device(f"{kind}:{number}" if number else kind)
