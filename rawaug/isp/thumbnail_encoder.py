r"""The encoders' choice of a camera setting, made cheap: the atoms are part of the encoders' first convolution.

An encoder looks at the N images that the atoms make of one picture. They are linear in few maps,

.. math:: D_n x_2 \quad\text{and}\quad x_3 (floor_n + m \, rise_n) = floor_n x_3 + rise_n (m x_3),

and so is a convolution of them: one of 3 maps, or 6, instead of 3 N, with the same result (symbols as in
:mod:`rawaug.kernels.reference`).
"""

from __future__ import annotations

from copy import deepcopy

import torch
from torch import Tensor, nn

from rawaug.isp.config import ISPParams
from rawaug.isp.model import DictionaryISP
from rawaug.isp.staged import THUMBNAIL, Encoder, thumbnail
from rawaug.isp.stages import as_float
from rawaug.kernels import runtime
from rawaug.kernels.reference import look_up


class Chooser(nn.Module):
    """What :meth:`rawaug.isp.model.DictionaryISP.choose` does, for an ISP as it is now.

    Args:
        isp: the fitted ISP; its encoders look at the picture if they do so now.
    """

    tone_weights: Tensor

    def __init__(self, isp: DictionaryISP) -> None:
        super().__init__()
        self.knee = isp.config.knee
        self.colour, self.gain = deepcopy(isp.colour), deepcopy(isp.gain)
        self.register_buffer("tone_weights", isp.typical_tones().clone())
        encoders = isp.reverse_encoders
        with torch.no_grad():
            self.colour_encoder = _folded(encoders.colour, [isp.colour.atoms()])
            floor = 1.0 / isp.gain.channel_gains()
            self.gain_encoder = _folded(
                encoders.gain, [torch.diag_embed(floor), torch.diag_embed((1.0 - floor).clamp_min(0.0))]
            )

    @torch.no_grad()
    def forward(self, srgb: Tensor, table: Tensor) -> ISPParams:
        """The setting for sRGB ``(B, 3, H, W)``, uint8 or float in [0, 1]; ``table`` gives x2 of sRGB."""
        images = srgb[:, None]
        if self.colour_encoder.looks:
            x2 = small(srgb, table)
            images = x2[:, None]
        colour_weights = self.colour_encoder(images)
        matrix = self.colour.combine(colour_weights)
        if self.gain_encoder.looks:
            x3 = torch.einsum("bij,bjhw->bihw", matrix, x2)
            m = ((x3.mean(dim=1, keepdim=True) - self.knee) / (1.0 - self.knee)).clamp(0.0, 1.0).square()
            images = torch.stack([x3, m * x3], dim=1)
        gain_weights = self.gain_encoder(images)
        tone_weights = self.tone_weights.expand(len(srgb), -1)
        return ISPParams(colour_weights, gain_weights, matrix, self.gain.combine(gain_weights), tone_weights)


def small(srgb: Tensor, table: Tensor) -> Tensor:
    """x2 of the thumbnail that the encoders look at, ``(B, 3, h, w)``."""
    if srgb.dtype != torch.uint8 or srgb.device.type != "cpu" or not runtime.has_numba():
        return look_up(table, thumbnail(as_float(srgb)))[:, :3]
    from rawaug.kernels.cpu import thumbnails

    height, width = srgb.shape[-2:]
    scale = THUMBNAIL / max(height, width, THUMBNAIL)
    return thumbnails(srgb, table, max(1, round(height * scale)), max(1, round(width * scale)))


def _folded(encoder: Encoder, maps: list[Tensor]) -> Encoder:
    """The encoder for K maps of 3 channels, of which its N images are sums: ``maps`` are K times ``(N, 3, 3)``."""
    encoder = deepcopy(encoder)
    if encoder.layers is None:
        return encoder
    first = encoder.layers[0]
    assert isinstance(first, nn.Conv2d) and first.bias is not None
    weight = first.weight.unflatten(1, (-1, 3))
    folded = nn.Conv2d(3 * len(maps), first.out_channels, 3, stride=2, padding=1, dtype=weight.dtype)
    folded.weight.copy_(torch.cat([torch.einsum("onixy,nij->ojxy", weight, atoms) for atoms in maps], dim=1))
    folded.bias = first.bias
    encoder.layers[0] = folded
    return encoder
