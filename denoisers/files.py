"""Networks by name, and files of their weights.

A file is safetensors whose string metadata says how to build the network again: ``{"format": "rawaug", "kind":
"denoiser", "model": "UNet", "config": <JSON: the constructor's arguments>, "info": <JSON: anything else>}``. Nothing in
it is code; a file can only name the classes in :data:`denoisers.network.DENOISERS`. Shipped weights have a model card
next to them, which says how they were trained.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from denoisers.network import DENOISERS, Denoiser
from rawaug.bayer import canonical_cfa
from rawaug.files import parse_object, read_tensors, write_tensors

FORMAT, KIND = "rawaug", "denoiser"
MOST_WEIGHTS = 2**30
"""A network has at most this many weights (4 GiB); a larger one is refused before it takes memory."""
FOLDER = Path(__file__).parent / "weights"
"""This folder holds the shipped weights and their cards."""
DEFAULT = "rawaug-small"
"""This is the default denoiser."""
JOINT = "rawaug-joint"
"""This is the default network that demosaics and denoises."""


def build(name: str, **config: Any) -> Denoiser:
    """Make a network of the class ``name`` with ``config`` as its constructor's arguments.

    Raises:
        ValueError: if the name or a key is unknown, a value is of the wrong type or out of range, or the network has
            more than :data:`MOST_WEIGHTS`.

    Example:
        >>> build("DnCNN", width=8, depth=3).config["depth"]
        3
    """
    outline(name, config)
    network: Denoiser = DENOISERS.make({"name": name, "settings": config})
    return network


def outline(name: str, config: dict[str, Any]) -> Denoiser:
    """Make the network of :func:`build` on the meta device, where its weights take no memory."""
    DENOISERS[name]  # imports its module, which may make tensors, while tensors are still real
    with torch.device("meta"):
        network: Denoiser = DENOISERS.make({"name": name, "settings": config})

    size = sum(weight.numel() for weight in network.parameters())
    if size > MOST_WEIGHTS:
        raise ValueError(f"denoiser {name}: {config} has {size:.3g} weights; choose a smaller one")
    return network


def save(model: Denoiser, path: str | os.PathLike[str], info: dict[str, Any]) -> None:
    """Write a registered network and a JSON-serialisable ``info`` to ``path``, completely or not at all.

    Raises:
        ValueError: if the class is not registered, or ``info`` is not JSON-serialisable.
        FileNotFoundError: if the folder does not exist.
    """
    path = Path(path)
    name = DENOISERS.name_of(type(model))
    if name is None:
        raise ValueError(f"{path}: cannot save a {type(model).__name__}; only {', '.join(DENOISERS)} load again")
    if not path.parent.is_dir():
        raise FileNotFoundError(f"{path}: its folder does not exist; create it first")
    if "cfa" in info:
        canonical_cfa(str(info["cfa"]))  # raises for an unknown pattern

    try:
        metadata = {
            "format": FORMAT,
            "kind": KIND,
            "model": name,
            "config": json.dumps(model.config),
            "info": json.dumps(info, allow_nan=False),
        }
    except (TypeError, ValueError) as error:
        raise ValueError(f"{path}: info must be JSON-serialisable, its numbers finite: {error}") from None

    tensors = {}
    for key, value in model.state_dict().items():
        # A PReLU that several layers share stands under several keys with the same memory, so each key gets a copy.
        tensors[key] = value.detach().cpu().clone()
    write_tensors(tensors, metadata, path)


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
    return restore(path, metadata, tensors)


def restore(path: Path, metadata: Mapping[str, str], tensors: Mapping[str, Tensor]) -> tuple[Denoiser, dict[str, Any]]:
    """Build the network that the content of a file describes; see :func:`load`.

    Args:
        path: the file, for messages.
        metadata, tensors: its content.
    """
    if (metadata.get("format"), metadata.get("kind")) != (FORMAT, KIND):
        raise ValueError(f"{path}: not a denoiser of rawaug (its metadata lack format={FORMAT}, kind={KIND})")
    try:
        config = parse_object(metadata.get("config", ""))
        info = parse_object(metadata.get("info", ""))
        # This is an outline, as the file's tensors may not fit it. It is float32, whatever the default is.
        model = outline(metadata.get("model", ""), config).float()
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None

    weights = {}
    for key, value in tensors.items():
        if value.dtype == torch.float16:  # takes half of the bytes in a file
            value = value.float()
        weights[key] = value

    expected = model.state_dict()
    for key in sorted(weights | expected):
        form = _form(weights.get(key), "missing")
        expected_form = _form(expected.get(key), "no such tensor")
        if form != expected_form:
            raise ValueError(f"{path}: tensor {key} is {form}, the network needs {expected_form}")

    model.load_state_dict(weights, assign=True)
    return model.eval(), info


def _form(tensor: Tensor | None, absence: str) -> str:
    """Describe the shape and type of a tensor; return ``absence`` if there is none."""
    if tensor is None:
        return absence
    return f"{tuple(tensor.shape)} {tensor.dtype}"


def list_shipped() -> list[str]:
    """List the names that :func:`from_pretrained` knows."""
    return sorted(file.stem for file in FOLDER.glob("*.safetensors"))


def find_denoiser(name: str | Path) -> Path:
    """Find the file of a denoiser by its path or by a shipped one's name; raise FileNotFoundError if there is none."""
    path = Path(name)
    if not path.suffix:
        path = FOLDER / f"{name}.safetensors"
    if path.is_file():
        return path

    isp = Path(__file__).parents[1] / "rawaug" / "weights" / f"{name}.safetensors"
    if isp.is_file():
        raise ValueError(f"{name}: is a camera's ISP, not a denoiser; load it by rawaug.DictionaryISP.from_pretrained")
    shipped = ", ".join(list_shipped()) or "none in this installation"
    raise FileNotFoundError(f"{name}: no such denoiser; give a .safetensors file or a shipped one ({shipped})")


def from_pretrained(name: str | Path = DEFAULT) -> Denoiser:
    """Load a trained denoiser by the name of a shipped one or from a path, on the CPU in eval mode.

    Raises:
        FileNotFoundError: if there is no such denoiser.
        ValueError: if the file is not a denoiser's.

    Example:
        >>> denoiser = from_pretrained("rawaug-small")  # doctest: +SKIP
        >>> clean = denoiser(noisy, variance)  # both (B, 4, h, w) packed RAW; variance of each value  # doctest: +SKIP
    """
    return load(find_denoiser(name))[0]
