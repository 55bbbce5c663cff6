"""The curve that a fit starts from, ``x5 = (x + toe (1 - x))^gamma G(p)``, and how the ISP's stages take it over.

sRGB, BT.709 and a plain gamma have this form, followed by each frame's matrix. G is the Gaussian mask. An ISP with the
stage ``curve`` bends a table instead, by the slopes of :class:`rawaug.isp.tone.ToneCurve`.
"""

from __future__ import annotations

import torch
from torch import Tensor

from rawaug.isp.functional import coordinates_or_full
from rawaug.isp.model import DictionaryISP
from rawaug.isp.stages import Gamma, LensShading, ToneMap
from rawaug.isp.tone import NODES, PIECES, ToneCurve


class StartCurve:
    """The curve and the mask of an ISP, which a fit changes in place.

    Args:
        isp: the ISP; its stages hold all numbers but the toe.
    """

    def __init__(self, isp: DictionaryISP) -> None:
        self.isp = isp
        self.toe = torch.zeros(())

    @torch.no_grad()
    def set(self, gamma: float, toe: float) -> None:
        """Set the curve to ``(x + toe (1 - x))^gamma``; a table is this minus its value at black."""
        self.toe.fill_(toe)
        power, table = self.isp.find(Gamma), self.isp.find(ToneCurve)
        if power is not None:
            power.reverse_gamma.fill_(gamma)
        if table is not None:
            code = torch.linspace(0.0, 1.0, NODES, dtype=torch.float64)
            curve = (code + toe * (1.0 - code)) ** gamma
            table.dictionary.curves.copy_((curve - curve[0]) / (1.0 - curve[0]))
            table.slopes = torch.zeros(len(table.dictionary.curves), PIECES)

    def numbers(self, with_mask: bool = True) -> dict[str, Tensor]:
        """The few numbers, by name, that :meth:`apply` depends on."""
        numbers: dict[str, Tensor] = {}
        if self.isp.find(ToneMap) is not None:
            numbers["tone.toe"] = self.toe
        power, table, shading = self.isp.find(Gamma), self.isp.find(ToneCurve), self.isp.find(LensShading)
        if power is not None:
            numbers["gamma.gamma"] = power.reverse_gamma
        if table is not None and table.slopes is not None:
            numbers["curve.slopes"] = table.slopes
        if shading is not None and with_mask:
            for key, parameter in shading.mask.named_parameters():
                numbers[f"shading.mask.{key}"] = parameter
        return numbers

    def apply(self, x: Tensor, coordinates: Tensor | None) -> Tensor:
        """Compute x2 by the curve, times the mask, from sRGB ``(B, 3, H, W)``.

        ``coordinates`` ``(1 or B, 2, H, W)`` are those of the pixels in the full frame; by default it is ``x``.
        """
        if self.isp.find(ToneMap) is not None:
            x = x + self.toe * (1.0 - x)
        power, table, shading = self.isp.find(Gamma), self.isp.find(ToneCurve), self.isp.find(LensShading)
        if power is not None:
            x = power.reverse(x, None)
        if table is not None:
            x = table.reverse(x, None)
        if shading is not None:
            x = x * shading.mask(coordinates_or_full(x, coordinates))
        return x

    def start_networks(self) -> None:
        """Start the tone network of the reverse pass as the curve with the toe."""
        tone = self.isp.find(ToneMap)
        if tone is not None:
            tone.reverse_network.start_from(float(self.toe))


@torch.no_grad()
def start_forward(isp: DictionaryISP) -> None:
    """Start the forward pass from the fitted reverse pass: its power, or its curves, which keep their slopes."""
    power, table = isp.find(Gamma), isp.find(ToneCurve)
    if power is not None:
        power.forward_gamma.copy_(power.reverse_gamma)
    if table is not None:
        table.dictionary.curves.copy_(table.bend())
        table.slopes = None


def trained_tensors(isp: DictionaryISP, forward: bool, up_to: int = 5) -> dict[str, Tensor]:
    """The tensors of the stages that a fit of a pass changes, as ``stage.name``, of the stages that make x1 ... x_k.

    Parameters whose names start with ``forward_`` belong to the forward pass, all others to the reverse pass.
    """
    tensors: dict[str, Tensor] = {}
    for stage in isp.ordered_stages:
        if stage.makes > up_to:
            continue
        for key, parameter in stage.named_parameters():
            if key.startswith("forward_") == forward:
                tensors[f"{stage.name}.{key}"] = parameter
        if isinstance(stage, ToneCurve) and stage.slopes is not None and not forward:
            tensors[f"{stage.name}.slopes"] = stage.slopes
    return tensors
