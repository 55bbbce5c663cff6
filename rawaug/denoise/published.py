"""Networks of others with the weights that their authors published: PMRID, and bias-free DnCNN."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import torch
from torch import Tensor, nn
from torch.nn import functional as F

import denoisers
from denoisers.domains import levels_of
from rawaug.files import read_tensors
from rawaug.noise import anscombe

AGAIN = "download or convert it again"


def published_pmrid(path: str | Path) -> denoisers.PMRID:
    """PMRID with the weights of its authors, from a ``.safetensors`` file."""
    model = denoisers.PMRID()
    try:
        model.load_state_dict(read_tensors(path, AGAIN)[1])
    except RuntimeError as error:
        raise ValueError(f"{path} does not fit PMRID's network: {str(error).splitlines()[-1].strip()}") from None
    return model.eval()


class BiasFreeDnCNN(nn.Module):
    r"""Bias-free DnCNN for white noise, on each plane of RAW in Anscombe's domain.

    .. math:: u = (z - z(0)) / (z(1) - z(0)), \qquad u' = u - f(u), \qquad y' = z^{-1}(u' (z(1) - z(0)) + z(0))

    with twenty 3 x 3 convolutions f without biases, normalisations folded in, and the exact unbiased inverse. Source:
    S. Mohan, Z. Kadkhodaie, E. P. Simoncelli, C. Fernandez-Granda, "Robust and interpretable blind image denoising via
    bias-free convolutional neural networks", ICLR 2020.

    Args:
        weights: of the convolutions, by names that are in order.
    """

    def __init__(self, weights: Mapping[str, Tensor]) -> None:
        super().__init__()
        self.layers = nn.ParameterList([weights[name] for name in sorted(weights)])

    def forward(self, noisy: Tensor, variance: Tensor) -> Tensor:
        """Packed RAW ``(B, 4, h, w)`` denoised; ``variance`` is a map ``shot_var max(noisy, 0) + read_var``."""
        shot, read = (level.flatten() for level in levels_of(noisy, variance))
        black, white = (anscombe.forward(noisy.new_full((1, 1, 1, 1), y), shot, read) for y in (0.0, 1.0))
        u = (anscombe.forward(noisy, shot, read) - black) / (white - black)
        planes = self._grey(u.flatten(0, 1)[:, None]).reshape(noisy.shape)
        return anscombe.inverse(planes * (white - black) + black, shot, read)

    @torch.no_grad()
    def _grey(self, u: Tensor) -> Tensor:
        *layers, last = self.layers
        features = u
        for layer in layers:
            features = F.conv2d(features, layer, padding=1).relu_()
        return u - F.conv2d(features, last, padding=1)
