r"""The tone stage without a network: a picture's curve is a mixture of known ones, or the one of a fitted camera.

``x2 = T(x)`` with ``T = sum_k v_k T_k``, in place of the learned tone network and gamma of the paper. The way back
looks the code up on the same curve; where the curve is flat, the lowest code is taken.

A fit bends a standard's curve :math:`T_0`, whose slope it scales on each of 51 pieces of five codes:

.. math:: T(s) = \int_0^s e^{l(u)} T_0'(u) \, du \Big/ \int_0^1 e^{l(u)} T_0'(u) \, du .
"""

from __future__ import annotations

import torch
from torch import Tensor

from rawaug.isp.config import ISPConfig
from rawaug.isp.dictionary import ToneDictionary
from rawaug.isp.setting import ISPParams
from rawaug.isp.stage import Dials, Stage, Tables, register
from rawaug.isp.tone_curves import NODES, STEPS, to_code, to_linear

PIECES = 51


@register
class ToneCurve(Stage):
    """f1 and f2 in one: the picture's inverse tone curve, or the typical one where the setting is not chosen yet.

    Raises:
        ValueError: if there are no tone atoms, or the stages contain the learned curve as well.
    """

    name, makes = "curve", 2

    def __init__(self, config: ISPConfig) -> None:
        super().__init__(config)
        if config.tone_atoms < 1 or {"tone", "gamma"} & set(config.stages):
            raise ValueError(
                f"stages: 'curve' takes tone_atoms, at least 1, and replaces tone and gamma; got "
                f"{config.tone_atoms} and {' '.join(config.stages)}"
            )
        self.dictionary = ToneDictionary(config.tone_atoms)
        self.slopes: Tensor | None = None  # (K, PIECES), l, during a fit

    def reverse(self, x: Tensor, params: ISPParams | None, place: Tensor | None = None) -> Tensor:
        return to_linear(x, self._curves(len(x), params))

    def forward(self, x: Tensor, params: ISPParams | None, place: Tensor | None = None) -> Tensor:
        return to_code(x, self._curves(len(x), params))

    def bake(self, tables: Tables) -> Tables:
        return tables._replace(x2=self.reverse(tables.x2, None))

    def adjust(self, dials: Dials, params: ISPParams, place: Tensor | None, size: tuple[int, int]) -> Dials:
        return dials._replace(curves=self.dictionary.combine(params.tone_weights.to(dials.matrix)))

    def describe(self) -> str:
        return f"tone curves: {self.config.tone_atoms}, at code 128 " + " ".join(
            f"{value:.3f}" for value in self.dictionary.curves[:, 128 * STEPS].tolist()
        )

    def coarse_parameters(self) -> dict[str, Tensor]:
        return {} if self.slopes is None else {"slopes": self.slopes}

    def coarse(self, x: Tensor, place: Tensor | None) -> Tensor:
        return self.reverse(x, None)

    @torch.no_grad()
    def start_coarse(self, gamma: float, toe: float) -> None:
        code = torch.linspace(0.0, 1.0, NODES, dtype=torch.float64)
        curve = (code + toe * (1.0 - code)) ** gamma
        self.dictionary.curves.copy_((curve - curve[0]) / (1.0 - curve[0]))
        self.slopes = torch.zeros(self.config.tone_atoms, PIECES)

    @torch.no_grad()
    def start_forward(self) -> None:
        """The curves are those of the reverse pass from now on."""
        self.dictionary.curves.copy_(self._bent())
        self.slopes = None

    def parameters_of(self, forward: bool) -> dict[str, Tensor]:
        return {} if forward or self.slopes is None else {f"{self.name}.slopes": self.slopes}

    def _bent(self) -> Tensor:
        """The curves under the slopes of a fit."""
        if self.slopes is None:
            return self.dictionary.curves
        rises = self.dictionary.curves.diff(dim=1) * self.slopes.exp().repeat_interleave((NODES - 1) // PIECES, dim=1)
        heights = torch.nn.functional.pad(rises.cumsum(dim=1), (1, 0))
        return heights / heights[:, -1:]

    def _curves(self, batch: int, params: ISPParams | None) -> Tensor:
        """One curve a picture; the typical one where none is chosen."""
        weights = self.dictionary.typical[None]
        if params is not None and params.tone_weights.shape[1]:
            weights = params.tone_weights.to(weights)
        weights = weights.expand(batch, -1)
        return self.dictionary.combine(weights) if self.slopes is None else weights @ self._bent()
