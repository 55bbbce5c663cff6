"""YAML of strangers: how large and how deeply nested a recipe may be, its aliases written out.

A few lines of anchors and aliases stand for billions of values (the "billion laughs"). Reading them takes no time,
since equal values are one object; whatever visits each of them never ends. Here they are counted first.
Source: YAML 1.2.2, chapter 7.1; https://en.wikipedia.org/wiki/Billion_laughs_attack.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

MOST_BYTES, MOST_VALUES, DEEPEST = 2**20, 20_000, 32


def read_yaml(path: str | Path) -> Any:
    """The content of a YAML file as plain values.

    Raises:
        ValueError: in one line that names the key, if it is no YAML, or larger or deeper than a recipe can be.
    """
    import yaml

    size = Path(path).stat().st_size
    if size > MOST_BYTES:
        raise ValueError(f"{path}: has {size} bytes, a recipe at most {MOST_BYTES}")
    try:
        text = Path(path).read_text(encoding="utf-8")
        _require_bounded(text)
        return yaml.safe_load(text)
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        reason = " ".join(str(error).split())
        raise ValueError(f"{path}: not a YAML file ({reason}); see the recipes in the package") from error
    except (ValueError, OverflowError) as error:
        raise ValueError(f"{path}: {error}") from None


@dataclass
class _Open:
    """A list or mapping whose end is still to come."""

    anchor: str | None
    mapping: bool
    values: int = 1
    children: int = 0
    key: str = ""


def _require_bounded(text: str) -> None:
    """Refuse what a recipe cannot be, event by event, without building it.

    Raises:
        ValueError, yaml.YAMLError: naming the key or the line.
    """
    import yaml

    sizes: dict[str | None, int] = {}
    nodes: list[_Open] = []

    def add(values: int) -> None:
        if nodes:
            nodes[-1].values += values
            if nodes[-1].values > MOST_VALUES:
                raise ValueError(f"{_place(nodes)}: more than {MOST_VALUES} values, aliases written out")

    for event in yaml.parse(text, Loader=yaml.SafeLoader):
        if isinstance(event, yaml.CollectionEndEvent):
            done = nodes.pop()
            sizes[done.anchor] = done.values
            add(done.values)
        elif isinstance(event, yaml.NodeEvent):
            _enter(nodes, event)
            if isinstance(event, yaml.CollectionStartEvent):
                nodes.append(_Open(event.anchor, isinstance(event, yaml.MappingStartEvent)))
                if len(nodes) > DEEPEST:
                    raise ValueError(f"{_place(nodes)}: nested more than {DEEPEST} deep")
            elif isinstance(event, yaml.AliasEvent):
                if event.anchor not in sizes:
                    raise ValueError(f"{_place(nodes)}: the alias *{event.anchor} refers to nothing, or to itself")
                add(sizes[event.anchor])
            else:
                sizes[event.anchor] = 1
                add(1)


def _enter(nodes: list[_Open], event: Any) -> None:
    """Note under which key of its parent a node stands."""
    if nodes:
        parent = nodes[-1]
        if not parent.mapping:
            parent.key = str(parent.children)
        elif parent.children % 2 == 0:
            parent.key = getattr(event, "value", "?")
        parent.children += 1


def _place(nodes: list[_Open]) -> str:
    """The path of keys, such as ``denoiser.settings.width``; its beginning if it is long."""
    return ".".join(node.key for node in nodes if node.key)[:80]
