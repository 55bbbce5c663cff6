"""Mosaics: colour filter arrays, geometry that keeps their pattern, demosaicing."""

from rawaug.bayer.cfa import (
    CFA,
    N_VIEWS,
    aligned,
    bin_mosaic,
    binned_variance,
    crop,
    mosaic,
    noise_variance,
    pack,
    pack_rgb,
    turn,
    turn_back,
    turn_keeping_cfa,
    unpack,
)
from rawaug.bayer.demosaicing import DIRECTIONAL, METHODS, STENCILS, demosaic, require_method, stencils_of
from rawaug.bayer.patterns import PATTERNS, Pattern, pattern
from rawaug.bayer.transforms import Pack, RandomCrop, RandomTurn

__all__ = [
    "CFA",
    "DIRECTIONAL",
    "METHODS",
    "N_VIEWS",
    "PATTERNS",
    "STENCILS",
    "Pack",
    "Pattern",
    "RandomCrop",
    "RandomTurn",
    "aligned",
    "bin_mosaic",
    "binned_variance",
    "crop",
    "demosaic",
    "mosaic",
    "noise_variance",
    "pack",
    "pack_rgb",
    "pattern",
    "require_method",
    "stencils_of",
    "turn",
    "turn_back",
    "turn_keeping_cfa",
    "unpack",
]
