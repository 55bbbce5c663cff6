r"""A cascade of two DRUNets: the second corrects the result of the first, and sees what the first removed.

.. math:: a = f(y), \qquad d = T_k^{-1}(T_k a + g(T_k a,\ T y - T a))

T is the Anscombe transform for the levels of the noise, and T_k is the one for levels that are k times as high. f
leaves a little noise, which is a few pixels wide and looks like texture to a network that meets it together with all
the noise of y. g meets it alone and is told that the noise has k times its variance. Without any training, with g = f,
two steps are better than one in strong noise; they are worse at base ISO, where texture is removed along with the
noise. A trained g decides by what was removed.

Defects that fill a cell of 2 x 2 are among the training frames, and so g takes a small light in the middle of a cell
for one: left alone, it removes nine tenths of its flux. Noise does not depart by many deviations, and so d stays within
:data:`FARTHEST` deviations of the noise of the range between y and a. Lights stay, and defective cells do, too.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import ClassVar, Unpack

import torch
from torch import Tensor

from denoisers.domains import DOMAINS, Levels, fit_levels
from denoisers.drunet import DRUNet, ResidualUNet, Size
from denoisers.ensemble import VIEWS, SelfEnsemble
from denoisers.layers import conv, pad_to_multiple
from denoisers.network import DENOISERS, NEAR, Denoiser, Shared
from rawaug import bayer

REMAINING = 0.05
"""The second network is told to remove this share of the noise's variance: it is k above."""

FARTHEST = 3.0
"""The second network takes the result at most this far from the range between the noisy picture and the result of the
first one, in deviations of the noise."""

SCALES = 4


