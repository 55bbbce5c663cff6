"""Libraries of the extras, as ``[raw]`` and ``[train]``: what is not installed is named with its extra."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager


class MissingExtra(ImportError):
    """A library of an extra is not installed."""


@contextmanager
def extra(name: str) -> Iterator[None]:
    """Import libraries of the extra ``name`` in this block.

    Raises:
        MissingExtra: with the command that installs what is missing.

    Example:
        >>> with extra("raw"):
        ...     import rawpy_of_the_future
        Traceback (most recent call last):
        ...
        rawaug.extras.MissingExtra: rawpy_of_the_future is not installed; run: pip install 'rawaug[raw]'
    """
    try:
        yield
    except ModuleNotFoundError as error:
        raise MissingExtra(
            f"{str(error.name).split('.')[0]} is not installed; run: pip install 'rawaug[{name}]'"
        ) from None
