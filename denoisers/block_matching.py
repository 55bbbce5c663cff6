"""BM3D: alike blocks stacked and shrunk together in a 3-D transform (Dabov et al., TIP 2007)."""

from __future__ import annotations

import numpy as np

from denoisers.classical import Classical, Planes
from rawaug.registry import FILTERS

_HADAMARD = 0.5 * np.array([[1, 1, 1, 1], [1, -1, 1, -1], [1, 1, -1, -1], [1, -1, -1, 1]], np.float32)
"""R, Gr, Gb, B to luminance and three differences; orthonormal (white noise stays white), its own inverse."""


@FILTERS.register("BM3D")
class BM3D(Classical):
    """BM3D (the ``bm3d`` wheel of its authors), blocks matched on the mean of the four planes.

    The wheel is for non-commercial use only and therefore no requirement of this package: ``pip install bm3d``.
    """

    smallest = 16
    needs = ("bm3d",)
    advice = "licensed for non-commercial use only; run: pip install 'rawaug[bm3d]'"

    def denoise(self, planes: Planes) -> Planes:
        """See :meth:`Classical.denoise`.

        Raises:
            ImportError: if the wheel is not installed.
        """
        bm3d = self.library("bm3d")
        # Blocks are matched on the first channel: let that be the luminance, whose noise is lowest.
        return bm3d.bm3d(planes @ _HADAMARD, sigma_psd=[self.strength] * 4) @ _HADAMARD
