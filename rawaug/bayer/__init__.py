"""Mosaics: colour filter arrays, geometry that keeps their pattern, demosaicing."""

from rawaug.bayer.binning import Halving, bayer_variance, to_bayer
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
from rawaug.bayer.patterns import PATTERNS, Pattern, layout, named, pattern, sites
from rawaug.bayer.transforms import Pack, RandomCrop, RandomTurn

__all__ = [
    "CFA",
    "DIRECTIONAL",
    "METHODS",
    "N_VIEWS",
    "PATTERNS",
    "STENCILS",
    "Halving",
    "Pack",
    "Pattern",
    "RandomCrop",
    "RandomTurn",
    "aligned",
    "bayer_variance",
    "bin_mosaic",
    "binned_variance",
    "crop",
    "demosaic",
    "layout",
    "mosaic",
    "named",
    "noise_variance",
    "pack",
    "pack_rgb",
    "pattern",
    "require_method",
    "sites",
    "stencils_of",
    "to_bayer",
    "turn",
    "turn_back",
    "turn_keeping_cfa",
    "unpack",
]
