r"""Distillation: a denoiser learns what a stronger one makes of the same noisy RAW.

.. math:: \theta \leftarrow \arg\min_\theta \; \mathbb{E}\, \ell(f_\theta(y),\ (1 - a)\, x + a\, g(y))

A clean picture x differs from E[x | y], the best that any denoiser can give, by everything that the noise has hidden. A
trained teacher g is near that mean, so its results show with far less scatter what f is to learn, and fewer samples are
enough.

Source: Hinton, Vinyals and Dean, "Distilling the Knowledge in a Neural Network", 2015.
"""

from __future__ import annotations

from functools import cached_property
from typing import Any

import torch
from torch import Tensor

import denoisers
from denoisers.files import find_denoiser
from denoisers.network import Denoiser
from rawaug.denoising.convolutions import has_fast_bfloat16
from rawaug.files import sha256
from rawaug.registry import require_between
from rawaug.training.estimators import ESTIMATORS, Supervised
from rawaug.training.losses import Criterion


@ESTIMATORS.register("distilled")
class Distilled(Supervised):
    """Training with the results of another denoiser as targets.

    Args:
        teacher: the name of a shipped denoiser, or a file, with the same kind of input and output as the trained
            network.
        share: share of the teacher in the target, from 0 to 1; the rest is the clean picture.
    """

    def __init__(self, teacher: str = "rawaug-best", share: float = 1.0) -> None:
        require_between("share", share, 0.0, 1.0)
        self.teacher = teacher
        self.share = share

    @property
    def revision(self) -> str:  # type: ignore[override]
        """The hash of the teacher's file: with another teacher, weights are trained anew."""
        return sha256(find_denoiser(self.teacher))

    @cached_property
    def network(self) -> Denoiser:
        """The teacher, read when it is first needed."""
        network, _ = denoisers.load(find_denoiser(self.teacher))
        network.requires_grad_(False)
        return network.eval().to(memory_format=torch.channels_last)  # type: ignore[call-overload]

    def loss(self, model: Any, sample: Any, criterion: Criterion, progress: float = 1.0) -> Tensor:
        """Compute the loss of a batch, a scalar: the distance of the network's result from the teacher's."""
        target = self.teach(sample.noisy, sample.variance)
        target = torch.lerp(sample.clean, target, self.share)
        return criterion(model(sample.noisy, sample.variance), target)

    @torch.no_grad()
    def teach(self, noisy: Tensor, variance: Tensor) -> Tensor:
        """Denoise a batch ``(B, C, h, w)`` with noise of this ``variance`` by the teacher."""
        device = noisy.device
        network = self.network.to(device)
        mixed = network.mixed and has_fast_bfloat16(device)
        with torch.autocast(device.type, torch.bfloat16, enabled=mixed):
            return network(noisy, variance).float()

    def require(self, model: Denoiser) -> None:
        """Raise ValueError if the teacher takes other pictures than the network, or gives others."""
        teacher = self.network
        for key in ("channels", "upscale"):
            if getattr(teacher, key) != getattr(model, key):
                raise ValueError(
                    f"estimator: {self.teacher} has {key} {getattr(teacher, key)}, the network {getattr(model, key)}"
                )
