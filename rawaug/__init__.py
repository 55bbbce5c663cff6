"""Online RAW data augmentation for denoiser training, by a learned dictionary ISP."""

from rawaug._version import __version__
from rawaug.augment import RawAugment
from rawaug.bayer import CFA
from rawaug.experiment.fitting import fit
from rawaug.isp.model import DictionaryISP
from rawaug.isp.params import ISPConfig, ISPParams
from rawaug.loader import WrappedLoader, wrap
from rawaug.pairs import RawPairs, RawPairStream
from rawaug.params import AugmentParams, RawPair, load_params, save_params

__all__ = [
    "CFA",
    "AugmentParams",
    "DictionaryISP",
    "ISPConfig",
    "ISPParams",
    "RawAugment",
    "RawPair",
    "RawPairStream",
    "RawPairs",
    "WrappedLoader",
    "__version__",
    "fit",
    "load_params",
    "save_params",
    "wrap",
]
