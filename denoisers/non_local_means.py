"""Non-local means: the mean of pixels weighed by how alike their patches are (Buades et al., CVPR 2005)."""

from __future__ import annotations

from denoisers.classical import Classical, Planes
from rawaug.registry import FILTERS


@FILTERS.register("NonLocalMeans")
class NonLocalMeans(Classical):
    """Non-local means (scikit-image, fast mode): patches of 5 x 5 over all four planes, sought 6 pixels around."""

    needs = ("skimage",)

    def denoise(self, planes: Planes) -> Planes:
        """See :meth:`Classical.denoise`."""
        denoise_nl_means = self.library("skimage.restoration").denoise_nl_means
        settings = {"patch_size": 5, "patch_distance": 6, "fast_mode": True, "channel_axis": -1}
        return denoise_nl_means(planes, h=0.8 * self.strength, sigma=1.0, **settings)
