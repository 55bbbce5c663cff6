r"""The methods that the dictionary ISP is compared with, written from their papers, on one interface.

=========== ============================================ ============ ========= =================================
name        source                                       parameters   fitted    forward pass
=========== ============================================ ============ ========= =================================
upi         Brooks et al., CVPR 2019                     0            no        exact inverse
upi-tuned   the same, matrix and gains from pairs        12           at once   exact inverse
unet        Ronneberger et al., MICCAI 2015              11.77 M      descent   none
cycleisp    Zamir et al., CVPR 2020                      3.14 M       descent   none
=========== ============================================ ============ ========= =================================

Parameters are those of the reverse pass at the default, published size.
"""

from rawaug.paper.baselines.base import BaselineISP, Training, fit_baseline
from rawaug.paper.baselines.networks import CycleISP, UNetISP
from rawaug.paper.baselines.upi import UPI, TunedUPI
from rawaug.registry import BASELINES

__all__ = ["BASELINES", "UPI", "BaselineISP", "CycleISP", "Training", "TunedUPI", "UNetISP", "fit_baseline"]
