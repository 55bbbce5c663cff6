r"""What a training is watched by: PSNR on frozen frames, in RAW and developed to sRGB, by how noisy they are.

The frames are sorted by their mean noise variance and split in thirds: *low*, *middle* and *high*.
"""

from __future__ import annotations

from collections.abc import Sequence
from statistics import fmean

import torch
from torch import Tensor, nn
from torch.nn import functional as F

import denoisers
from rawaug.evaluation.trials import Trial
from rawaug.metrics import psnr

PARTS = ("low", "middle", "high")
PANEL = 96
"""Largest side, in packed pixels, of the crops that are shown."""


@torch.no_grad()
def validate(net: nn.Module, frames: Sequence[Trial], device: torch.device) -> dict[str, float]:
    """Mean PSNR in dB, large frames in tiles.

    Returns ``psnr`` over all frames; of three or more ``psnr_low``, ``psnr_middle`` and ``psnr_high`` over the thirds;
    and the same as ``psnr_srgb``, ... where every frame can be developed; ``psnr_CONDITION`` over those of each.
    """
    net.eval()
    raw, srgb = [], []
    for frame in frames:
        variance = None if frame.variance is None else frame.variance.to(device)
        denoised = denoisers.tiled(net, frame.noisy.to(device), variance).cpu()
        raw.append(psnr(denoised, frame.clean).mean().item())
        if frame.develop is not None and frame.domain != "srgb":
            srgb.append(psnr(*(frame.develop(x)[None] for x in (denoised, frame.clean))).item())
    net.train()
    noise = [frame.amount for frame in frames]
    scores = _by_part("psnr", raw, noise)
    for kind in dict.fromkeys(frame.condition for frame in frames if frame.condition):
        of_kind = [score for score, frame in zip(raw, frames, strict=True) if frame.condition == kind]
        scores[f"psnr_{kind}"] = fmean(of_kind)
    return scores | (_by_part("psnr_srgb", srgb, noise) if len(srgb) == len(frames) else {})


@torch.no_grad()
def panels(net: nn.Module, frame: Trial) -> Tensor:
    """The middle of a frame noisy, denoised and clean, beside each other: sRGB ``(3, h, 3 w)`` in [0, 1].

    Where the camera is not known the mean of the greens is shown, through the power 1/2.2; full colour as it is.
    """
    height, width = (min(side, PANEL) for side in frame.noisy.shape[-2:])
    top, left = ((side - size) // 2 for side, size in zip(frame.noisy.shape[-2:], (height, width), strict=True))
    noisy, variance = (
        x if x is None else x[..., top : top + height, left : left + width] for x in (frame.noisy, frame.variance)
    )
    assert noisy is not None
    scale = frame.clean.shape[-1] // frame.noisy.shape[-1]  # 2 where packed RAW becomes full colour
    clean = frame.clean[..., scale * top : scale * (top + height), scale * left : scale * (left + width)]
    device = next((weights.device for weights in net.parameters()), noisy.device)
    net.eval()
    told = None if variance is None else variance.to(device)
    denoised = net(noisy.to(device), told).cpu().nan_to_num()  # black where the training has diverged
    net.train()
    noisy = noisy[:, :1] if clean.shape[1] == 1 else noisy  # without the planes of its colours
    shown = [(frame.develop or _shown)(image) for image in (noisy, denoised, clean)]
    return torch.cat([F.interpolate(image[None], shown[-1].shape[-2:])[0] for image in shown], dim=-1)


def _shown(image: Tensor) -> Tensor:
    if image.shape[1] == 3:
        return image[0].clamp(0.0, 1.0)
    return image[0, image.shape[1] // 4 : 3].mean(0).clamp(0.0, 1.0).pow(1 / 2.2).expand(3, -1, -1)


def _by_part(name: str, scores: Sequence[float], noise: Sequence[float]) -> dict[str, float]:
    result, count = {name: fmean(scores)}, len(scores)
    order = sorted(range(count), key=lambda k: noise[k])
    for part, label in enumerate(PARTS if count >= len(PARTS) else ()):
        third = order[part * count // len(PARTS) : (part + 1) * count // len(PARTS)]
        result[f"{name}_{label}"] = fmean(scores[k] for k in third)
    return result
