"""Total variation: the ``x`` of least ``|x - y|^2 / 2 + w TV(x)`` (Chambolle, JMIV 2004)."""

from __future__ import annotations

from denoisers.classical import Classical, Planes
from rawaug.registry import FILTERS


@FILTERS.register("TotalVariation")
class TotalVariation(Classical):
    """Total variation (scikit-image, Chambolle's projection), each plane by itself."""

    needs = ("skimage",)

    def denoise(self, planes: Planes) -> Planes:
        """See :meth:`Classical.denoise`."""
        denoise_tv_chambolle = self.library("skimage.restoration").denoise_tv_chambolle
        return denoise_tv_chambolle(planes, weight=0.4 * self.strength, channel_axis=-1)
