"""``rawaug info``: a readable description of a weights file."""

from __future__ import annotations

from json import dumps
from pathlib import Path
from typing import Any

import denoisers
from denoisers.files import FOLDER
from rawaug import __version__
from rawaug.files import find_weights, read_header, sha256
from rawaug.isp.model import DictionaryISP


def run(weights: str, /, *, json: bool = False) -> None:
    """Describe a weights file.

    Args:
        weights: a .safetensors file, or the name of a shipped ISP or denoiser.
        json: print one JSON object, for programs; of an ISP with its tone curve at 256 codes.
    """
    print(dumps(as_json(weights)) if json else describe(weights))


def as_json(weights: str | Path) -> dict[str, Any]:
    """What ``rawaug info --json`` prints: of an ISP see :func:`rawaug.isp.model.DictionaryISP.description`."""
    path = find_weights(weights, FOLDER)
    content: dict[str, Any] = {"file": str(path), "sha256": sha256(path), "version": __version__}
    if read_header(path)["kind"] == "isp":
        return content | DictionaryISP.from_pretrained(path).description()
    model, info = denoisers.load(path)
    parameters = sum(p.numel() for p in model.parameters())
    name = {"kind": "denoiser", "name": type(model).__name__, "parameters": parameters}
    return content | name | {"config": model.config, "info": info}


def describe(weights: str | Path) -> str:
    """Kind, size, settings and, for an ISP, its atoms as numbers."""
    path = find_weights(weights, FOLDER)
    if read_header(path)["kind"] == "isp":
        return _describe_isp(path)
    content = as_json(path)
    lines = [f"{path}: denoiser {content['name']}, {content['parameters'] / 1e6:.3f} M parameters"]
    lines += [f"  {key}: {dumps(value)}" for key, value in {**content["config"], **content["info"]}.items()]
    return "\n".join(lines)


def _describe_isp(path: Path) -> str:
    isp = DictionaryISP.from_pretrained(path)
    config, parameters = isp.config, sum(p.numel() for p in isp.parameters())
    lines = [f"{path}: dictionary ISP, {parameters / 1e6:.3f} M parameters, {isp.cfa} output"]
    lines.append(f"  stages: {' '.join(config.stages)} mosaic; encoders {'on' if config.encoders else 'off'}")
    weights = isp.reverse_encoders.gain.prior.softmax(0)
    lines.append("  gain atoms (digital, red, blue; constant weight):")
    for atom, weight in zip(isp.gain.atoms().tolist(), weights.tolist(), strict=True):
        lines.append("    " + "  ".join(f"{value:6.3f}" for value in atom) + f"   {weight:.3f}")
    rows = "sum 1" if config.cameras else "l1 norm 1"
    lines.append(f"  colour atoms (sRGB to camera, rows of {rows}):")
    for matrix in isp.colour.atoms().tolist():
        lines.append("    " + " | ".join(" ".join(f"{value:6.3f}" for value in row) for row in matrix))
    curve = isp.tone_curve().mean(dim=1)
    codes = ", ".join(f"{code} {curve[code].item():.4f}" for code in (16, 32, 64, 128, 192, 255))
    lines.append(f"  tone and gamma, grey code to linear: {codes}")
    lines += [f"  {text}" for stage in isp.ordered_stages if (text := stage.describe())]
    lines += [f"  {key}: {dumps(value)}" for key, value in isp.info.items()]
    return "\n".join(lines)
