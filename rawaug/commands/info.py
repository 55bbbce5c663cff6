"""``rawaug info``: a readable description of a weights file."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import denoisers
from denoisers.pretrained import FOLDER
from rawaug.files import find_weights, read_header
from rawaug.isp.model import DictionaryISP


def add_arguments(parser: Any) -> None:
    """The command's arguments."""
    parser.add_argument("weights", type=str, help="a .safetensors file, or the name of a shipped ISP or denoiser")


def run(arguments: Any) -> None:
    """Print the description."""
    print(describe(arguments.weights))


def describe(weights: str | Path) -> str:
    """Kind, size, settings and, for an ISP, its atoms as numbers.

    Raises:
        FileNotFoundError, ValueError: if there is no such file, or it is not rawaug's.
    """
    path = find_weights(weights, FOLDER)
    kind = read_header(path)["kind"]
    if kind == "isp":
        return _describe_isp(path)
    model, info = denoisers.load(path)
    lines = [f"{path}: denoiser {type(model).__name__}, {_millions(model)} M parameters"]
    lines += [f"  {key}: {json.dumps(value)}" for key, value in {**model.config, **info}.items()]
    return "\n".join(lines)


def _millions(model: DictionaryISP | denoisers.Denoiser) -> str:
    return f"{sum(p.numel() for p in model.parameters()) / 1e6:.3f}"


def _describe_isp(path: Path) -> str:
    isp = DictionaryISP.from_pretrained(path)
    config = isp.config
    lines = [f"{path}: dictionary ISP, {_millions(isp)} M parameters, {isp.cfa} output"]
    lines.append(f"  stages: {' '.join(config.stages)} mosaic; encoders {'on' if config.encoders else 'off'}")
    lines.append(
        f"  gamma: {isp.reverse_networks.gamma.item():.3f} reverse, {isp.forward_networks.gamma.item():.3f} forward"
    )
    weights = isp.reverse_networks.gain_encoder.prior.softmax(0)
    lines.append("  gain atoms (digital, red, blue; constant weight):")
    for atom, weight in zip(isp.gain.atoms().tolist(), weights.tolist(), strict=True):
        lines.append("    " + "  ".join(f"{value:6.3f}" for value in atom) + f"   {weight:.3f}")
    lines.append("  colour atoms (sRGB to camera, rows l1-normalised):")
    for matrix in isp.colour.atoms().tolist():
        lines.append("    " + " | ".join(" ".join(f"{value:6.3f}" for value in row) for row in matrix))
    if "shading" in config.stages:
        mean, precision = isp.shading.mean.tolist(), isp.shading.precision.flatten().tolist()
        lines.append(f"  shading: mean {mean}, precision {[round(p, 3) for p in precision]}")
    lines += [f"  {key}: {json.dumps(value)}" for key, value in isp.info.items()]
    return "\n".join(lines)
