"""Old path of :mod:`rawaug.plugin.augment`, kept for one release."""

from rawaug.plugin.augment import RawAugment, Sampling, noise_for

__all__ = ["RawAugment", "Sampling", "noise_for"]
