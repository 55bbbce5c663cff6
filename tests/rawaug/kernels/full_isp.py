"""ISPs in which every stage does something, for tests of the kernels."""

from __future__ import annotations

from typing import Any

import torch

from rawaug.isp.config import ISPConfig
from rawaug.isp.model import DictionaryISP
from rawaug.isp.stages import LensShading, ToneMap

CONFIGURATIONS: dict[str, dict[str, Any]] = {
    "all stages": {},
    "no attention": {"attention": False},
    "no shading": {"stages": ("tone", "colour", "gains")},
    "curves": {"stages": ("curve", "colour", "gains", "shading"), "tone_atoms": 2},
}
"""Settings that between them reach every branch of the kernels."""


def full_isp(**settings: Any) -> DictionaryISP:
    """Untrained, its matrices, curves and networks moved away from the identity."""
    generator = torch.Generator().manual_seed(0)
    isp = DictionaryISP(ISPConfig(cfa="GBRG", colour_atoms=3, gain_atoms=3, **settings)).requires_grad_(False)
    isp.colour.matrices.add_(0.3 * torch.rand(3, 3, 3, generator=generator))
    if tone := isp.stages.find(ToneMap):
        list(tone.reverse_network.parameters())[-2].normal_(std=0.05, generator=generator)
    if isp.tone:
        isp.tone.curves[0] **= 2
    if lens := isp.stages.find(LensShading):
        lens.mask.set(torch.tensor([0.1, 0.0]), 0.5 * torch.eye(2))
        if lens.reverse_attention:
            for layers in (lens.reverse_attention.layers, lens.reverse_attention.place_layers):
                list(layers.parameters())[-2].normal_(std=0.05, generator=generator)
    return isp
