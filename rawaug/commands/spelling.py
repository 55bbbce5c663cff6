"""How options are spelt on the command line: one way, with hyphens, in full.

The key ``train.learning_rate`` of a recipe is ``--train.learning-rate``. Below a key whose value is any mapping, as in
``--arms.real.learning_rate``, the rest is that mapping's own key.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from rawaug.registry import nearest


def spell_with_hyphens(parser: Any) -> None:
    """Rename the options of a parser of jsonargparse; where their values go stays as it was."""
    for action in parser._actions:
        action.option_strings = [hyphenated(option) for option in action.option_strings]
    options = {hyphenated(option): action for option, action in parser._option_string_actions.items()}
    parser._option_string_actions.clear()
    parser._option_string_actions.update(options)
    if parser._print_config is not None:
        parser._print_config = hyphenated(parser._print_config)


def require_known_options(command: str, parser: Any, arguments: Sequence[str]) -> None:
    """Refuse an option that the parser of a command does not have exactly so.

    Raises:
        ValueError: naming the option, and the one that begins so, or else is nearly spelt so.
    """
    options = parser._option_string_actions
    mappings = tuple(f"{option}." for option, action in options.items() if getattr(action, "_typehint", None))
    for argument in arguments:
        option = argument.partition("=")[0]
        if option.startswith("--") and option not in options and not option.startswith(mappings):
            spelt = hyphenated(option)
            longer = [known for known in options if known.startswith(spelt)]
            raise ValueError(
                f"{option}: no such option{nearest(spelt, longer or options)}; see rawaug {command} --help"
            )


def given_keys(arguments: Sequence[str]) -> set[str]:
    """The keys that are set on a command line.

    Example:
        >>> sorted(given_keys(["run", "fewshot", "--data.pairs", "mine", "--train.learning-rate=1e-4"]))
        ['data.pairs', 'train.learning_rate']
    """
    options = (argument.partition("=")[0] for argument in arguments if argument.startswith("--"))
    return {option.removeprefix("--").replace("-", "_") for option in options}


def require_known_keys(file: object, content: Any, parser: Any) -> None:
    """Refuse a key of a recipe that the parser does not have, and a section that is not one.

    Args:
        file: names the recipe in messages.
        content: of its YAML.
        parser: of the command that reads it.

    Raises:
        ValueError: naming the key, and the one that is nearly spelt so, or the keys that belong below it.
    """
    known = {action.dest for action in parser._actions if not action.dest.endswith(".help")}

    def walk(part: Mapping[str, Any], above: str) -> None:
        for name, value in part.items():
            key = f"{above}{name}"
            below = sorted(other for other in known if other.startswith(f"{key}."))
            if below and isinstance(value, Mapping):
                walk(value, f"{key}.")
            elif below:
                raise ValueError(f"{file}: {key}: must have keys below it, such as {below[0]}, got {value!r}")
            elif key not in known:
                raise ValueError(f"{file}: {key}: no such key{nearest(key, known)}")

    if isinstance(content, Mapping):
        walk(content, "")


def hyphenated(option: str) -> str:
    """The spelling of an option.

    Example:
        >>> hyphenated("--train.learning_rate")
        '--train.learning-rate'
    """
    return option.replace("_", "-")
