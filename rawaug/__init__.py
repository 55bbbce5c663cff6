"""Online RAW data augmentation for denoiser training, by a learned dictionary ISP.

The public names load their modules on first use (PEP 562), so that importing one part of the package loads no other.
"""

from __future__ import annotations

import gc
from importlib import import_module
from typing import TYPE_CHECKING, Any

from rawaug.version import __version__

if TYPE_CHECKING:
    from rawaug.bayer import CFA as CFA
    from rawaug.camera.own import Camera as Camera
    from rawaug.denoising.defects import find_defects as find_defects
    from rawaug.denoising.denoise import denoise as denoise
    from rawaug.denoising.denoiser import RawDenoiser as RawDenoiser
    from rawaug.evaluation.judge import judge as judge
    from rawaug.isp.config import ISPConfig as ISPConfig
    from rawaug.isp.config import ISPParams as ISPParams
    from rawaug.isp.config import ISPResult as ISPResult
    from rawaug.isp.model import DictionaryISP as DictionaryISP
    from rawaug.plugin.augment import RawAugment as RawAugment
    from rawaug.plugin.clean_raw import RawNoise as RawNoise
    from rawaug.plugin.dataset import RawPairs as RawPairs
    from rawaug.plugin.degradation import ISPModel as ISPModel
    from rawaug.plugin.draw import Draw as Draw
    from rawaug.plugin.finishing import Finish as Finish
    from rawaug.plugin.loader import ResumableLoader as ResumableLoader
    from rawaug.plugin.loader import resumable as resumable
    from rawaug.plugin.params import AugmentParams as AugmentParams
    from rawaug.plugin.params import RawPair as RawPair
    from rawaug.plugin.params import load_params as load_params
    from rawaug.plugin.params import save_params as save_params
    from rawaug.plugin.stream import RawPairStream as RawPairStream
    from rawaug.plugin.targets import Burst as Burst
    from rawaug.plugin.targets import Srgb as Srgb
    from rawaug.plugin.wrapped import WrappedLoader as WrappedLoader
    from rawaug.plugin.wrapped import wrap as wrap
    from rawaug.synthesis.folder import synth as synth
    from rawaug.training.camera_fit import fit as fit

_PUBLIC = {
    "rawaug.bayer": ("CFA",),
    "rawaug.denoising.denoiser": ("RawDenoiser",),
    "rawaug.denoising.defects": ("find_defects",),
    "rawaug.denoising.denoise": ("denoise",),
    "rawaug.evaluation.judge": ("judge",),
    "rawaug.isp.config": ("ISPConfig", "ISPParams", "ISPResult"),
    "rawaug.isp.model": ("DictionaryISP",),
    "rawaug.camera.own": ("Camera",),
    "rawaug.plugin.augment": ("RawAugment",),
    "rawaug.plugin.clean_raw": ("RawNoise",),
    "rawaug.plugin.dataset": ("RawPairs",),
    "rawaug.plugin.stream": ("RawPairStream",),
    "rawaug.plugin.degradation": ("ISPModel",),
    "rawaug.plugin.draw": ("Draw",),
    "rawaug.plugin.finishing": ("Finish",),
    "rawaug.plugin.loader": ("ResumableLoader", "resumable"),
    "rawaug.plugin.params": ("AugmentParams", "RawPair", "load_params", "save_params"),
    "rawaug.plugin.targets": ("Burst", "Srgb"),
    "rawaug.plugin.wrapped": ("WrappedLoader", "wrap"),
    "rawaug.synthesis.folder": ("synth",),
    "rawaug.training.camera_fit": ("fit",),
}
_MODULE_OF = {name: module for module, names in _PUBLIC.items() for name in names}

__all__ = [*_MODULE_OF, "__version__"]


def __getattr__(name: str) -> Any:
    if name not in _MODULE_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module = _import(_MODULE_OF[name])
    value = globals()[name] = getattr(module, name)
    return value


def _import(name: str) -> Any:
    """Import a module while the garbage collector rests: the million objects that PyTorch makes hold no garbage.

    They go straight to the oldest generation, which they would reach after three searches of a tenth of a second.
    """
    if not gc.isenabled() or gc.get_freeze_count():
        return import_module(name)

    gc.disable()
    try:
        module = import_module(name)
        gc.freeze()
        gc.unfreeze()
    finally:
        gc.enable()
    return module


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
