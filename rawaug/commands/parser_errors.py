"""The parser's errors in plain words: jsonargparse names types of Python, a user knows numbers and keys.

A message that is not recognised, as of another version of jsonargparse, stays as it is.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import Any

from rawaug.registry import nearest

_PLAIN = {"int": "a whole number", "float": "a number", "bool": "true or false", "str": "text", "dict": "a mapping"}
_PLAIN |= {"NoneType": "null"}
_TYPE = re.compile(r"(?P<key>[\w.]+): Expected an? (?P<type>\w+)\. Got value: (?P<value>.*)")
_CHOICE = re.compile(r"(?P<key>[\w.]+): Expected a typing\.Literal\[(?P<names>.*?)\]\. Got value: (?P<value>.*)")
_UNION = re.compile(
    r"(?P<key>[\w.]+): Does not validate .* Subtypes: \[(?P<types>.*?)\] Errors: .*Given value: (?P<value>.*)"
)
_MISSING = re.compile(r"the following arguments are required: (?P<keys>.*)")
_SURPLUS = re.compile(r"unrecognized arguments: (?P<rest>.*)")


def in_plain_words(text: str, command: str | None, parser: Any) -> str:
    """An error of jsonargparse as one line for a user.

    Args:
        text: of the error, in one line.
        command: that was called, None if there was none.
        parser: of this command.

    Example:
        >>> in_plain_words("train.steps: Expected a int. Got value: many", "run", None)
        'train.steps must be a whole number, got many'
        >>> in_plain_words("unrecognized arguments: c.dng", "denoise", None)
        'c.dng: too many arguments; see rawaug denoise --help'
    """
    if (match := _TYPE.fullmatch(text)) and match["type"] in _PLAIN:
        return f"{match['key']} must be {_PLAIN[match['type']]}, got {match['value']}"
    if match := _CHOICE.fullmatch(text):
        names = re.findall(r"'([^']*)'", match["names"])
        return f"{match['key']} must be one of {', '.join(names)}, got {match['value']}{nearest(match['value'], names)}"
    if (match := _UNION.fullmatch(text)) and set(match["types"].split(", ")) <= set(_PLAIN):
        wanted = " or ".join(_PLAIN[name] for name in match["types"].split(", "))
        return f"{match['key']} must be {wanted}, got {match['value']}"
    if command is not None and (match := _MISSING.fullmatch(text)):
        missing = (
            _spelt(key.removeprefix(f"{command.replace(' ', '.')}."), parser) for key in match["keys"].split(", ")
        )
        return f"{', '.join(missing)} must be given; see rawaug {command} --help"
    if command is not None and (match := _SURPLUS.fullmatch(text)):
        return f"{match['rest']}: too many arguments; see rawaug {command} --help"
    return text


def require_known_command(argv: list[str], names: Iterable[str]) -> None:
    """Refuse a first word, or a second where a command has two, that no command begins with.

    Raises:
        ValueError: naming it, and the command that is nearly spelt so, or those that begin with the first word.

    Example:
        >>> require_known_command(["denoize", "in.dng"], ["data check", "denoise"])
        Traceback (most recent call last):
        ValueError: denoize: no such command (nearest: denoise); see rawaug --help
    """
    words = [word for word in argv[:2] if not word.startswith("-")]
    known = [name.split() for name in names]
    if not words or argv[0] != words[0] or any(name == words[: len(name)] for name in known):
        return
    below = [" ".join(name) for name in known if name[0] == words[0]]
    if not below:
        raise ValueError(
            f"{words[0]}: no such command{nearest(words[0], (name[0] for name in known))}; see rawaug --help"
        )
    if "-h" not in argv and "--help" not in argv:
        raise ValueError(f"{' '.join(words)}: no such command; use rawaug {' or rawaug '.join(below)}")


def _spelt(key: str, parser: Any) -> str:
    """What stands for a key on the command line: its option, or a positional's name."""
    actions = () if parser is None else parser._actions
    options = next((action.option_strings for action in actions if action.dest == key), ())
    return options[0] if options else key
