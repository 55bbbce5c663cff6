r"""A fitted ISP as numbers: its setting without a picture, its tone curve, and its reverse pass as a table.

Up to the lens shading the reverse pass is pointwise, so that one table over the sRGB cube,

.. math:: x_4 = \mathrm{LUT}(x), \qquad x \in [0, 1]^3,

holds it for one setting of the camera: sRGB in, linear camera RGB out, black 0, white 1, at the centre of the shading.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import torch
from torch import Tensor

from rawaug.isp import conditioning
from rawaug.isp.config import ISPParams
from rawaug.isp.model import DictionaryISP
from rawaug.isp.stages import LensShading, node_colours

CODES = 256


def typical_setting(isp: DictionaryISP, white_balance: Sequence[float] | None = None) -> ISPParams:
    """The setting that the ISP's constants choose, for one picture; or that of a light.

    Args:
        isp: the ISP; encoders are not asked.
        white_balance: as-shot multipliers R, G, B.
    """
    encoders = isp.reverse_encoders
    weights = [encoder.prior.softmax(0)[None] for encoder in (encoders.colour, encoders.gain)]
    given = None if white_balance is None else tuple(white_balance)
    return conditioning.with_white_balance(isp, isp.params_from_weights(*weights), given, None)


@torch.no_grad()
def reverse_table(isp: DictionaryISP, setting: ISPParams, nodes: int = 33) -> Tensor:
    """Linear camera RGB ``(nodes ** 3, 3)`` of the sRGB colours of a cube's nodes, red changing fastest.

    Args:
        isp: the ISP.
        setting: of one picture.
        nodes: along each axis.
    """
    cube = node_colours(nodes)
    shading = isp.find(LensShading)
    centre = torch.zeros(2) if shading is None else shading.mask.mean
    place = centre[None, :, None, None].expand(1, 2, *cube.shape[-2:])
    return isp.reverse_pixels(cube, setting, place)[0].flatten(1).T.contiguous()


@torch.no_grad()
def tone_curve(isp: DictionaryISP) -> Tensor:
    """x2, linear, of the 256 greys of sRGB: ``(256, 3)``, which are the channels R, G, B. It holds tone and gamma."""
    grey = torch.linspace(0.0, 1.0, CODES).expand(1, 3, 1, CODES)
    return isp.linear(grey)[0, :, 0].T.contiguous()


@torch.no_grad()
def description(isp: DictionaryISP, white_balance: Sequence[float] | None = None) -> dict[str, Any]:
    """What the ISP is made of, as JSON; ``setting`` is :func:`typical_setting`, ``info`` what the fit recorded."""
    setting, shading = typical_setting(isp, white_balance), isp.find(LensShading)
    info = dict(isp.info)
    return {
        "kind": "isp",
        "cfa": str(isp.cfa),
        "config": asdict(isp.config),
        "parameters": sum(p.numel() for p in isp.parameters()),
        "rendering": info.pop("rendering", None),
        "colour_atoms": isp.colour.atoms().tolist(),
        "gain_atoms": isp.gain.atoms().tolist(),
        "setting": {
            "white_balance": None if white_balance is None else list(white_balance),
            "colour_weights": setting.colour_weights[0].tolist(),
            "gain_weights": setting.gain_weights[0].tolist(),
            "matrix": setting.matrix[0].tolist(),
            "gains": setting.gains[0].tolist(),
        },
        "tone_curve": tone_curve(isp).tolist(),
        "shading": None
        if shading is None
        else {"mean": shading.mask.mean.tolist(), "precision": shading.mask.precision.tolist()},
        "noise": info.pop("noise", None),
        "info": info,
    }
