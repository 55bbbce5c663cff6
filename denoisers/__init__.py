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
    from denoisers.files import build, from_pretrained, load, save
    from denoisers.inference import SelfEnsemble, tiled
    from denoisers.joint import JointDRUNet
    from denoisers.mosaic import MosaicDRUNet
    from denoisers.network import Denoiser
    from denoisers.networks import DHDN, DnCNN, DRUNet, NAFNet, UNet
    from denoisers.pmrid import PMRID
    from rawaug.registry import DENOISERS

_MODULES = {
    "denoisers.classical": "BM3D NonLocalMeans Stabilised TotalVariation Wavelet",
    "denoisers.cycleisp": "CycleISPDenoiser",
    "denoisers.files": "build from_pretrained load save",
    "denoisers.inference": "SelfEnsemble tiled",
    "denoisers.joint": "JointDRUNet",
    "denoisers.mosaic": "MosaicDRUNet",
    "denoisers.network": "Denoiser",
    "denoisers.networks": "DHDN DRUNet DnCNN NAFNet UNet",
    "denoisers.pmrid": "PMRID",
    "rawaug.registry": "DENOISERS",
}
"""Modules, and the public names that each defines."""

__all__ = [
    "BM3D", "DENOISERS", "DHDN", "PMRID", "CycleISPDenoiser", "DRUNet", "Denoiser", "DnCNN", "JointDRUNet",
    "MosaicDRUNet", "NAFNet", "NonLocalMeans", "SelfEnsemble", "Stabilised", "TotalVariation", "UNet", "Wavelet",
    "build", "from_pretrained", "load", "save", "tiled",
]  # fmt: skip


def __getattr__(name: str) -> Any:
    for module, names in _MODULES.items():
        if name in names.split():
            value = globals()[name] = getattr(import_module(module), name)
            return value
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
