"""Things by name: the networks, filters, noise models, datasets, estimators, losses, ... that one file adds.

A class or function with ``@KIND.register("name")`` above it, in a module of the kind's package, is found by that name;
so is one that another installed package offers as an entry point in the group ``rawaug.KIND``. The modules are imported
when a name is first asked for, an entry point when its own name is: importing this module loads nothing.

Recipes name a thing as ``{name: r2r, settings: {alpha: 0.5}}``; the settings are the keyword arguments of the class.
A name that is nearly right is answered with the nearest one.
"""

from __future__ import annotations

import difflib
import inspect
import pkgutil
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import cached_property
from importlib import import_module
from typing import Any, TypeVar

T = TypeVar("T")

_PLAIN: dict[str, tuple[type, ...]] = {"bool": (bool,), "int": (int,), "float": (int, float), "str": (str,)}


class UnknownName(ValueError, KeyError):
    """A name that nothing is registered under."""

    __str__ = Exception.__str__  # KeyError's is the repr


Spec = str | Mapping[str, Any]
"""A name, or ``{"name": ..., "settings": {...}}``."""


def split_spec(spec: Spec) -> tuple[str, dict[str, Any]]:
    """Split a spec into its name and its settings; a bare name has none.

    Raises:
        ValueError: if it has no name, or another key.

    Example:
        >>> split_spec({"name": "r2r", "settings": {"alpha": 0.5}})
        ('r2r', {'alpha': 0.5})
    """
    if isinstance(spec, str):
        return spec, {}
    given = dict(spec) if isinstance(spec, Mapping) else {}
    settings = given.get("settings") or {}
    if (
        not isinstance(given.get("name"), str)
        or not isinstance(settings, Mapping)
        or given.keys() - {"name", "settings"}
    ):
        raise ValueError(f"expected a name or {{name: ..., settings: {{...}}}}, got {given or spec!r}")
    return given["name"], dict(settings)


def spec_label(spec: Spec) -> str:
    """Write a spec in one line, for tables: its name and settings."""
    name, settings = split_spec(spec)
    return " ".join([name, *(f"{key}={value}" for key, value in settings.items())])


def check_settings(
    label: str, function: Callable[..., Any], settings: Mapping[str, Any], given: Iterable[str] = ()
) -> dict[str, Any]:
    """Check settings against the signature that takes them, and return them as keyword arguments, lists as tuples.

    Args:
        label: opens the messages.
        function: a function or class.
        settings: values by name.
        given: names that the caller passes besides, so that they may be missing here.

    Raises:
        ValueError: if one is unknown, missing, or not of the plain type that the signature names.
    """
    parameters = inspect.signature(function).parameters
    takes = [key for key, p in parameters.items() if p.kind not in (p.VAR_POSITIONAL, p.VAR_KEYWORD)]
    for key in [key for key in settings if key not in takes]:
        raise ValueError(f"{label} has no setting {key!r}; it has {', '.join(takes) or 'none'}{suggest(key, takes)}")
    for key in takes:
        if parameters[key].default is inspect.Parameter.empty and key not in {*settings, *given}:
            raise ValueError(f"{label} needs the setting {key!r}")
    return {key: _of_type(value, parameters[key], f"{label}: {key}") for key, value in settings.items()}


def require_between(key: str, value: object, least: float, most: float) -> None:
    """Refuse a number out of bounds before anything is built with it.

    Args:
        key: its name in the message.
        value: the number; it must be whole if both bounds are.
        least, most: the bounds, both allowed.

    Raises:
        ValueError: if it is out of bounds or no such number.

    Example:
        >>> require_between("width", 10**9, 1, 4096)
        Traceback (most recent call last):
        ValueError: width must be a whole number from 1 to 4096, got 1000000000
    """
    whole = isinstance(least, int) and isinstance(most, int)
    kind = (int,) if whole else (int, float)
    if isinstance(value, bool) or not isinstance(value, kind) or not least <= value <= most:
        raise ValueError(f"{key} must be a {'whole ' * whole}number from {least} to {most}, got {value!r:.100}")


def suggest(name: object, known: Iterable[str]) -> str:
    """Suggest the known name that is nearest, as ``" (nearest: UNet)"``; nothing if none is near."""
    by_key = {candidate.casefold(): candidate for candidate in known}
    near = difflib.get_close_matches(str(name).casefold(), by_key, n=1)
    return f" (nearest: {by_key[near[0]]})" if near else ""


