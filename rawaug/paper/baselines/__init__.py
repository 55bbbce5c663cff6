r"""The methods that the dictionary ISP is compared with, written from their papers, on one interface.

=========== ============================================ ============ =========
name        source                                       parameters   fitted
=========== ============================================ ============ =========
upi         Brooks et al., CVPR 2019                     0            no
upi-tuned   the same, matrix and gains from pairs        12           at once
unet        Ronneberger et al., MICCAI 2015              11.77 M      descent
cycleisp    Zamir et al., CVPR 2020                      3.14 M       descent
=========== ============================================ ============ =========

They make RAW of sRGB and not the other way round. Parameters are those at the published size.
"""

from rawaug.paper.baselines.base import BaselineISP, Training, fit_baseline
from rawaug.paper.baselines.networks import CycleISP, UNetISP
from rawaug.paper.baselines.upi import UPI, TunedUPI
from rawaug.registry import BASELINES

__all__ = ["BASELINES", "UPI", "BaselineISP", "CycleISP", "Training", "TunedUPI", "UNetISP", "fit_baseline"]
