"""Old path of :mod:`rawaug.plugin.dataset`, kept for one release."""

from rawaug.plugin.dataset import RawPairs, RawPairStream

__all__ = ["RawPairStream", "RawPairs"]
