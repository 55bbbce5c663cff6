"""The five stages of the paper between sRGB and the mosaic; their formulas are in :mod:`rawaug.isp.stages`."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from rawaug.isp import stages
from rawaug.isp.config import ISPConfig
from rawaug.isp.setting import ISPParams
from rawaug.isp.stage import Dials, Stage, Tables, register
from rawaug.kernels.raw_torch import frame_of


@register
class ToneMap(Stage):
    """f1: a tone network for each direction."""

    name, makes = "tone", 1
    toe: Tensor

    def __init__(self, config: ISPConfig) -> None:
        super().__init__(config)
        self.reverse_network = stages.ToneNetwork()
        self.forward_network = stages.ToneNetwork()
        self.register_buffer("toe", torch.zeros(()), persistent=False)

    def reverse(self, x: Tensor, params: ISPParams | None, place: Tensor | None = None) -> Tensor:
        y: Tensor = self.reverse_network(x)
        return y

    def forward(self, x: Tensor, params: ISPParams | None, place: Tensor | None = None) -> Tensor:
        y: Tensor = self.forward_network(x)
        return y

    def bake(self, tables: Tables) -> Tables:
        return tables._replace(x2=self.reverse(tables.x2, None))

    def coarse_parameters(self) -> dict[str, Tensor]:
        return {"toe": self.toe}

    def coarse(self, x: Tensor, place: Tensor | None) -> Tensor:
        return x + self.toe * (1.0 - x)

    def start_coarse(self, gamma: float, toe: float) -> None:
        self.toe.fill_(toe)

    def start_fine(self) -> None:
        self.reverse_network.start_from(float(self.toe))


@register
class Gamma(Stage):
    """f2: a power for each direction, 2.2 at first."""

    name, makes = "gamma", 2

    def __init__(self, config: ISPConfig) -> None:
        super().__init__(config)
        self.reverse_gamma = nn.Parameter(torch.tensor(2.2))
        self.forward_gamma = nn.Parameter(torch.tensor(2.2))

    def reverse(self, x: Tensor, params: ISPParams | None, place: Tensor | None = None) -> Tensor:
        return stages.gamma_expand(x, self.reverse_gamma)

    def forward(self, x: Tensor, params: ISPParams | None, place: Tensor | None = None) -> Tensor:
        return stages.gamma_compress(x, self.forward_gamma)

    def bake(self, tables: Tables) -> Tables:
        return tables._replace(x2=self.reverse(tables.x2, None))

    def describe(self) -> str:
        return f"gamma: {self.reverse_gamma.item():.3f} reverse, {self.forward_gamma.item():.3f} forward"

    def coarse_parameters(self) -> dict[str, Tensor]:
        return {"gamma": self.reverse_gamma}

    def coarse(self, x: Tensor, place: Tensor | None) -> Tensor:
        return self.reverse(x, None)

    @torch.no_grad()
    def start_coarse(self, gamma: float, toe: float) -> None:
        self.reverse_gamma.fill_(gamma)

    @torch.no_grad()
    def start_forward(self) -> None:
        self.forward_gamma.copy_(self.reverse_gamma)


@register
class ColorCorrection(Stage):
    """f3: the picture's matrix."""

    name, makes = "colour", 3

    def reverse(self, x: Tensor, params: ISPParams | None, place: Tensor | None = None) -> Tensor:
        return stages.correct_colour(x, chosen(params).matrix)

    def forward(self, x: Tensor, params: ISPParams | None, place: Tensor | None = None) -> Tensor:
        return stages.correct_colour(x, torch.linalg.pinv(chosen(params).matrix))

    def bake(self, tables: Tables) -> Tables:
        return tables

    def adjust(self, dials: Dials, params: ISPParams, place: Tensor | None, size: tuple[int, int]) -> Dials:
        return dials._replace(matrix=params.matrix.to(dials.matrix))


@register
class WhiteBalance(Stage):
    """f4: the picture's gains, with Brooks' care for highlights on the way back."""

    name, makes = "gains", 4

    def reverse(self, x: Tensor, params: ISPParams | None, place: Tensor | None = None) -> Tensor:
        return stages.inverse_gains(x, chosen(params).gains, self.config.knee)

    def forward(self, x: Tensor, params: ISPParams | None, place: Tensor | None = None) -> Tensor:
        return stages.apply_gains(x, chosen(params).gains)

    def bake(self, tables: Tables) -> Tables:
        return tables

    def adjust(self, dials: Dials, params: ISPParams, place: Tensor | None, size: tuple[int, int]) -> Dials:
        return dials._replace(floor=1.0 / params.gains.to(dials.floor)[:, None])


@register
class LensShading(Stage):
    """f5: a Gaussian mask over the frame and, if the settings say so, an attention mask for each direction."""

    name, makes = "shading", 5

    def __init__(self, config: ISPConfig) -> None:
        super().__init__(config)
        self.mask = stages.GaussianMask()
        self.reverse_attention = stages.AttentionMask() if config.attention else None
        self.forward_attention = stages.AttentionMask() if config.attention else None

    def reverse(self, x: Tensor, params: ISPParams | None, place: Tensor | None = None) -> Tensor:
        x = x * self.mask(stages.placed(x, place))
        return x if self.reverse_attention is None else x * self.reverse_attention(x)

    def forward(self, x: Tensor, params: ISPParams | None, place: Tensor | None = None) -> Tensor:
        x = x / self.mask(stages.placed(x, place))
        return x if self.forward_attention is None else x * self.forward_attention(x)

    def bake(self, tables: Tables) -> Tables:
        return (
            tables if self.reverse_attention is None else tables._replace(attention=self.reverse_attention(tables.cube))
        )

    def adjust(self, dials: Dials, params: ISPParams, place: Tensor | None, size: tuple[int, int]) -> Dials:
        centre = (float(self.mask.mean[0]), float(self.mask.mean[1]))
        places = [[0, 0, *size]] * len(dials.frame) if place is None else place.tolist()
        frame = dials.frame.new_tensor([frame_of(p, *size, centre) for p in places]).reshape(len(dials.frame), 6)
        precision = self.mask.precision * (0.5 / math.log(2.0))
        shading = torch.stack([precision[0, 0], 2.0 * precision[0, 1], precision[1, 1]])
        return dials._replace(frame=frame, shading=shading)

    def describe(self) -> str:
        mean, precision = self.mask.mean.tolist(), self.mask.precision.flatten().tolist()
        return f"shading: mean {mean}, precision {[round(p, 3) for p in precision]}"

    def coarse_parameters(self) -> dict[str, Tensor]:
        return {f"mask.{key}": p for key, p in self.mask.named_parameters()}

    def coarse(self, x: Tensor, place: Tensor | None) -> Tensor:
        return x * self.mask(stages.placed(x, place))


def chosen(params: ISPParams | None) -> ISPParams:
    """``params``, which a stage after x2 cannot do without."""
    if params is None:
        raise ValueError("this stage needs the pictures' parameters; choose them first")
    return params