class Registry(Mapping[str, Any]):
    """Things of one kind by name, in alphabetical order.

    Args:
        kind: what one of them is called in messages.
        group: of the entry points of other packages.
        packages: whose modules register the built-in ones; one is imported when those before it lack a name.

    Example:
        >>> filters = Registry("filter", "rawaug.filters", "denoisers")
        >>> @filters.register("Identity")
        ... class Identity:
        ...     def __init__(self, strength: float = 1.0) -> None:
        ...         self.strength = strength
        >>> filters.make({"name": "Identity", "settings": {"strength": 0.5}}).strength
        0.5
        >>> filters.make({"name": "Identity", "settings": {"strenght": 0.5}})
        Traceback (most recent call last):
        ValueError: filter Identity has no setting 'strenght'; it has strength (nearest: strength)
    """

    def __init__(self, kind: str, group: str, *packages: str) -> None:
        self.kind, self.group = kind, group
        self._things: dict[str, Any] = {}
        self._unimported = list(packages)

    def register(self, name: str) -> Callable[[T], T]:
        """Decorator: let the class or function be found by ``name``, which no other thing may have."""

        def add(thing: T) -> T:
            known = self._things.get(name, thing)
            if known is not thing and _path(known) != _path(thing):  # a module may be run again, as in a notebook
                raise ValueError(f"{self.kind} {name!r} is {_path(known)} already; give {_path(thing)} another name")
            self._things[name] = thing
            return thing

        return add

    def __getitem__(self, name: str) -> Any:
        while name not in self._things and self._unimported:
            self._import_next()
        if name not in self._things:
            if name not in self._entry_points:
                raise UnknownName(
                    f"{self.kind} {name!r} is unknown; use one of {', '.join(self)}{suggest(name, self)}; "
                    f"one of your own: rawaug --import FILE.py COMMAND, or an entry point in {self.group}"
                )
            self._things[name] = self._loaded(name)
        return self._things[name]

    def __contains__(self, name: object) -> bool:
        return name in self._things or name in set(self)

    def __iter__(self) -> Iterator[str]:
        while self._unimported:
            self._import_next()
        return iter(sorted({*self._things, *self._entry_points}, key=str.casefold))

    def __len__(self) -> int:
        return len(list(iter(self)))

    def name_of(self, thing: Any) -> str | None:
        """Find the name that a thing is registered under; None if it is not."""
        return next((name for name in (*self._things, *self) if self[name] is thing), None)

    def make(self, spec: Spec, **defaults: Any) -> Any:
        """Make a thing with the settings of its spec; ``defaults`` fill in what these leave out."""
        name, settings = split_spec(spec)
        return self[name](**{**defaults, **check_settings(f"{self.kind} {name}", self[name], settings, defaults)})

    def _import_next(self) -> None:
        package = self._unimported[0]
        for module in pkgutil.walk_packages(import_module(package).__path__, f"{package}."):
            import_module(module.name)
        del self._unimported[:1]

    @cached_property
    def _entry_points(self) -> dict[str, Any]:
        from importlib.metadata import entry_points

        found: dict[str, Any] = {}
        for point in entry_points(group=self.group):
            if point.name in found or point.name in self._things:
                warnings.warn(f"{point.value} is ignored: there is a {self.kind} {point.name!r} already", stacklevel=2)
            else:
                found[point.name] = point
        return found

    def _loaded(self, name: str) -> Any:
        point = self._entry_points[name]
        try:
            return point.load()
        except (ImportError, AttributeError) as error:
            raise ValueError(f"{self.kind} {name!r}: the entry point {point.value} cannot be loaded: {error}") from None


def _path(thing: Any) -> str:
    thing = getattr(thing, "func", thing)  # of functools.partial
    return f"{thing.__module__}.{thing.__qualname__}"


def _of_type(value: Any, parameter: inspect.Parameter, label: str) -> Any:
    """Return the value if it is of the parameter's type; only plain types are checked here."""
    hint, default = parameter.annotation, parameter.default
    expected = _PLAIN.get(hint if isinstance(hint, str) else getattr(hint, "__name__", ""))
    value = tuple(value) if isinstance(value, list) else value
    if expected is None and isinstance(default, tuple):
        expected = (tuple,)
    if expected is not None and (not isinstance(value, expected) or (isinstance(value, bool) and bool not in expected)):
        raise ValueError(f"{label} must be {expected[-1].__name__}, got {value!r}")
    return value
