"""Encoders: the weights of a dictionary's atoms from the images that the atoms make of one picture.

``w = softmax(b + E(I))``, ``I`` the N images stacked (Conde et al., AAAI 2022, "Parameter Dictionaries"); ``b`` is a
learned constant, which decides alone where the encoder is switched off.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

THUMBNAIL = 48
"""Longest side of what an encoder looks at."""


class Encoder(nn.Module):
    """Chooses the weights of N atoms from the N images that the atoms make of one picture.

    A learned constant plus three strided convolutions on a thumbnail, averaged, to N logits, softmax. With
    ``enabled=False`` the picture is not looked at and the constant decides alone.
    """

    def __init__(self, atoms: int, widths: tuple[int, int, int]) -> None:
        super().__init__()
        self.enabled = False
        self.prior = nn.Parameter(torch.zeros(atoms))
        channels = (3 * atoms, *widths)
        layers: list[nn.Module] = []
        for i in range(3):
            layers += [nn.Conv2d(channels[i], channels[i + 1], 3, stride=2, padding=1), nn.ReLU()]
        head = nn.Linear(widths[-1], atoms)
        nn.init.zeros_(head.weight)
        nn.init.zeros_(head.bias)
        self.layers = nn.Sequential(*layers, nn.AdaptiveAvgPool2d(1), nn.Flatten(), head)

    def forward(self, images: Tensor) -> Tensor:
        """Images ``(B, N, 3, h, w)`` to weights ``(B, N)`` on the simplex."""
        logits = self.prior.expand(len(images), -1)
        if self.enabled:
            logits = logits + self.layers(images.flatten(1, 2))
        return logits.softmax(dim=1)

    @torch.no_grad()
    def set_prior(self, weights: Tensor) -> None:
        """Make the constant ``weights`` ``(N,)`` (zeros become 1e-6)."""
        self.prior.copy_(weights.clamp_min(1e-6).log())


def thumbnail(image: Tensor) -> Tensor:
    """``(B, 3, H, W)`` averaged down to at most :data:`THUMBNAIL` a side."""
    height, width = image.shape[-2:]
    scale = THUMBNAIL / max(height, width, THUMBNAIL)
    return F.adaptive_avg_pool2d(image, (max(1, round(height * scale)), max(1, round(width * scale))))
