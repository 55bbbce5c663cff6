r"""Files of weights: safetensors, with what is needed to build the network again as string metadata.

``{"format": "rawaug", "kind": "denoiser", "model": "UNet", "config": <JSON: the constructor's arguments>,
"info": <JSON: anything else>}``. Nothing in such a file is code; only the classes in
:data:`rawaug.registry.DENOISERS` can be named. Format: https://huggingface.co/docs/safetensors.
"""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import torch

from denoisers.catalogue import DENOISERS, build
from denoisers.network import Denoiser
from rawaug.files import parse_object, read_tensors, write_tensors

FORMAT, KIND = "rawaug", "denoiser"


def save(model: Denoiser, path: str | os.PathLike[str], info: dict[str, Any]) -> None:
    """Write a network to ``path``: whole or not at all, an older file of this name stays until then.

    Args:
        model: one of the registered networks, on any device and in any memory format.
        path: the file, in a folder that exists; usually ``*.safetensors``.
        info: JSON-serialisable description (data, steps, seed, ...).

    Raises:
        ValueError: if the class is not registered, or ``info`` is not JSON-serialisable.
        FileNotFoundError: if the folder does not exist.
    """
    path = Path(path)
    name = DENOISERS.name_of(type(model))
    if name is None:
        known = ", ".join(DENOISERS)
        raise ValueError(f"{path}: cannot save a {type(model).__name__}; only {known} can be loaded again")
    if not path.parent.is_dir():
        raise FileNotFoundError(f"{path}: its folder does not exist; create it first")
    try:
        texts = {"config": json.dumps(model.config), "info": json.dumps(info, allow_nan=False)}
    except (TypeError, ValueError) as error:
        raise ValueError(f"{path}: info must be JSON-serialisable, its numbers finite: {error}") from None
    # A PReLU that is used all over stands under several keys, which share its memory: each is written.
    tensors = {key: value.detach().cpu().clone() for key, value in model.state_dict().items()}
    write_tensors(tensors, {"format": FORMAT, "kind": KIND, "model": name, **texts}, path)


def load(path: str | os.PathLike[str]) -> tuple[Denoiser, dict[str, Any]]:
    """Read what :func:`save` wrote: the network, on the CPU in eval mode, and the info.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is not such a file, or its weights do not fit the network that it names.

    Example:
        >>> import tempfile
        >>> from denoisers import DnCNN
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     save(DnCNN(width=8, depth=3), f"{folder}/small.safetensors", {"steps": 0})
        ...     load(f"{folder}/small.safetensors")[1]
        {'steps': 0}
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file")
    metadata, tensors = read_tensors(path, "give one written by rawaug run or denoisers.save, or copy it again")
    if (metadata.get("format"), metadata.get("kind")) != (FORMAT, KIND):
        raise ValueError(f"{path}: not a denoiser of rawaug (its metadata lack format={FORMAT}, kind={KIND})")
    config, info = (_parse(path, metadata, key) for key in ("config", "info"))
    try:
        # On the meta device the network takes no memory before the file's tensors are known to fit.
        with torch.device("meta"):
            model = build(metadata.get("model", ""), **config)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
    expected = model.state_dict()
    for key in sorted(expected.keys() | tensors.keys()):
        if key not in tensors or key not in expected:
            raise ValueError(f"{path}: tensor {key} is {'unknown' if key in tensors else 'missing'}")
        shape, dtype = tensors[key].shape, tensors[key].dtype
        if (shape, dtype) != (expected[key].shape, expected[key].dtype):
            wanted = f"{tuple(expected[key].shape)} {expected[key].dtype}"
            raise ValueError(f"{path}: tensor {key} is {tuple(shape)} {dtype}, the network needs {wanted}")
    model.load_state_dict(tensors, assign=True)
    return model.eval(), info


def _parse(path: Path, metadata: dict[str, str], key: str) -> dict[str, Any]:
    try:
        return parse_object(metadata.get(key, ""))
    except ValueError as error:
        raise ValueError(f"{path}: metadata {key!r}: {error}") from None
