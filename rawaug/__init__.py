"""Online RAW data augmentation for denoiser training, by a learned dictionary ISP.

The public names load their modules on first use (PEP 562), so that importing one part of the package loads no other.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from rawaug._version import __version__

if TYPE_CHECKING:
    from rawaug.bayer import CFA
    from rawaug.isp.config import ISPConfig, ISPParams, ISPResult
    from rawaug.isp.model import DictionaryISP
    from rawaug.plugin.augment import RawAugment
    from rawaug.plugin.dataset import RawPairs, RawPairStream
    from rawaug.plugin.loader import WrappedLoader, wrap
    from rawaug.plugin.params import AugmentParams, RawPair, load_params, save_params
    from rawaug.training.camera import fit

_MODULES = {
    "CFA": "rawaug.bayer",
    "AugmentParams": "rawaug.plugin.params",
    "DictionaryISP": "rawaug.isp.model",
    "ISPConfig": "rawaug.isp.config",
    "ISPParams": "rawaug.isp.config",
    "ISPResult": "rawaug.isp.config",
    "RawAugment": "rawaug.plugin.augment",
    "RawPair": "rawaug.plugin.params",
    "RawPairStream": "rawaug.plugin.dataset",
    "RawPairs": "rawaug.plugin.dataset",
    "WrappedLoader": "rawaug.plugin.loader",
    "fit": "rawaug.training.camera",
    "load_params": "rawaug.plugin.params",
    "save_params": "rawaug.plugin.params",
    "wrap": "rawaug.plugin.loader",
}
"""Public name to the module that defines it."""

__all__ = [
    "CFA",
    "AugmentParams",
    "DictionaryISP",
    "ISPConfig",
    "ISPParams",
    "ISPResult",
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


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = globals()[name] = getattr(import_module(_MODULES[name]), name)
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
