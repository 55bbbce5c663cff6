r"""CycleISP's denoiser: ``denoised = noisy + T([noisy, variance])``, T four groups of eight dual-attention blocks.

Domain: packed RAW and the noise variance, 64 features, attention reduced by 16; 2.84 M parameters. It keeps the
resolution throughout. Source: Zamir et al., "CycleISP: Real Image Restoration via Improved Data Synthesis", CVPR 2020.
"""

from __future__ import annotations

import os
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from denoisers.dual_attention import DualAttentionBlock, Trunk, conv, load_published
from denoisers.network import PACKED, Denoiser, require_width
from rawaug.registry import DENOISERS


@DENOISERS.register("CycleISPDenoiser")
class CycleISPDenoiser(Denoiser):
    """Zamir's denoiser for RAW; see the module's head. Any h, w >= 2.

    Args:
        width: features, a multiple of ``reduction``; 64 as published.
        groups, blocks: 4 groups of 8 blocks as published.
        reduction: of the features in channel attention.
        channels: 4 for packed RAW.
        variance_map: take the noise map as ``channels`` more inputs, as published.
        deviation: the map is sqrt(variance); False, as published: the variance.
        domain: linear (as published), ksigma or anscombe; see :mod:`denoisers.domains`.
        seed: of the initial weights.

    Example:
        >>> noisy = torch.rand(1, 4, 20, 30)
        >>> CycleISPDenoiser(width=16, groups=1, blocks=1)(noisy, torch.full_like(noisy, 1e-3)).shape
        torch.Size([1, 4, 20, 30])
    """

    tiny: ClassVar[dict[str, Any]] = {"width": 8, "groups": 1, "blocks": 1, "reduction": 4}

    def __init__(
        self,
        width: int = 64,
        groups: int = 4,
        blocks: int = 8,
        reduction: int = 16,
        channels: int = PACKED,
        variance_map: bool = True,
        deviation: bool = False,
        domain: str = "linear",
        seed: int = 0,
    ) -> None:
        require_width(width, multiple=max(reduction, 1))
        if min(groups, blocks, reduction) < 1:
            raise ValueError(f"groups, blocks and reduction must be at least 1, got {groups}, {blocks}, {reduction}")
        config = {"width": width, "groups": groups, "blocks": blocks, "reduction": reduction}
        super().__init__(channels, variance_map, deviation, 1, config, domain)
        with torch.random.fork_rng(devices=[]):  # every weight is drawn anew below, from the seed
            self.trunk = Trunk(self.inputs, width, groups, blocks, reduction)
            last = conv(width, channels)
        self.trunk.tail = nn.Sequential(last)
        # As in DHDN: thirty-two residual blocks one after another stay tame when each starts as the identity.
        ends = [module.merge for module in self.modules() if isinstance(module, DualAttentionBlock)]
        self.initialise(seed, last, *ends)

    def residual(self, features: Tensor) -> Tensor:
        """``(B, inputs, h, w)`` to the correction ``(B, channels, h, w)``."""
        trunk = self.trunk
        correction: Tensor = trunk.tail(trunk.body(trunk.head(features)))  # type: ignore[operator]
        return correction

    @classmethod
    def from_published(cls, path: str | os.PathLike[str]) -> CycleISPDenoiser:
        """The network with the weights of a published checkpoint (``sidd_denoising_raw.pth``), in eval mode.

        Nothing in the file is run as code. The weights are for RAW in RGGB, clipped to [0, 1].

        Raises:
            FileNotFoundError: if there is no such file.
            ValueError: if it is not such a checkpoint.
        """
        model = cls()
        load_published(model.trunk, path, "the denoiser")
        return model.eval()
