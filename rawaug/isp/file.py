"""The file of an ISP: safetensors with the configuration in the header; what is off is not in it.

Files of version 0.1 held every network, in use or not, under other names. They are read as well: names are translated
and what is off is left out, which changes no output.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from torch import Tensor

from rawaug.files import parse_object, read_tensors, to_json, write_tensors
from rawaug.isp.config import ISPConfig

_ADVICE = "fit or copy it again"
_INFINITE = ("colour.spread",)
"""A width, which is infinite where the light says nothing of the colour."""
_OLD_NAMES = {
    "shading.": "stages.shading.mask.",
    **{
        f"{direction}_networks.{old}": new.format(direction)
        for direction in ("reverse", "forward")
        for old, new in {
            "tone.": "stages.tone.{}_network.",
            "gamma": "stages.gamma.{}_gamma",
            "attention.": "stages.shading.{}_attention.",
            "colour_encoder.": "{}_encoders.colour.",
            "gain_encoder.": "{}_encoders.gain.",
        }.items()
    },
}
"""Beginnings of names in files of version 0.1, and what they are now."""


def write_isp(config: ISPConfig, info: Mapping[str, Any], state: Mapping[str, Tensor], path: str | Path) -> None:
    """Write an ISP's file, whole or not at all."""
    header = {"format": "rawaug", "kind": "isp", "config": to_json(asdict(config)), "info": to_json(info)}
    write_tensors(state, header, path)


def read_isp(path: Path) -> tuple[ISPConfig, dict[str, Any], dict[str, Tensor]]:
    """Configuration, info and tensors of an ISP's file; the sizes that the configuration sets are those of the tensors.

    Raises:
        ValueError: if the file is not that of an ISP, or its header is damaged.
    """
    header, state = read_tensors(path, _ADVICE, _INFINITE)
    if header.get("kind") != "isp":
        raise ValueError(f"{path}: holds {header.get('kind', 'no rawaug weights')}, not an ISP")
    try:
        config = ISPConfig(**parse_object(header["config"]))
        info = parse_object(header.get("info", "{}"))
    except (LookupError, TypeError, ValueError) as error:
        raise damaged(path, error) from error
    if any(key.startswith("reverse_networks.") for key in state):
        state = _translated(state, config)
    for key, size in _sizes(config).items():
        if key not in state or state[key].shape[:1] != (size,):
            raise misfit(path, key)
    return config, info, state


def damaged(path: Path, error: Exception) -> ValueError:
    """What to raise for a configuration that no ISP can have."""
    reason = " ".join(str(error).split())
    return ValueError(f"{path}: its configuration is damaged ({reason}); {_ADVICE}")


def misfit(path: Path, key: str) -> ValueError:
    """What to raise for a tensor that is missing, left over or of another shape."""
    return ValueError(f"{path}: tensor {key} does not fit its configuration; {_ADVICE}")


def _sizes(config: ISPConfig) -> dict[str, int]:
    """Leading sizes of the tensors that grow with the configuration: a damaged one must not ask for endless memory."""
    sizes = {"colour.matrices": config.colour_atoms, "gain.log_gains": config.gain_atoms}
    if config.cameras:
        sizes["colour.known"] = config.cameras
    if config.tone_atoms:
        sizes["stages.curve.dictionary.curves"] = config.tone_atoms
    if config.encoders:
        for k, width in enumerate(config.encoder_widths):
            sizes[f"reverse_encoders.colour.layers.{2 * k}.weight"] = width
    return sizes


def _translated(state: Mapping[str, Tensor], config: ISPConfig) -> dict[str, Tensor]:
    new: dict[str, Tensor] = {}
    for key, value in state.items():
        old = next((old for old in _OLD_NAMES if key.startswith(old)), "")
        name = _OLD_NAMES[old] + key.removeprefix(old) if old else key
        if _in_use(name, config):
            new[name] = value
    return new


def _in_use(name: str, config: ISPConfig) -> bool:
    part, _, rest = name.partition(".")
    if part == "stages":
        return rest.partition(".")[0] in config.stages and (config.attention or "_attention." not in rest)
    return config.encoders or not (part.endswith("_encoders") and ".layers." in rest)
