"""Old path of :mod:`rawaug.plugin.loader`, kept for one release."""

from rawaug.plugin.loader import WrappedLoader, wrap

__all__ = ["WrappedLoader", "wrap"]
