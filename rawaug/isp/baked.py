r"""The fitted reverse pass as a table and a matrix: the same RAW, an order of magnitude faster.

``y_c = sum_k C[c, k] T_k(x) * max(m + (1 - m) / g_c, 1 / g_c) * G(p) A(x4)``

Tone network and gamma are the same for every picture, and pointwise: ``T`` is their table over the sRGB cube, read by
trilinear interpolation (65 nodes a side: above 80 dB against the network). Colour and gains are one matrix and three
numbers a picture. Every site computes its own colour alone, which the mosaic would keep anyway, so the result comes
packed. The attention mask, pointwise in x4, needs all three colours and has a table of its own.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from rawaug import bayer
from rawaug.isp import stages
from rawaug.isp.model import DictionaryISP
from rawaug.isp.params import POINTWISE_STAGES, ISPParams

NODES = 65
"""Nodes of the table along each axis of the sRGB cube."""


class BakedISP(nn.Module):
    """The reverse pass of an ISP as it is now; later changes of the ISP do not reach it.

    Args:
        isp: the fitted ISP, its stages in the usual order (any may be left out).
        nodes: of the table along an axis.

    Raises:
        ValueError: if the stages are in another order.

    Example:
        >>> isp = DictionaryISP()
        >>> srgb = torch.randint(256, (2, 3, 32, 32), dtype=torch.uint8)
        >>> BakedISP(isp)(srgb, isp.choose(srgb)).shape
        torch.Size([2, 4, 16, 16])
    """

    table: Tensor
    attention: Tensor

    def __init__(self, isp: DictionaryISP, nodes: int = NODES) -> None:
        super().__init__()
        self.config = isp.config
        if self.config.stages != tuple(stage for stage in POINTWISE_STAGES if stage in self.config.stages):
            raise ValueError(f"only stages in the usual order can be baked, got {' '.join(self.config.stages)}")
        axis = torch.linspace(0.0, 1.0, nodes)
        blue, green, red = torch.meshgrid(axis, axis, axis, indexing="ij")
        cube = torch.stack([red, green, blue]).reshape(1, 3, nodes, nodes * nodes)
        networks = isp.reverse_networks
        with torch.no_grad():
            x = networks.tone(cube) if "tone" in self.config.stages else cube
            x = stages.gamma_expand(x, networks.gamma) if "gamma" in self.config.stages else x
            self.register_buffer("table", x.reshape(1, 3, nodes, nodes, nodes))
            self.register_buffer("attention", networks.attention(cube).reshape(1, 1, nodes, nodes, nodes))
        self.shading = isp.shading

    @torch.no_grad()
    def forward(self, srgb: Tensor, params: ISPParams, place: Tensor | None = None) -> Tensor:
        """sRGB ``(B, 3, H, W)``, uint8 or float in [0, 1], to clean packed RAW ``(B, 4, H/2, W/2)``.

        Args:
            srgb: pictures with even sides.
            params: camera settings.
            place: coordinates in the full frame, ``(1 or B, 2, H, W)``; full frames by default.
        """
        x2 = self._look_up(self.table, srgb)
        kept = self.config.stages
        matrix = params.matrix if "colour" in kept else torch.eye(3).to(x2).expand(len(x2), 3, 3)
        inverse = 1.0 / params.gains if "gains" in kept else torch.ones(len(x2), 3).to(x2)
        if "shading" in kept and self.config.attention:
            return self._with_attention(x2, params, place)
        mask = self.shading(self._place(x2, place))[:, 0] if "shading" in kept else None
        mean = matrix.mean(dim=1) if "gains" in kept else None
        sites = zip((0, 1, 1, 2), self._sites(), strict=True)
        planes = [
            self._site(
                x2[..., i::2, j::2], matrix[:, c], inverse[:, c], mean, None if mask is None else mask[..., i::2, j::2]
            )
            for c, (i, j) in sites
        ]
        return torch.stack(planes, dim=1)

    def _site(self, x2: Tensor, row: Tensor, inverse: Tensor, mean: Tensor | None, mask: Tensor | None) -> Tensor:
        """One colour ``(B, h, w)`` at its own sites."""
        y = torch.einsum("bk,bkhw->bhw", row, x2)
        if mean is not None:
            floor = inverse[:, None, None]
            knee = self.config.knee
            highlight = (torch.einsum("bk,bkhw->bhw", mean, x2) - knee).div_(1.0 - knee).clamp_(0.0, 1.0).square_()
            y = y * torch.maximum(torch.lerp(floor, torch.ones_like(floor), highlight), floor)
        return y if mask is None else y * mask

    def _with_attention(self, x2: Tensor, params: ISPParams, place: Tensor | None) -> Tensor:
        x4 = stages.correct_colour(x2, params.matrix) if "colour" in self.config.stages else x2
        if "gains" in self.config.stages:
            x4 = stages.inverse_gains(x4, params.gains, self.config.knee)
        x4 = x4 * self.shading(self._place(x2, place))
        return bayer.pack_rgb(x4 * self._look_up(self.attention, x4.clamp(0.0, 1.0)), self.config.cfa)

    def _sites(self) -> tuple[tuple[int, int], ...]:
        return bayer.CFA(self.config.cfa).sites

    def _place(self, x: Tensor, place: Tensor | None) -> Tensor:
        return (stages.place_in_frame(*x.shape[-2:]) if place is None else place).to(x)

    @staticmethod
    def _look_up(table: Tensor, x: Tensor) -> Tensor:
        """Trilinear interpolation of ``table`` ``(1, C, N, N, N)`` (axes B, G, R) at ``x`` ``(B, 3, H, W)``."""
        batch, _, height, width = x.shape
        half = 127.5 if x.dtype == torch.uint8 else 0.5
        points = (x / half - 1.0).permute(0, 2, 3, 1)
        found = F.grid_sample(
            table, points.reshape(1, batch, height, width, 3), padding_mode="border", align_corners=True
        )
        return found[0].transpose(0, 1)
