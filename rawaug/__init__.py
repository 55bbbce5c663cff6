"""Online RAW data augmentation for denoiser training, by a learned dictionary ISP."""

from rawaug._version import __version__
from rawaug.augment import AugmentParams, RawAugment, RawPair, RawPairs, wrap
from rawaug.bayer import CFA
from rawaug.experiment.fitting import fit
from rawaug.isp.model import DictionaryISP
from rawaug.isp.params import ISPConfig, ISPParams

__all__ = [
    "CFA",
    "AugmentParams",
    "DictionaryISP",
    "ISPConfig",
    "ISPParams",
    "RawAugment",
    "RawPair",
    "RawPairs",
    "__version__",
    "fit",
    "wrap",
]
