"""RAW denoisers: networks, classical methods, self-ensemble, tiles, files of weights.

Every one is called as ``model(noisy, variance=None) -> denoised``, all ``(B, 4, h, w)`` packed RAW (R, Gr, Gb, B).
The names load their modules on first use (PEP 562).
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from denoisers.block_matching import BM3D
    from denoisers.catalogue import DENOISERS, build
    from denoisers.cycleisp_denoiser import CycleISPDenoiser
    from denoisers.dhdn import DHDN
    from denoisers.dncnn import DnCNN
    from denoisers.ensemble import SelfEnsemble
    from denoisers.nafnet import NAFNet
    from denoisers.network import Denoiser
    from denoisers.non_local_means import NonLocalMeans
    from denoisers.pmrid import PMRID
    from denoisers.pretrained import from_pretrained
    from denoisers.stabilised import Stabilised
    from denoisers.tiling import tiled
    from denoisers.total_variation import TotalVariation
    from denoisers.unet import UNet
    from denoisers.wavelet import Wavelet
    from denoisers.weight_files import load, save

_MODULES = {
    "BM3D": "denoisers.block_matching",
    "DENOISERS": "denoisers.catalogue",
    "CycleISPDenoiser": "denoisers.cycleisp_denoiser",
    "DHDN": "denoisers.dhdn",
    "Denoiser": "denoisers.network",
    "DnCNN": "denoisers.dncnn",
    "NAFNet": "denoisers.nafnet",
    "NonLocalMeans": "denoisers.non_local_means",
    "PMRID": "denoisers.pmrid",
    "SelfEnsemble": "denoisers.ensemble",
    "Stabilised": "denoisers.stabilised",
    "TotalVariation": "denoisers.total_variation",
    "UNet": "denoisers.unet",
    "Wavelet": "denoisers.wavelet",
    "build": "denoisers.catalogue",
    "from_pretrained": "denoisers.pretrained",
    "load": "denoisers.weight_files",
    "save": "denoisers.weight_files",
    "tiled": "denoisers.tiling",
}
"""Public name to the module that defines it."""

__all__ = [
    "BM3D",
    "DENOISERS",
    "DHDN",
    "PMRID",
    "CycleISPDenoiser",
    "Denoiser",
    "DnCNN",
    "NAFNet",
    "NonLocalMeans",
    "SelfEnsemble",
    "Stabilised",
    "TotalVariation",
    "UNet",
    "Wavelet",
    "build",
    "from_pretrained",
    "load",
    "save",
    "tiled",
]


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = globals()[name] = getattr(import_module(_MODULES[name]), name)
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
