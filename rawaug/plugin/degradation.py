"""Camera noise as one of the degradations of KAIR and BSRGAN, which call it ``isp_model``."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from rawaug.plugin.augment import RawAugment
from rawaug.plugin.targets import keep_white


class ISPModel:
    """Camera noise as a degradation of the pictures of KAIR and BSRGAN, which call it ``isp_model``.

    Args:
        augment: an augmentation with the target ``"srgb"``. Each call draws anew, from the augmentation's own seed.

    Raises:
        ValueError: if it has another target.

    Example:
        >>> model = ISPModel(RawAugment.from_pretrained("universal", target="srgb"))
        >>> lq, hq = model.forward(np.full((31, 40, 3), 0.5), np.full((124, 160, 3), 0.5))
        >>> lq.shape, lq.dtype
        ((31, 40, 3), dtype('float32'))
    """

    def __init__(self, augment: RawAugment) -> None:
        if augment.target != "srgb":
            raise ValueError(f"ISPModel needs an augmentation with target 'srgb', got {augment.target!r}")
        self.augment = augment

    def forward(self, img: np.ndarray, hq: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Add a camera's noise to a picture ``(H, W, 3)``, sRGB in [0, 1].

        Returns:
            The noisy picture ``(H, W, 3)``, float32 in [0, 1], and ``hq`` unchanged.
        """
        height, width = img.shape[:2]
        even = np.pad(img, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")
        srgb = torch.from_numpy(np.ascontiguousarray(even, np.float32)).permute(2, 0, 1).clamp(0.0, 1.0)
        srgb = srgb.to(self.augment.device)

        params = self.augment.sample(srgb)
        params = params._replace(isp=keep_white(params.isp))  # or an overexposed picture would be brighter than hq
        noisy: Tensor = self.augment.apply(srgb, params).noisy
        return noisy[:, :height, :width].permute(1, 2, 0).cpu().numpy(), hq

    __call__ = forward
