"""The tone stage of an ISP of published cameras: a picture's curve is a mixture of measured ones.

``x2 = T(x)`` with ``T = sum_k v_k T_k``, in place of the learned tone network and gamma of the paper. The way back
looks the code up on the same curve; where the curve is flat, the lowest code is taken.
"""

from __future__ import annotations

from torch import Tensor

from rawaug.isp.config import ISPConfig
from rawaug.isp.dictionary import ToneDictionary
from rawaug.isp.setting import ISPParams
from rawaug.isp.stage import Dials, Stage, Tables, register
from rawaug.isp.tone_curves import STEPS, to_code, to_linear


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

    def _curves(self, batch: int, params: ISPParams | None) -> Tensor:
        typical = self.dictionary.typical
        return self.dictionary.combine(typical.expand(batch, -1) if params is None else params.tone_weights.to(typical))
