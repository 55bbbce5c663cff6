"""Objects that other libraries' training scripts expect."""

from __future__ import annotations

import numpy as np
import torch

from rawaug.plugin.augment import RawAugment
from rawaug.plugin.targets import keep_white


class ISPModel:
    """Camera noise in the form that KAIR and BSRGAN call, as ``isp_model``; made by :func:`isp_model`."""

    def __init__(self, augment: RawAugment) -> None:
        self.augment = augment

    def forward(self, img: np.ndarray, hq: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The picture ``(H, W, 3)``, sRGB in [0, 1], with a camera's noise, float32; ``hq`` as it is."""
        height, width = img.shape[:2]
        even = np.pad(img, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")
        srgb = torch.from_numpy(np.ascontiguousarray(even, np.float32)).permute(2, 0, 1).clamp(0.0, 1.0)
        srgb = srgb.to(self.augment.device)
        params = self.augment.sample(srgb)
        params = params._replace(isp=keep_white(params.isp))  # or an overexposed picture would be brighter than hq
        noisy: torch.Tensor = self.augment.apply(srgb, params).noisy
        return noisy[:, :height, :width].permute(1, 2, 0).cpu().numpy(), hq

    __call__ = forward


def isp_model(augment: RawAugment) -> ISPModel:
    """The ``isp_model`` of KAIR and BSRGAN: camera noise among the degradations of their low-quality pictures.

    Args:
        augment: with ``target="srgb"``; each call draws anew, from its own seed.

    Raises:
        ValueError: if its target is another.

    Example:
        >>> model = isp_model(RawAugment.from_pretrained("universal", target="srgb"))
        >>> lq, hq = model.forward(np.full((31, 40, 3), 0.5), np.full((124, 160, 3), 0.5))
        >>> lq.shape, lq.dtype
        ((31, 40, 3), dtype('float32'))
    """
    if augment.target != "srgb":
        raise ValueError(f"isp_model needs an augmentation with target 'srgb', got {augment.target!r}")
    return ISPModel(augment)
