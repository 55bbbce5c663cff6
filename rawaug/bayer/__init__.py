"""Mosaics: colour filter arrays, geometry that keeps their pattern, demosaicing."""

from rawaug.bayer.binning import Halving, to_bayer
from rawaug.bayer.cfa import (
    CFA,
    N_VIEWS,
    bin_mosaic,
    bin_mosaic_variance,
    bin_packed,
    crop,
    crop_to_cfa,
    mosaic,
    noise_variance,
    pack,
    pack_if_bayer,
    pack_rgb,
    sites_per_value,
    turn,
    turn_back,
    unpack,
    unpack_if_packed,
)
from rawaug.bayer.demosaicing import DIRECTIONAL, METHODS, STENCILS, demosaic, demosaicing_stencils, require_method
from rawaug.bayer.greens import GreenDifference, balance_greens, measure_greens
from rawaug.bayer.patterns import PATTERNS, Pattern, canonical_cfa, pattern, pattern_name, plane_indices
from rawaug.bayer.transforms import Pack, RandomCrop, RandomView

__all__ = [
    "CFA", "DIRECTIONAL", "METHODS", "N_VIEWS", "PATTERNS", "STENCILS", "GreenDifference", "Halving", "Pack",
    "Pattern", "RandomCrop", "RandomView", "balance_greens", "bin_mosaic", "bin_mosaic_variance", "bin_packed",
    "canonical_cfa", "crop", "crop_to_cfa", "demosaic", "demosaicing_stencils", "measure_greens", "mosaic",
    "noise_variance", "pack", "pack_if_bayer", "pack_rgb", "pattern", "pattern_name", "plane_indices",
    "require_method", "sites_per_value", "to_bayer", "turn", "turn_back", "unpack", "unpack_if_packed",
]  # fmt: skip
