"""The version of the package, on the ground floor, where every room may ask for it."""

__version__ = "0.1.0"
