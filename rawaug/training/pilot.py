r"""A first estimate of a noisy frame's clean signal: how strong is the noise at each pixel?

    x0 = NonLocalMeans(y)        var(n) = shot_var x + read_var ~ shot_var x0 + read_var

Estimators put noise ``m`` of the noise's own variance on top of a frame. Taken at the noisy signal ``y`` itself, that
variance is right on average, but it is large where the noise happens to be positive: ``m`` then depends on the noise,
which their derivation excludes. At ``shot_var`` 0.008, ``read_var`` 3e-4, a signal of 0.02 and alpha 0.5, the mean of
r2r's target departs from the clean signal by 0.34 standard deviations of the noise (root mean square over six classes
of the input), though input and target are uncorrelated; taken at the clean signal, by none. On frames of the demo
camera with these levels, the part of r2r's target that the noise of its input explains is 0.28 (edges) to 0.32 (flat
areas) standard deviations with ``y``, 0.11 and 0.06 with x0.
"""

from __future__ import annotations

import torch
from torch import Tensor

from denoisers.non_local_means import NonLocalMeans
from denoisers.stabilised import Stabilised
from rawaug import bayer
from rawaug.bayer import CFA
from rawaug.noise import anscombe


def first_estimate(noisy: Tensor, shot_var: float, read_var: float, cfa: CFA) -> Tensor:
    """Of a mosaic ``(1, H, W)``, its shape; without shot noise the frame itself, whose variance needs no signal.

    Raises:
        ImportError: if scikit-image is not installed.
    """
    if not shot_var > 0:
        return noisy
    levels = {"shot_var": torch.tensor([shot_var]), "read_var": torch.tensor([read_var])}
    denoised = Stabilised(NonLocalMeans(), anscombe)(bayer.pack(noisy[None], cfa), **levels)
    return bayer.unpack(denoised, cfa)[0]
