"""Networks by name, and files of their weights.

A file is safetensors with string metadata that say how to build the network again: ``{"format": "rawaug", "kind":
"denoiser", "model": "UNet", "config": <JSON: the constructor's arguments>, "info": <JSON: anything else>}``. Nothing in
it is code; only the classes in :data:`denoisers.network.DENOISERS` can be named. Shipped weights have a model card
beside them, and ``recipes/base.yaml`` trained them.
"""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import torch

from denoisers.network import DENOISERS, Denoiser
from rawaug.bayer import canonical_cfa
from rawaug.files import parse_object, read_tensors, write_tensors

FORMAT, KIND = "rawaug", "denoiser"
MOST_WEIGHTS = 2**30
"""The weights of a network of 4 GiB; larger ones are refused before they take memory."""
FOLDER = Path(__file__).parent / "weights"
"""The folder of the shipped weights and their cards."""
DEFAULT = "rawaug-small"
"""The denoiser where none is named."""
JOINT = "rawaug-joint"
"""The network that demosaics and denoises where none is named."""


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
    DENOISERS[name]  # imports the module that has it, which may make tensors, while they are real
    with torch.device("meta"):
        network: Denoiser = DENOISERS.make({"name": name, "settings": config})
    size = sum(weight.numel() for weight in network.parameters())
    if size > MOST_WEIGHTS:
        raise ValueError(f"denoiser {name}: {config} has {size:.3g} weights; choose a smaller one")
    return network


def save(model: Denoiser, path: str | os.PathLike[str], info: dict[str, Any]) -> None:
    """Write a registered network and a JSON-serialisable ``info`` to ``path``, whole or not at all.

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
    try:
        config, info = (parse_object(metadata.get(key, "")) for key in ("config", "info"))
        # An outline: the file's tensors are not known to fit. Float32, whatever the default is.
        model = outline(metadata.get("model", ""), config).float()
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
    tensors = {key: x.float() if x.dtype == torch.float16 else x for key, x in tensors.items()}  # half of the bytes
    expected = model.state_dict()
    held, needed = ({key: f"{tuple(x.shape)} {x.dtype}" for key, x in of.items()} for of in (tensors, expected))
    for key in sorted(held | needed):
        if held.get(key) != needed.get(key):
            text = f"{held.get(key, 'missing')}, the network needs {needed.get(key, 'no such tensor')}"
            raise ValueError(f"{path}: tensor {key} is {text}")
    model.load_state_dict(tensors, assign=True)
    return model.eval(), info


def list_shipped() -> list[str]:
    """List the names that :func:`from_pretrained` knows."""
    return sorted(file.stem for file in FOLDER.glob("*.safetensors"))


def find_denoiser(name: str | Path) -> Path:
    """Find the file of a denoiser by its path or by the name of a shipped one; FileNotFoundError if there is none."""
    path = Path(name) if Path(name).suffix else FOLDER / f"{name}.safetensors"
    if not path.is_file():
        known = ", ".join(list_shipped()) or "none in this installation"
        if (Path(__file__).parents[1] / "rawaug" / "weights" / f"{name}.safetensors").is_file():
            raise ValueError(
                f"{name}: is a camera's ISP, not a denoiser; load it by rawaug.DictionaryISP.from_pretrained"
            )
        raise FileNotFoundError(f"{name}: no such denoiser; give a .safetensors file or a shipped one ({known})")
    return path


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
