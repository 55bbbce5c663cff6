r"""R2R's average: ``mean over k of f(y + alpha m_k)``, with ``m_k`` drawn with the noise's own variance at ``f(y)``.

Domain: packed RAW. A network that was trained on recorrupted frames gets the input it knows, and the average removes
most of what the added noise costs. Source: Pang et al., "Recorrupted-to-Recorrupted", CVPR 2021, section 3.3.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor, nn

from denoisers.domains import levels_of


class Recorrupted(nn.Module):
    """A denoiser averaged over several draws of extra noise: called as the denoiser is, ``draws + 1`` times the work.

    Args:
        model: ``model(noisy, variance) -> denoised``, packed RAW; a network, or any such callable.
        alpha: standard deviation of the extra noise over that of the noise, as in training.
        draws: how many.
        seed: of the extra noise, which is the same in every call.

    Raises:
        ValueError: if ``draws`` is less than 1 or ``alpha`` not positive.
    """

    def __init__(
        self, model: Callable[[Tensor, Tensor | None], Tensor], alpha: float, draws: int, seed: int = 0
    ) -> None:
        super().__init__()
        if draws < 1 or not alpha > 0:
            raise ValueError(f"draws must be at least 1 and alpha positive, got {draws} and {alpha}")
        self.model, self.alpha, self.draws, self.seed = model, alpha, draws, seed
        self.stride: int = getattr(model, "stride", 1)

    def forward(self, noisy: Tensor, variance: Tensor) -> Tensor:
        """Denoise ``(B, 4, h, w)``; ``variance``: ``shot_var max(noisy, 0) + read_var``, of the same shape."""
        shot_var, read_var = levels_of(noisy, variance)
        signal = self.model(noisy, variance)
        deviation = self.alpha * (shot_var * signal.clamp_min(0.0) + read_var).sqrt()
        generator = torch.Generator().manual_seed(self.seed)
        total = torch.zeros_like(noisy)
        for _ in range(self.draws):
            drawn = torch.randn(noisy.shape, generator=generator).to(noisy)
            noisier = (noisy + deviation * drawn).clamp(max=1.0)
            noise_map = (1.0 + self.alpha**2) * (shot_var * noisier.clamp_min(0.0) + read_var)
            total += self.model(noisier, noise_map)
        return total / self.draws
