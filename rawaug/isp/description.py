"""An ISP as numbers: its tables and curves, and a description as JSON."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import torch
from torch import Tensor

from rawaug.isp.config import ISPParams
from rawaug.isp.model import DictionaryISP
from rawaug.isp.stages import LensShading, node_colours


@torch.no_grad()
def reverse_table(isp: DictionaryISP, setting: ISPParams, nodes: int = 33) -> Tensor:
    """Tabulate the reverse pass up to the mosaic, at the centre of the shading.

    Args:
        isp: the ISP.
        setting: the setting of one picture.
        nodes: number of sRGB values an axis.

    Returns:
        Linear camera RGB ``(nodes ** 3, 3)``, black 0 and white 1, red changing fastest.
    """
    cube = node_colours(nodes)
    shading = isp.stages.find(LensShading)
    centre = torch.zeros(2)
    if shading is not None:
        centre = shading.mask.mean

    coordinates = centre[None, :, None, None].expand(1, 2, *cube.shape[-2:])
    return isp.stages.reverse(cube, setting, coordinates)[0].flatten(1).T.contiguous()


@torch.no_grad()
def tone_table(isp: DictionaryISP) -> Tensor:
    """Compute linear x2 of the 256 greys of sRGB, ``(256, 3)``: tone and gamma in one curve per channel."""
    return isp.stages.linear(torch.linspace(0.0, 1.0, 256).expand(1, 3, 1, -1))[0, :, 0].T.contiguous()


@torch.no_grad()
def describe_isp(isp: DictionaryISP) -> dict[str, Any]:
    """Describe an ISP as JSON: its atoms, curves and mask, its typical setting, and the record of the fit."""
    setting, shading, info = isp.typical_setting(), isp.stages.find(LensShading), dict(isp.info)
    mask = shading and {"mean": shading.mask.mean.tolist(), "precision": shading.mask.precision.tolist()}
    return {
        "kind": "isp",
        "cfa": str(isp.cfa),
        "config": asdict(isp.config),
        "parameters": sum(p.numel() for p in isp.parameters()),
        "rendering": info.pop("rendering", None),
        "colour_atoms": isp.colour.atoms().tolist(),
        "gain_atoms": isp.gain.atoms().tolist(),
        "setting": {
            "colour_weights": setting.colour_weights[0].tolist(),
            "gain_weights": setting.gain_weights[0].tolist(),
            "matrix": setting.matrix[0].tolist(),
            "gains": setting.gains[0].tolist(),
        },
        "tone_curve": tone_table(isp).tolist(),
        "shading": mask,
        "noise": info.pop("noise", None),
        "info": info,
    }
