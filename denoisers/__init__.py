"""RAW denoisers: networks, classical methods, self-ensemble, tiles, files of weights.

Every one is called as ``model(noisy, variance=None) -> denoised``, all ``(B, 4, h, w)`` packed RAW (R, Gr, Gb, B).
The names load their modules on first use (PEP 562).
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from denoisers.classical import BM3D, NonLocalMeans, Stabilised, TotalVariation, Wavelet
    from denoisers.cycleisp import CycleISPDenoiser
    from denoisers.files import DENOISERS, build, from_pretrained, load, save
    from denoisers.inference import SelfEnsemble, tiled
    from denoisers.network import Denoiser
    from denoisers.networks import DHDN, DnCNN, DRUNet, NAFNet, UNet
    from denoisers.pmrid import PMRID

_MODULES = {
    "BM3D": "denoisers.classical",
    "DENOISERS": "denoisers.files",
    "CycleISPDenoiser": "denoisers.cycleisp",
    "DHDN": "denoisers.networks",
    "DRUNet": "denoisers.networks",
    "Denoiser": "denoisers.network",
    "DnCNN": "denoisers.networks",
    "NAFNet": "denoisers.networks",
    "NonLocalMeans": "denoisers.classical",
    "PMRID": "denoisers.pmrid",
    "SelfEnsemble": "denoisers.inference",
    "Stabilised": "denoisers.classical",
    "TotalVariation": "denoisers.classical",
    "UNet": "denoisers.networks",
    "Wavelet": "denoisers.classical",
    "build": "denoisers.files",
    "from_pretrained": "denoisers.files",
    "load": "denoisers.files",
    "save": "denoisers.files",
    "tiled": "denoisers.inference",
}
"""Public name to the module that defines it."""

__all__ = [
    "BM3D",
    "DENOISERS",
    "DHDN",
    "PMRID",
    "CycleISPDenoiser",
    "DRUNet",
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
