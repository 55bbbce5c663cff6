"""Encoders: the weights of a dictionary's atoms from the images that the atoms make of one picture.

``w = softmax(b + E(I))``, ``I`` the N images stacked (Conde et al., AAAI 2022, "Parameter Dictionaries"); ``b`` is a
learned constant, which decides alone where there is no encoder ``E``.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from rawaug.isp.config import ISPConfig

THUMBNAIL = 48
"""Longest side of what an encoder looks at."""


class Encoder(nn.Module):
    """Chooses the weights of N atoms from the N images that the atoms make of one picture.

    A learned constant and, where it is to look at the picture, three strided convolutions on a thumbnail, averaged, to
    N logits; softmax.

    Attributes:
        prior: ``(N,)`` the constant, as logits.
        layers: the convolutions, or None.
    """

    def __init__(self, atoms: int) -> None:
        super().__init__()
        self.prior = nn.Parameter(torch.zeros(atoms))
        self.layers: nn.Sequential | None = None

    @property
    def looks(self) -> bool:
        """Whether it looks at the picture."""
        return self.layers is not None

    def add_layers(self, widths: tuple[int, int, int]) -> None:
        """Look at the picture from now on; changes no weight before the layers are trained."""
        atoms = len(self.prior)
        channels = (3 * atoms, *widths)
        layers: list[nn.Module] = []
        for i in range(3):
            layers += [nn.Conv2d(channels[i], channels[i + 1], 3, stride=2, padding=1), nn.ReLU()]
        head = nn.Linear(widths[-1], atoms)
        nn.init.zeros_(head.weight)
        nn.init.zeros_(head.bias)
        self.layers = nn.Sequential(*layers, nn.AdaptiveAvgPool2d(1), nn.Flatten(), head).to(self.prior.device)

    def forward(self, images: Tensor) -> Tensor:
        """Images ``(B, N, 3, h, w)`` to weights ``(B, N)`` on the simplex."""
        logits = self.prior.expand(len(images), -1)
        if self.layers is not None:
            logits = logits + self.layers(images.flatten(1, 2))
        return logits.softmax(dim=1)

    @torch.no_grad()
    def set_prior(self, weights: Tensor) -> None:
        """Make the constant ``weights`` ``(N,)`` (zeros become 1e-6)."""
        self.prior.copy_(weights.clamp_min(1e-6).log())


class Encoders(nn.Module):
    """What chooses the weights of both dictionaries in one direction."""

    def __init__(self, config: ISPConfig) -> None:
        super().__init__()
        self.colour = Encoder(config.colour_atoms)
        self.gain = Encoder(config.gain_atoms)


def thumbnail(image: Tensor) -> Tensor:
    """``(B, 3, H, W)`` averaged down to at most :data:`THUMBNAIL` a side."""
    height, width = image.shape[-2:]
    scale = THUMBNAIL / max(height, width, THUMBNAIL)
    return F.adaptive_avg_pool2d(image, (max(1, round(height * scale)), max(1, round(width * scale))))
