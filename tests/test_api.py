"""The API's page and the exported names agree: what the page shows exists, and what a package exports is shown."""

from __future__ import annotations

import gc
import re
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

import rawaug

PAGE = Path(__file__).parents[1] / "docs" / "api.md"
ENTRY = re.compile(r"^::: (\S+)\n((?:[ ]+.*\n)*)", re.MULTILINE)
MEMBERS = re.compile(r"members: \[([^]]*)\]")


def load(path: str) -> Any:
    """A module, or what a module has under the last name of a path."""
    try:
        return import_module(path)
    except ModuleNotFoundError:
        module, _, name = path.rpartition(".")
        return getattr(import_module(module), name)


def shown_objects() -> list[Any]:
    """The objects that the page shows: those of a module are the listed members, or else all that it exports."""
    objects = []
    for path, options in ENTRY.findall(PAGE.read_text(encoding="utf-8")):
        entry = load(path)
        objects.append(entry)

        members = MEMBERS.search(options)
        names = list(getattr(entry, "__all__", []))
        if members is not None:
            names = members[1].replace("\n", " ").split(",")
        elif isinstance(entry, ModuleType):
            names += [name for name, value in vars(entry).items() if getattr(value, "__module__", "") == path]
        for name in names:
            objects.append(getattr(entry, name.strip()))
    return objects


@pytest.mark.parametrize("package", ["rawaug", "rawaug.bayer", "rawaug.data", "rawaug.io", "rawaug.noise", "denoisers"])
def test_the_page_shows_what_a_package_exports(package: str) -> None:
    module = import_module(package)
    shown = shown_objects()
    missing = []
    for name in module.__all__:
        if name != "__version__" and not any(getattr(module, name) is entry for entry in shown):
            missing.append(name)
    assert not missing


def test_a_first_import_leaves_the_garbage_collector_as_it_was(monkeypatch: pytest.MonkeyPatch) -> None:
    calls, counts = list[str](), [0, 0, 5]
    monkeypatch.setattr(gc, "freeze", lambda: calls.append("freeze"))
    monkeypatch.setattr(gc, "unfreeze", lambda: calls.append("unfreeze"))
    monkeypatch.setattr(gc, "get_freeze_count", lambda: counts.pop(0))

    rawaug._import("rawaug.bayer")
    assert calls == ["freeze", "unfreeze"] and gc.isenabled()
    with pytest.raises(ImportError):
        rawaug._import("rawaug.nothing")
    assert calls == ["freeze", "unfreeze"] and gc.isenabled()

    rawaug._import("rawaug.bayer")
    assert len(calls) == 2, "what a user has frozen stays frozen"
