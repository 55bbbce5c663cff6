"""Clean targets, ``loss = criterion(model(noisy, variance), clean)``: what every other estimator departs from."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ClassVar

from torch import Tensor

from denoisers.network import Denoiser
from rawaug.registry import ESTIMATORS
from rawaug.training.criteria import Criterion


@ESTIMATORS.register("supervised")
class Supervised:
    """Clean targets: samples come ready, ``loss = criterion(model(noisy, variance), clean)``.

    ``sees_clean`` says whether it needs clean frames: in a recipe such estimators and others do not mix. ``revision``
    counts the changes of what it makes of the same frames: weights of another one are trained anew.
    """

    sees_clean: ClassVar[bool] = True
    revision: ClassVar[int] = 0

    def loss(self, model: Any, sample: Any, criterion: Criterion, progress: float = 1.0) -> Tensor:
        """Of a batch, a scalar; ``progress`` is the share of the training that is over."""
        return criterion(model(sample.noisy, sample.variance), sample.clean)

    def corrected(self, model: Denoiser) -> Denoiser:
        """The denoiser to use in place of the trained one; itself, or a new network."""
        return model

    def at_test(self, run: Callable[..., Tensor]) -> Callable[..., Tensor]:
        """What to call at a test in place of ``run(noisy, variance)``; itself, or something around it."""
        return run
