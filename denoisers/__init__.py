"""RAW denoisers: networks, classical methods, self-ensemble, tiles, files of weights.

Every one is called as ``model(noisy, variance=None) -> denoised``, all ``(B, 4, h, w)`` packed RAW (R, Gr, Gb, B).
"""

from denoisers.classical import BM3D, NonLocalMeans, Stabilised, TotalVariation, Wavelet
from denoisers.dhdn import DHDN
from denoisers.dncnn import DnCNN
from denoisers.ensemble import SelfEnsemble
from denoisers.network import Denoiser
from denoisers.registry import DENOISERS, build
from denoisers.tiling import tiled
from denoisers.unet import UNet
from denoisers.weights import load, save

__all__ = [
    "BM3D",
    "DENOISERS",
    "DHDN",
    "Denoiser",
    "DnCNN",
    "NonLocalMeans",
    "SelfEnsemble",
    "Stabilised",
    "TotalVariation",
    "UNet",
    "Wavelet",
    "build",
    "load",
    "save",
    "tiled",
]
