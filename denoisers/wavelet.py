"""Translation-invariant wavelet shrinkage: thresholded transforms, averaged over shifts (Coifman and Donoho, 1995)."""

from __future__ import annotations

from itertools import product

import numpy as np

from denoisers.classical import Classical, Planes
from rawaug.registry import FILTERS


@FILTERS.register("Wavelet")
class Wavelet(Classical):
    """Translation-invariant Haar shrinkage (scikit-image, PyWavelets): hard threshold at 3 sigma, mean of 16 shifts."""

    needs = ("skimage", "pywt")

    def denoise(self, planes: Planes) -> Planes:
        """See :meth:`Classical.denoise`."""
        denoise_wavelet = self.library("skimage.restoration").denoise_wavelet
        height, width, channels = planes.shape
        # VisuShrink cuts at sigma sqrt(2 log n); the factor is taken out, since on photographs it smooths too much.
        sigma = 3 * self.strength / np.sqrt(2 * np.log(height * width))
        settings = {
            "sigma": [sigma] * channels,
            "wavelet": "haar",
            "method": "VisuShrink",
            "mode": "hard",
            "wavelet_levels": min(4, min(height, width).bit_length() - 1),
            "rescale_sigma": False,
            "channel_axis": -1,
        }
        mean = np.zeros_like(planes)
        for shift in product(range(4), repeat=2):
            shrunk = denoise_wavelet(np.roll(planes, shift, (0, 1)), **settings)
            mean += np.roll(shrunk, np.negative(shift), (0, 1)) / 16
        return mean
