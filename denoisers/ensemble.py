r"""Self-ensemble on a mosaic: ``mean over views v of T_v^-1 f(T_v y)``, with T_v a flip or quarter turn.

Domain: packed RAW whose mosaic has a known CFA. T_v turns the *mosaic*, so that neighbours stay neighbours. Where this
moves the pattern, one line is added on either side by reflection without repeating the edge (row -1 is row 1, which has
its colour), so that the network meets its own pattern again; the line is cropped from the result. No colour takes
another's place: what went in as R, Gr, Gb, B comes out there, except that a quarter turn exchanges the two greens.
Source: Timofte et al., "Seven ways to improve example-based single image super resolution", CVPR 2016; for mosaics Liu
et al., "Learning Raw Image Denoising with Bayer Pattern Unification and Bayer Preserving Augmentation", CVPRW 2019.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from rawaug import bayer

VIEWS = (4, bayer.N_VIEWS)


def to_view(packed: Tensor, cfa: bayer.CFA, view: int) -> Tensor:
    """``(B, 4, h, w)`` to the turned picture with the same CFA: a side is one cell longer where the pattern moved."""
    rows, columns = cfa.turned(view).shift_to(cfa)
    turned = bayer.turn(bayer.unpack(packed, cfa), view)
    return bayer.pack(F.pad(turned, (columns, columns, rows, rows), mode="reflect"), cfa)


def from_view(packed: Tensor, cfa: bayer.CFA, view: int) -> Tensor:
    """The inverse of :func:`to_view`."""
    rows, columns = cfa.turned(view).shift_to(cfa)
    turned = bayer.unpack(packed, cfa)
    height, width = turned.shape[-2:]
    return bayer.pack(bayer.turn_back(turned[..., rows : height - rows, columns : width - columns], view), cfa)


class SelfEnsemble(nn.Module):
    """A denoiser averaged over its views of the mosaic: called as the denoiser is, ``views`` times the work.

    Args:
        model: ``model(noisy, variance) -> denoised``, packed RAW; a network, or any such callable.
        cfa: pattern of the mosaics that it will be given.
        views: 4, the flips, or 8, the flips with and without a quarter turn (the full set).
        each: goes through the groups of views of one shape, and may show how far it is, as ``tqdm`` does.

    Views of one shape share a batch. Large pictures: ``SelfEnsemble(partial(tiled, model), cfa)`` tiles every view.

    Raises:
        ValueError: if ``views`` is neither 4 nor 8, or the CFA is unknown.

    Example:
        >>> noisy = torch.rand(1, 4, 16, 16)
        >>> identity = lambda noisy, variance: noisy
        >>> torch.equal(SelfEnsemble(identity, "RGGB")(noisy), noisy)
        True
    """

    def __init__(
        self,
        model: Callable[[Tensor, Tensor | None], Tensor],
        cfa: bayer.CFA | str,
        views: int = 8,
        each: Callable[[Sequence[Any]], Iterable[Any]] = iter,
    ) -> None:
        super().__init__()
        if views not in VIEWS:
            raise ValueError(f"views must be 4 (flips) or 8 (flips and quarter turns), got {views}")
        self.model = model
        self.cfa = bayer.CFA(cfa)
        self.views = views
        self.each = each
        self.stride: int = getattr(model, "stride", 1)

    def forward(self, noisy: Tensor, variance: Tensor | None = None) -> Tensor:
        """Denoise ``(B, 4, h, w)``, h, w >= 2; ``variance``, if any, is turned alike."""
        alike: dict[torch.Size, list[int]] = defaultdict(list)
        turned = {view: to_view(noisy, self.cfa, view) for view in range(self.views)}
        for view, picture in turned.items():
            alike[picture.shape].append(view)
        mean = torch.zeros_like(noisy)
        count = 0
        for views in self.each(list(alike.values())):
            batch = torch.cat([turned.pop(view) for view in views])
            noise = None if variance is None else torch.cat([to_view(variance, self.cfa, view) for view in views])
            for view, denoised in zip(views, self.model(batch, noise).chunk(len(views)), strict=True):
                count += 1
                # A running mean: equal views give their value back to the last bit.
                mean = mean + (from_view(denoised, self.cfa, view) - mean) / count
        return mean