@DENOISERS.register("CascadeDRUNet")
class CascadeDRUNet(Denoiser):
    """A DRUNet of the settings of ``rawaug-base``, and a second one that corrects its result.

    Args:
        width: features of the first scale of both networks.
        blocks: residual blocks of each scale of the second network, one number or one for each scale, the finest first;
            the first network has one.
        views: turned views, 1, 4 or 8, over which the result is averaged outside of training.
        frozen: keep the weights of the first network in training.
        channels, variance_map, deviation, domain, seed: see :class:`denoisers.Denoiser`.

    A training starts from a DRUNet, whose weights both networks take, or from a cascade. If that cascade has more
    blocks, the first ones of each scale are taken.

    Example:
        >>> noisy = torch.rand(1, 4, 33, 50)
        >>> CascadeDRUNet(width=4)(noisy, torch.full_like(noisy, 1e-4)).shape
        torch.Size([1, 4, 33, 50])
    """

    defaults: ClassVar[Shared] = {**Denoiser.defaults, "variance_map": False, "domain": "anscombe"}
    layerless: ClassVar[frozenset[str]] = frozenset({"views", "frozen", "blocks"})
    mixed: ClassVar[bool] = True
    tile: ClassVar[int] = 1152
    """Tiles of large frames have this side in packed pixels; a cascade keeps more of a tile in memory than others."""

    def __init__(
        self,
        width: int = 32,
        blocks: int | Sequence[int] = 1,
        views: int = 1,
        frozen: bool = True,
        **shared: Unpack[Shared],
    ) -> None:
        if views not in (1, *VIEWS):
            raise ValueError(f"views must be 1, 4 or 8, got {views}")
        if not isinstance(blocks, int):
            blocks = tuple(blocks)
        super().__init__({"width": width, "blocks": blocks, "views": views, "frozen": frozen}, **shared)
        if self.domain == "linear" or self.variance_map:
            raise ValueError("a cascade needs the domain ksigma or anscombe, and no noise map")
        self.views = views
        self.frozen = frozen

        settings: Shared = {"variance_map": False, "domain": self.domain, "seed": self.seed}
        self.first = DRUNet(width, SCALES, 1, limits=True, mend=True, pyramid=2, **settings)
        self.second = _CorrectingUNet(width, blocks, **settings)
        self.stride = self.first.stride
        if frozen:
            self.first.requires_grad_(False)

    def forward(self, noisy: Tensor, variance: Tensor | None = None) -> Tensor:
        """Denoise ``(B, 4, h, w)``; the result has the same shape and is not clipped.

        ``variance``, the noise variance of each value, has the shape of ``noisy``. Errors are those of
        :class:`denoisers.Denoiser`.
        """
        self._require_input(noisy, variance)
        if self.training or self.views == 1:
            return self._denoise(noisy, variance)

        ensemble = SelfEnsemble(self._denoise, bayer.CFA.RGGB, self.views)
        denoised: Tensor = ensemble(noisy, variance)
        return denoised

    def residual(self, features: Tensor) -> Tensor:
        """Compute the correction of the second network; see its own method."""
        return self.second.residual(features)

    def can_start_from(self, model: Denoiser) -> bool:
        """Tell whether :meth:`start_from` can take a network's weights."""
        if isinstance(model, DRUNet):
            return self.first.can_start_from(model)
        return super().can_start_from(model)

    def start_from(self, model: Denoiser) -> None:
        """Take the weights of a cascade, or those of a DRUNet for both networks."""
        if isinstance(model, DRUNet):
            self.first.start_from(model)
            self.second.load_state_dict(model.state_dict(), strict=False)
        else:
            super().start_from(model)

    @property
    def core(self) -> Denoiser:
        """The first network, from which networks of other kinds start."""
        return self.first

    def _denoise(self, noisy: Tensor, variance: Tensor | None) -> Tensor:
        """Run the first network and correct its result."""
        learns = torch.is_grad_enabled() and not self.frozen
        with torch.set_grad_enabled(learns):
            first = self.first(noisy, variance)
        assert variance is not None  # or the first network would have refused it

        levels = fit_levels(noisy.float(), variance.float())
        denoised = self._correct(first, noisy, levels)
        return torch.where(variance > 0, denoised, noisy)

    def _correct(self, first: Tensor, noisy: Tensor, levels: Levels) -> Tensor:
        """Correct the result of the first network, ``(B, 4, h, w)``, whose noise had these levels."""
        domain = DOMAINS[self.domain]
        shot_var, read_var = levels
        low_levels = (REMAINING * shot_var, REMAINING * read_var)

        removed = domain.forward(noisy.float(), *levels) - domain.forward(first.float(), *levels)
        signal = domain.forward(first.float(), *low_levels)
        distances = self.second.distances(signal, low_levels)
        features = torch.cat([signal, *distances, removed.clamp(-NEAR, NEAR)], dim=1)

        height, width = noisy.shape[-2:]
        padded = pad_to_multiple(features.to(self._dtype), self.second.multiple)
        corrected = signal + self.residual(padded)[..., :height, :width]

        # Whatever departs further from the noisy picture is no noise.
        noisy_signal = domain.forward(noisy.float(), *low_levels)
        reach = FARTHEST / math.sqrt(REMAINING)
        lowest = torch.minimum(signal, noisy_signal) - reach
        highest = torch.maximum(signal, noisy_signal) + reach
        corrected = torch.maximum(torch.minimum(corrected, highest), lowest)
        return domain.inverse(corrected, *low_levels).to(noisy.dtype)


class _CorrectingUNet(ResidualUNet):
    """The second network, whose first layer also gets what was removed."""

    def __init__(self, width: int, blocks: int | Sequence[int], **shared: Unpack[Shared]) -> None:
        super().__init__({}, Size(width, SCALES, blocks), limits=True, **shared)
        self.add_layers(self.inputs, self.channels, self.channels)
        self.removed = conv(self.channels, width, bias=False)
        self.initialise(self.seed, self.tail, self.removed, *self.block_ends(), gain=1.0)

    def residual(self, features: Tensor) -> Tensor:
        """Compute a correction ``(B, 4, h, w)`` from a picture, its limits and what was removed, ``(B, 16, h, w)``."""
        picture = features[:, : -self.channels]
        removed = features[:, -self.channels :]

        fine, coarse = self.first_layers(picture)
        correction: Tensor = self.tail(self.trunk(fine + self.removed(removed), coarse))
        return correction
