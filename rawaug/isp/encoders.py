"""Encoders choose the weights of a dictionary's atoms for a picture, ``w = softmax(b + E(I))``.

``I`` are the N images that the atoms make of the picture (Conde et al., AAAI 2022, "Parameter Dictionaries"). ``b`` is
a learned constant, which decides alone if there is no network ``E``. In the reverse pass the colour atoms take x2 to
x3, and the gain atoms x3 to x4; in the forward pass it is the other way round, by the inverse of each atom.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from rawaug.isp.config import ISPConfig
from rawaug.isp.dictionary import ColourDictionary, GainDictionary
from rawaug.isp.functional import apply_gains, inverse_gains

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

    def weigh_reverse(
        self, x2: Tensor, colour: ColourDictionary, gain: GainDictionary, knee: float | None
    ) -> tuple[Tensor, Tensor]:
        """Weigh the atoms for linear images x2 ``(B, 3, h, w)``; ``knee`` is that of the inverse gains.

        Returns:
            Weights ``(B, N)`` of the colour atoms and ``(B, M)`` of the gain atoms.
        """
        candidates = torch.einsum("nij,bjhw->bnihw", colour.atoms(), x2)
        colour_weights = self.colour(candidates)
        x3 = torch.einsum("bn,bnihw->bihw", colour_weights, candidates)

        balanced = []
        for gains in gain.channel_gains():
            balanced.append(inverse_gains(x3, gains.expand(len(x3), 3), knee))
        return colour_weights, self.gain(torch.stack(balanced, dim=1))

    def weigh_forward(self, x4: Tensor, colour: ColourDictionary, gain: GainDictionary) -> tuple[Tensor, Tensor]:
        """Weigh the atoms for linear images x4 ``(B, 3, h, w)``, as :meth:`weigh_reverse` does for x2."""
        gain_weights = self.gain(x4[:, None] * gain.channel_gains()[None, :, :, None, None])

        x3 = apply_gains(x4, gain.combine(gain_weights))
        candidates = torch.einsum("nij,bjhw->bnihw", torch.linalg.pinv(colour.atoms()), x3)
        return self.colour(candidates), gain_weights


def thumbnail(image: Tensor) -> Tensor:
    """Average a picture ``(B, 3, H, W)`` down to at most :data:`THUMBNAIL` pixels a side."""
    height, width = image.shape[-2:]
    scale = THUMBNAIL / max(height, width, THUMBNAIL)
    size = max(1, round(height * scale)), max(1, round(width * scale))
    return F.adaptive_avg_pool2d(image, size)
