"""Encoders choose the weights of a dictionary's atoms for a picture, ``w = softmax(b + E(I))``.

``I`` are the N images that the atoms make of the picture (Conde et al., AAAI 2022, "Parameter Dictionaries"). ``b`` is
a learned constant, which decides alone if there is no network ``E``.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from rawaug.isp.config import ISPConfig

THUMBNAIL = 48
"""Longest side of an encoder's input, in pixels."""


class AtomEncoder(nn.Module):
    """A learned constant ``prior`` ``(N,)``, as logits, and convolutions if the encoder looks at the picture."""

    def __init__(self, atoms: int) -> None:
        super().__init__()
        self.prior = nn.Parameter(torch.zeros(atoms))
        self.layers: nn.Sequential | None = None

    def add_layers(self, widths: tuple[int, int, int]) -> None:
        """Let the encoder look at the picture from now on, by three convolutions; untrained, they change no weight.

        ``widths`` are the numbers of their features.
        """
        atoms = len(self.prior)
        layers: list[nn.Module] = []
        channels = 3 * atoms
        for width in widths:
            layers += [nn.Conv2d(channels, width, 3, stride=2, padding=1), nn.ReLU()]
            channels = width

        head = nn.Linear(widths[-1], atoms)
        nn.init.zeros_(head.weight)
        nn.init.zeros_(head.bias)
        self.layers = nn.Sequential(*layers, nn.AdaptiveAvgPool2d(1), nn.Flatten(), head).to(self.prior.device)

    def forward(self, images: Tensor) -> Tensor:
        """Weigh the N images ``(B, N, 3, h, w)`` that the atoms make: ``(B, N)`` on the simplex."""
        logits = self.prior.expand(len(images), -1)
        if self.layers is not None:
            logits = logits + self.layers(images.flatten(1, 2))
        return logits.softmax(dim=1)

    @torch.no_grad()
    def set_prior(self, weights: Tensor) -> None:
        """Set the constant so that it gives ``weights`` ``(N,)``; zeros become 1e-6."""
        self.prior.copy_(weights.clamp_min(1e-6).log())


class Encoders(nn.Module):
    """The encoders of one direction: one for the colour atoms, one for the gain atoms."""

    def __init__(self, config: ISPConfig) -> None:
        super().__init__()
        self.colour = AtomEncoder(config.colour_atoms)
        self.gain = AtomEncoder(config.gain_atoms)


def thumbnail(image: Tensor) -> Tensor:
    """Average a picture ``(B, 3, H, W)`` down to at most :data:`THUMBNAIL` pixels a side."""
    height, width = image.shape[-2:]
    scale = THUMBNAIL / max(height, width, THUMBNAIL)
    size = max(1, round(height * scale)), max(1, round(width * scale))
    return F.adaptive_avg_pool2d(image, size)
