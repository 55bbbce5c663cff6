"""Old path of :mod:`rawaug.plugin.params`, kept for one release."""

from rawaug.plugin.params import AugmentParams, RawPair, load_params, save_params

__all__ = ["AugmentParams", "RawPair", "load_params", "save_params"]
