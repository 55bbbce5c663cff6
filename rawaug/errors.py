"""One-line errors that say what to do: a library is not installed, or the machine is short of something.

Names of files, which may hold any byte but ``/`` and NUL, are made printable for terminals, logs and tables.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


def escape(text: object) -> str:
    r"""Write line breaks, terminal codes, bidirectional marks and bytes that are not UTF-8 as escapes.

    Example:
        >>> escape("a\nb\x1b[2Jc ü 写真")
        'a\\nb\\x1b[2Jc ü 写真'
    """
    characters = []
    for character in str(text):
        if not character.isprintable():
            character = character.encode("unicode_escape").decode("ascii")
        characters.append(character)
    return "".join(characters)


def count_of(number: int, noun: str, plural: str | None = None) -> str:
    """Write a number and its noun.

    Args:
        number: how many there are.
        noun: the singular.
        plural: the plural, if it is not the noun with an s.

    Example:
        >>> count_of(1, "picture"), count_of(2, "picture"), count_of(0, "pass", "passes")
        ('1 picture', '2 pictures', '0 passes')
    """
    if number == 1:
        return f"1 {noun}"
    return f"{number} {plural or noun + 's'}"


class MissingExtra(ImportError):
    """A library of an extra is not installed."""


@contextmanager
def extra(name: str) -> Iterator[None]:
    """Import libraries of the extra ``name`` in this block.

    Raises:
        MissingExtra: with the command that installs what is missing.

    Example:
        >>> with extra("raw"):  # doctest: +ELLIPSIS
        ...     import rawpy_of_the_future
        Traceback (most recent call last):
        ...
        rawaug.errors.MissingExtra: rawpy_of_the_future is not installed; run: pip install ...
    """
    try:
        yield
    except ModuleNotFoundError as error:
        raise MissingExtra(f"{(error.name or name).split('.')[0]} is not installed; {how_to_install(name)}") from None


def how_to_install(name: str) -> str:
    """Give the command that installs the extra ``name``, from the checkout if this is one."""
    checkout = Path(__file__).parents[1]
    package = str(checkout) if (checkout / "setup.cfg").is_file() else "rawaug"
    return f"run: pip install '{package}[{name}]'"


_MEMORY = "out of memory; use a smaller batch, crop or tile"
_WAYS_OUT = (
    (r"too many open files|ancdata", "too many open files; raise the limit (ulimit -n) or use fewer workers"),
    (
        r"out of shared memory|shared memory\(shm\)|bus error|/torch_",
        "shared memory is full; enlarge /dev/shm or use fewer workers",
    ),
    (r"out of memory|can't allocate memory", _MEMORY),
    (
        r"dataloader worker.*(killed|exited)",
        "a worker process was killed, perhaps for its memory; use fewer workers, or find a damaged file with rawaug "
        "data check",
    ),
    (
        r"connection (closed|reset) by peer|gloo/|nccl|distbackenderror",
        "another process of this training was killed, perhaps for its memory; free some",
    ),
    (r"no space left on device|pytorchstreamwriter", "the disk is full; free some space"),
)
"""These are patterns of an error's text in lower case, with advice. The first pattern that matches counts."""


def resource_error(error: BaseException) -> str | None:
    """Say in one line what the machine is short of and what to do; return None for any other error.

    Example:
        >>> resource_error(RuntimeError("DataLoader worker (pid 12) is killed by signal: Killed. "))
        'a worker process was killed, perhaps for its memory; use fewer workers, or find a damaged file with \
rawaug data check, then run the same command again'
    """
    if isinstance(error, MemoryError):
        return f"{_MEMORY}, then run the same command again"

    text = str(error).lower()
    for pattern, advice in _WAYS_OUT:
        if re.search(pattern, text, re.DOTALL):
            return f"{advice}, then run the same command again"
    return None


def strip_traceback(text: str) -> str:
    """Keep the last line of an error that a DataLoader's worker raised, without its traceback.

    Example:
        >>> strip_traceback("Caught ValueError in a worker.\\nOriginal Traceback ...\\nValueError: a")
        'a'
    """
    if "Original Traceback" not in text:
        return text
    return text.strip().splitlines()[-1].partition(": ")[2]
