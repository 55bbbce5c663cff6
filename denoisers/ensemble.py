"""Self-ensemble: a denoiser averaged over the views of a mosaic, ``mean of T^-1 f(T y)``."""

from __future__ import annotations

from collections import defaultdict

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from denoisers.layers import PACKED
from denoisers.tiles import Each, Run
from rawaug import bayer

VIEWS = (4, bayer.N_VIEWS)
"""There are these numbers of views: the flips, and the flips with and without a quarter turn."""


def to_view(packed: Tensor, cfa: bayer.CFA, view: int) -> Tensor:
    """Turn packed RAW ``(B, 4, h, w)`` and keep its CFA; a side is one cell longer where the pattern has moved."""
    rows, columns = cfa.turn(view).shift_to(cfa)
    turned = bayer.turn(bayer.unpack(packed, cfa), view)
    return bayer.pack(F.pad(turned, (columns, columns, rows, rows), mode="reflect"), cfa)


def from_view(image: Tensor, cfa: bayer.CFA, view: int) -> Tensor:
    """Undo :func:`to_view` on packed RAW ``(B, 4, h, w)`` or on full colour ``(B, 3, 2h, 2w)``."""
    is_packed = image.shape[1] == PACKED
    if is_packed:
        image = bayer.unpack(image, cfa)

    turned = bayer.crop_to_cfa(image, cfa, cfa.turn(view))
    upright = bayer.turn_back(turned, view)
    if is_packed:
        return bayer.pack(upright, cfa)
    return upright


class SelfEnsemble(nn.Module):
    """A denoiser averaged over views of the mosaic, ``mean of T^-1 f(T y)``: ``views`` times the work.

    T, a flip or quarter turn, turns the *mosaic*. Where this moves the pattern, one line is added on either side, by
    reflection without repeating the edge, so that the network meets its own pattern again. The lines are cropped from
    the result. Sources: Timofte et al., CVPR 2016; for mosaics Liu et al., CVPRW 2019.

    Args:
        model: ``model(noisy, variance) -> denoised``, packed RAW; a network, or any such callable.
        cfa: pattern of the mosaics that it denoises.
        views: 4, the flips, or 8, the flips with and without a quarter turn (the full set).
        each: iterates over the groups of views of one shape; may show progress, as ``tqdm`` does.

    Views of one shape share a batch. ``SelfEnsemble(partial(denoise_tiles, model), cfa)`` is for large pictures.

    Raises:
        ValueError: if ``views`` is neither 4 nor 8, or the CFA is unknown.

    Example:
        >>> noisy = torch.rand(1, 4, 16, 16)
        >>> identity = lambda noisy, variance: noisy
        >>> torch.equal(SelfEnsemble(identity, "RGGB")(noisy), noisy)
        True
    """

    def __init__(self, model: Run, cfa: bayer.CFA | str, views: int = 8, each: Each = iter) -> None:
        super().__init__()
        if views not in VIEWS:
            raise ValueError(f"views must be 4 (flips) or 8 (flips and quarter turns), got {views}")
        self.model = model
        self.cfa = bayer.CFA(cfa)
        self.views = views
        self.each = each
        self.stride: int = getattr(model, "stride", 1)

    def forward(self, noisy: Tensor, variance: Tensor | None = None) -> Tensor:
        """Denoise ``(B, 4, h, w)``, h, w >= 2; ``variance``, if any, is turned in the same way."""
        turned: dict[int, Tensor] = {}
        views_of_shape: dict[torch.Size, list[int]] = defaultdict(list)
        for view in range(self.views):
            turned[view] = to_view(noisy, self.cfa, view)
            views_of_shape[turned[view].shape].append(view)

        mean = noisy.new_zeros(())
        count = 0
        for views in self.each(list(views_of_shape.values())):
            batch = torch.cat([turned.pop(view) for view in views])
            batch_variance = None
            if variance is not None:
                batch_variance = torch.cat([to_view(variance, self.cfa, view) for view in views])

            denoised = self.model(batch, batch_variance).chunk(len(views))
            for view, picture in zip(views, denoised, strict=True):
                count += 1
                # With a running mean, equal views give their value back to the last bit.
                mean = mean + (from_view(picture, self.cfa, view) - mean) / count
        return mean
