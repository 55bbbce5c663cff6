"""The learned parts of the stages: tone network, Gaussian mask and attention mask.

Each starts as the identity, or nearly so, and works on each pixel separately.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

WIDTH = 32
"""Number of features of the networks."""
_LEAST_FACTOR = 0.02
"""Initial value of the diagonal entries of L in a Gaussian mask."""


def _pixelwise(hidden: int, outputs: int, inputs: int = 3) -> nn.Sequential:
    """Stack ``hidden`` 1 x 1 convolutions to 32 features with ReLU, and one that is zero until it is trained."""
    last = nn.Conv2d(WIDTH, outputs, 1)
    nn.init.zeros_(last.weight)
    last.bias = nn.Parameter(torch.zeros(outputs))

    layers: list[nn.Module] = []
    channels = inputs
    for _ in range(hidden):
        layers += [nn.Conv2d(channels, WIDTH, 1), nn.ReLU()]
        channels = WIDTH
    return nn.Sequential(*layers, last)


class ToneNetwork(nn.Module):
    """The tone curve f1 as a residual 3-32-32-32-3 network of 1 x 1 convolutions with ReLU; the identity at first."""

    def __init__(self) -> None:
        super().__init__()
        self.layers = _pixelwise(hidden=3, outputs=3)

    def forward(self, x: Tensor) -> Tensor:
        """Map colours ``(B, 3, H, W)`` to colours of the same shape, each pixel separately."""
        return x + self.layers(x)

    @torch.no_grad()
    def start_from(self, toe: float) -> None:
        """Start as ``x1 = x + toe (1 - x)``; with the gamma stage this is the curve of sRGB and of BT.709."""
        # Three hidden features pass x on (ReLU keeps it, as it is not negative), and the last layer adds the rest.
        *hidden, last = (layer for layer in self.layers if isinstance(layer, nn.Conv2d))
        through = torch.eye(3)[..., None, None]

        for layer in hidden:
            layer.weight[:3] = 0.0
            layer.weight[:3, :3] = through
            layer.get_parameter("bias")[:3] = 0.0

        last.weight.zero_()
        last.weight[:, :3] = -toe * through
        last.get_parameter("bias").fill_(toe)


class GaussianMask(nn.Module):
    """The sensor's fall-off ``G(p) = exp(-||L^T (p - mu)||^2 / 2)``, precision ``Sigma^-1 = L L^T``.

    ``p`` are the coordinates of :func:`frame_coordinates`. A flat mask, L = 0, is a saddle, which gradient descent
    never leaves. So the mask starts with :data:`_LEAST_FACTOR`, which takes 0.02 % of the light from the corners.
    """

    def __init__(self) -> None:
        super().__init__()
        self.mean = nn.Parameter(torch.zeros(2))
        self.factor = nn.Parameter(torch.tensor([_LEAST_FACTOR, 0.0, _LEAST_FACTOR]))  # L11, L21, L22

    @property
    def precision(self) -> Tensor:
        """Sigma^-1, ``(2, 2)``, positive semi-definite by construction."""
        factor = torch.zeros(2, 2, device=self.factor.device, dtype=self.factor.dtype)
        rows, columns = torch.tensor([0, 1, 1]), torch.tensor([0, 0, 1])
        factor = factor.index_put((rows, columns), self.factor)
        return factor @ factor.T

    def forward(self, coordinates: Tensor) -> Tensor:
        """Compute the mask ``(B, 1, H, W)``, in (0, 1], at coordinates ``(B, 2, H, W)``."""
        p = coordinates - self.mean[None, :, None, None]
        square = torch.einsum("bihw,ij,bjhw->bhw", p, self.precision, p)
        return torch.exp(-0.5 * square)[:, None]

    @torch.no_grad()
    def set(self, mean: Tensor, precision: Tensor) -> None:
        """Set the mean ``(2,)`` and the precision ``(2, 2)``; curvature below that of the start is raised to it."""
        values, vectors = torch.linalg.eigh(precision)
        root = vectors @ torch.diag(values.clamp_min(_LEAST_FACTOR**2).sqrt())
        lower = torch.linalg.qr(root.T).R.T

        self.mean.copy_(mean)
        self.factor.copy_(torch.stack([lower[0, 0], lower[1, 0], lower[1, 1]]))


class AttentionMask(nn.Module):
    """A gain for each pixel by its colour and by its place, ``A = 2 sigmoid(a(x)) 2 sigmoid(b(p))``, in (0, 4).

    Both networks are zero at first, so that the mask starts as the identity; the paper's sigmoid lacks the factor of 2
    for this. Colour and place are separate factors, so that the baked pass can look up the first one in a table.
    """

    def __init__(self) -> None:
        super().__init__()
        self.layers = _pixelwise(hidden=2, outputs=1)
        self.place_layers = _pixelwise(hidden=2, outputs=1, inputs=2)

    def of_colour(self, x: Tensor) -> Tensor:
        """Compute the colour-dependent gains ``(B, 1, H, W)`` of an image ``(B, 3, H, W)``."""
        return 2.0 * torch.sigmoid(self.layers(x))

    def of_place(self, coordinates: Tensor) -> Tensor:
        """Compute the place-dependent gains ``(B, 1, H, W)`` at coordinates ``(B, 2, H, W)`` in the full frame."""
        return 2.0 * torch.sigmoid(self.place_layers(coordinates))

    def forward(self, x: Tensor, coordinates: Tensor) -> Tensor:
        """Compute the mask ``(B, 1, H, W)`` of an image ``(B, 3, H, W)`` at coordinates ``(1 or B, 2, H, W)``."""
        return self.of_colour(x) * self.of_place(coordinates)
