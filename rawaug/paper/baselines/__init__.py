r"""The methods that the dictionary ISP is compared with, written from their papers, with one interface.

============ ============================================ ============ ========= =================================
name         source                                       parameters   fitted    RAW to sRGB
============ ============================================ ============ ========= =================================
curve-matrix the inverse of BT.709, and a matrix of pairs 9            at once   none
upi          Brooks et al., CVPR 2019                     0            no        none
upi-tuned    the same, matrix and gains from pairs        12           at once   none
unet         Ronneberger et al., MICCAI 2015              11.77 M      descent   none
cycleisp     Zamir et al., CVPR 2020                      3.14 M       descent   with a reference picture
invisp       Xing et al., CVPR 2021                       1.41 M       descent   exact inverse
invisp-jpeg  the same, with JPEG between its passes       1.41 M       descent   exact inverse
invgrey      Xia et al., TOG 2018, as InvISP compares it  0.74 M       descent   a network of its own
============ ============================================ ============ ========= =================================

Parameters are those of the reverse pass at the default, published size.
"""

from rawaug.paper.baselines.base import BASELINES, BaselineISP, Training, fit_baseline
from rawaug.paper.baselines.curve_matrix import CurveMatrix
from rawaug.paper.baselines.cycleisp import CycleISP
from rawaug.paper.baselines.invertible_grey import InvertibleGrey
from rawaug.paper.baselines.invisp import InvISP, JpegInvISP
from rawaug.paper.baselines.unet import UNetISP
from rawaug.paper.baselines.upi import UPI, TunedUPI

__all__ = [
    "BASELINES", "UPI", "BaselineISP", "CurveMatrix", "CycleISP", "InvISP", "InvertibleGrey", "JpegInvISP", "Training",
    "TunedUPI", "UNetISP", "fit_baseline",
]  # fmt: skip
