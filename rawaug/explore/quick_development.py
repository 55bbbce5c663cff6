r"""RAW developed for the eye, quickly: the setting of a draw backwards.

.. math:: x = T^{-1}\left(C^{+} \operatorname{diag}(g)\, d(y) / G\right)

with bilinear demosaicing d, gains g, the colour matrix C, the shading mask G and the picture's tone curve T. Of a
learned tone network T is the curve of greys, read from a table: this is for looking at noise, not for scores.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from rawaug.isp.config import ISPParams
from rawaug.isp.model import DictionaryISP
from rawaug.isp.stages import ColorCorrection, LensShading, WhiteBalance, place_in_frame
from rawaug.isp.tone import STEPS

_LEVELS = 2**14


class Development:
    """Develops RAW of one setting.

    Args:
        isp: whose stages are reversed.
        setting: of one picture, without the leading B.
    """

    @torch.no_grad()
    def __init__(self, isp: DictionaryISP, setting: ISPParams) -> None:
        matrix = torch.linalg.pinv(setting.matrix) if isp.find(ColorCorrection) else torch.eye(3)
        gains = setting.gains if isp.find(WhiteBalance) else torch.ones(3)
        self.colour = matrix * gains
        self.shading = isp.find(LensShading)
        curve = grey_curve(isp, setting)
        codes = np.interp(
            np.linspace(0, 1, _LEVELS + 1), np.maximum.accumulate(curve.numpy()), np.linspace(0, 255, 256)
        )
        self.codes = torch.from_numpy(codes.round().astype(np.uint8))

    @torch.no_grad()
    def __call__(self, rgb: Tensor, place: tuple[int, int, int, int] | None = None) -> np.ndarray:
        """Demosaiced RAW ``(3, H, W)`` to sRGB, uint8 ``(H, W, 3)``.

        Args:
            rgb: demosaiced.
            place: top, left, and the full frame's height and width; the whole frame by default.
        """
        height, width = rgb.shape[-2:]
        if self.shading is not None:
            top, left, *frame = place or (0, 0, height, width)
            rgb = rgb / self.shading.mask(place_in_frame(height, width, (top, left), (frame[0], frame[1])))[0]
        linear = (self.colour @ rgb.reshape(3, -1)).mul_(_LEVELS).clamp_(0, _LEVELS)
        picture: np.ndarray = self.codes[linear.int()].T.reshape(height, width, 3).numpy()
        return np.ascontiguousarray(picture)


@torch.no_grad()
def grey_curve(isp: DictionaryISP, setting: ISPParams) -> Tensor:
    """x2 of the 256 greys of sRGB under a setting without the leading B, ``(256,)``."""
    if isp.tone is None:
        return isp.tone_curve().mean(dim=1)
    return isp.tone.combine(setting.tone_weights[None])[0, ::STEPS]
