"""Names of files as text for terminals, logs and tables: a name may hold any byte but ``/`` and NUL."""

from __future__ import annotations


def printable(text: object) -> str:
    r"""The text with what is not printed as its escape: line breaks, terminal codes, marks that turn the direction of
    writing, and bytes of a name that are not UTF-8.

    Example:
        >>> printable("a\nb\x1b[2Jc ü 写真")
        'a\\nb\\x1b[2Jc ü 写真'
    """
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode("ascii") for c in str(text))
