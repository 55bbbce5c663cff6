"""The fit of a :class:`rawaug.isp.model.DictionaryISP` to RAW-sRGB pairs: seconds, from one frame upwards."""

from __future__ import annotations

from rawaug.isp.fit.config import FitConfig
from rawaug.isp.fit.pipeline import fit_isp

__all__ = ["FitConfig", "fit_isp"]
