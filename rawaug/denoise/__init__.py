"""What makes clean RAW of noisy RAW: denoisers by any name, the levels that they are told, frames and files.

The package can be called, and is then :func:`rawaug.denoise.frames.denoise`: ``rawaug.denoise("in.dng", "out.dng")``.
"""

from __future__ import annotations

import inspect
import sys
from types import ModuleType

from rawaug.denoise.frames import denoise


class _Callable(ModuleType):
    __call__ = staticmethod(denoise)


__signature__ = inspect.signature(denoise)
sys.modules[__name__].__class__ = _Callable
