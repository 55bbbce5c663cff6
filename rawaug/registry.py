"""Registries of things by name: networks, filters, noise models, datasets, estimators, losses, ..., one file each.

A class or function with ``@KIND.register("name")`` above it, in a module of the kind's package, is found by that name.
So is one that another installed package offers as an entry point in the group ``rawaug.KIND``. The modules are imported
when a name is first asked for, and an entry point is imported when its own name is, so importing this module loads
nothing.

Recipes name a thing as ``{name: r2r, alpha: 0.5}``, or ``{name: r2r, settings: {alpha: 0.5}}``; the settings are the
keyword arguments of the class.
A name that is nearly right is answered with the nearest one.
"""

from __future__ import annotations

import difflib
import inspect
import pkgutil
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import cache, cached_property
from importlib import import_module
from typing import Any, Literal, TypeVar, get_args, get_origin, get_type_hints

from annotated_types import Interval

T = TypeVar("T")

_PLAIN: dict[str, tuple[type, ...]] = {"bool": (bool,), "int": (int,), "float": (int, float), "str": (str,)}


class UnknownName(ValueError, KeyError):
    """A name that nothing is registered under."""

    __str__ = Exception.__str__  # KeyError's is the repr


Spec = str | Mapping[str, Any]
"""A name, ``{"name": ..., key: value, ...}``, or ``{"name": ..., "settings": {key: value, ...}}``."""


def split_spec(spec: Spec) -> tuple[str, dict[str, Any]]:
    """Split a spec into its name and its settings; a bare name has none.

    Raises:
        ValueError: if it has no name, or settings in both places.

    Example:
        >>> split_spec({"name": "r2r", "alpha": 0.5}), split_spec({"name": "r2r", "settings": {"alpha": 0.5}})
        (('r2r', {'alpha': 0.5}), ('r2r', {'alpha': 0.5}))
    """
    if isinstance(spec, str):
        return spec, {}

    if isinstance(spec, Mapping) and isinstance(spec.get("name"), str):
        settings = {key: value for key, value in spec.items() if key != "name"}
        if "settings" not in settings:
            return spec["name"], settings
        nested = settings.pop("settings") or {}
        if not settings and isinstance(nested, Mapping):
            return spec["name"], dict(nested)
    raise ValueError(f"expected a name or {{name: ..., key: value, ...}}, got {spec!r}")


def spec_label(spec: Spec) -> str:
    """Write a spec in one line, for tables: its name and settings."""
    name, settings = split_spec(spec)
    for key, value in settings.items():
        name += f" {key}={value}"
    return name


def check_settings(
    label: str, function: Callable[..., Any], settings: Mapping[str, Any], given: Iterable[str] = ()
) -> dict[str, Any]:
    """Check settings against the signature that takes them, and return them as keyword arguments, lists as tuples.

    Args:
        label: opens the messages.
        function: a function or class.
        settings: values by name.
        given: names that the caller passes in addition, so they may be missing here.

    Raises:
        ValueError: if one is unknown, missing, or not of the plain type that the signature names.
    """
    parameters = inspect.signature(function).parameters
    variadic = (inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD)
    names = [name for name, parameter in parameters.items() if parameter.kind not in variadic]

    for key in settings:
        if key not in names:
            choices = ", ".join(names) or "none"
            raise ValueError(f"{label} has no setting {key!r}; it has {choices}{suggest(key, names)}")
    for name in names:
        if parameters[name].default is inspect.Parameter.empty and name not in {*settings, *given}:
            raise ValueError(f"{label} needs the setting {name!r}")

    arguments = {}
    for key, value in settings.items():
        arguments[key] = _of_type(value, parameters[key], f"{label}: {key}")
    return arguments


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
    noun = "number"
    is_valid = isinstance(value, (int, float)) and not isinstance(value, bool) and least <= value <= most
    if isinstance(least, int) and isinstance(most, int):
        noun = "whole number"
        is_valid = is_valid and isinstance(value, int)

    if not is_valid:
        raise ValueError(f"{key} must be a {noun} from {least} to {most}, got {value!r:.100}")


@cache
def field_types(settings: type[Any]) -> dict[str, Any]:
    """Evaluate the types of the fields of a dataclass, which are text in its source."""
    return get_type_hints(settings)


@cache
def list_bounds(settings: type[Any]) -> dict[str, Interval]:
    """List the bounds of the fields of a dataclass, as ``Annotated[int, Interval(ge=1, le=9)]`` states them.

    Pydantic checks them in files and on the command line.
    """
    bounds = {}
    for name, hint in get_type_hints(settings, include_extras=True).items():
        for part in (hint, *get_args(hint)):  # one of the types may be None
            for detail in getattr(part, "__metadata__", ()):
                if isinstance(detail, Interval):
                    bounds[name] = detail
    return bounds


def require_bounds(settings: Any, above: str = "") -> None:
    """Refuse a value in a dataclass that is out of the bounds of its field, or none of the choices of its Literal.

    Args:
        settings: an instance of the dataclass.
        above: what precedes the names of fields in messages, such as ``"train."``.

    Raises:
        ValueError: as :func:`require_between` does; None has no bounds.
    """
    kind: Any = type(settings)
    for name, bounds in list_bounds(kind).items():
        value = getattr(settings, name)
        if value is None:
            continue
        if bounds.lt is None:
            require_between(f"{above}{name}", value, bounds.ge, bounds.le)  # type: ignore[arg-type]
        elif not bounds.ge <= value < bounds.lt:
            raise ValueError(f"{above}{name} must be at least {bounds.ge} and below {bounds.lt}, got {value!r:.100}")

    for name, hint in field_types(kind).items():
        choices = get_args(hint)
        if get_origin(hint) is Literal and getattr(settings, name) not in choices:
            choices_in_words = " or ".join(map(str, choices))
            raise ValueError(f"{above}{name} must be {choices_in_words}, got {getattr(settings, name)!r:.100}")


def suggest(name: object, known: Iterable[str]) -> str:
    """Suggest the nearest known name, as ``" (nearest: UNet)"``; suggest nothing if none is near."""
    by_key = {candidate.casefold(): candidate for candidate in known}
    near = difflib.get_close_matches(str(name).casefold(), by_key, n=1)
    if not near:
        return ""
    return f" (nearest: {by_key[near[0]]})"


class Registry(Mapping[str, Any]):
    """Things of one kind by name, in alphabetical order.

    Args:
        kind: the noun for one of them in messages.
        group: the group of the entry points by which other packages add theirs.
        packages: the packages whose modules register the built-in ones. A package is imported when those before it lack
            a name.

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
        """Let the decorated class or function be found by ``name``, which no other thing may have."""

        def add(thing: T) -> T:
            namesake = self._things.get(name, thing)
            if _path(namesake) != _path(thing):  # a module may be run again, as in a notebook
                raise ValueError(f"{self.kind} {name!r} is {_path(namesake)} already; give {_path(thing)} another name")

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
            self._things[name] = self._load(name)
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
        """Find the name that a thing is registered under; return None if it is not registered."""
        for name in (*self._things, *self):
            if self[name] is thing:
                return name
        return None

    def make(self, spec: Spec, **defaults: Any) -> Any:
        """Make a thing with the settings of its spec; ``defaults`` supply the settings that are left out."""
        name, settings = split_spec(spec)
        thing = self[name]
        arguments = check_settings(f"{self.kind} {name}", thing, settings, defaults)
        return thing(**{**defaults, **arguments})

    def _import_next(self) -> None:
        package = self._unimported[0]
        for module in pkgutil.walk_packages(import_module(package).__path__, f"{package}."):
            import_module(module.name)
        del self._unimported[:1]

    @cached_property
    def _entry_points(self) -> dict[str, Any]:
        from importlib.metadata import entry_points

        points: dict[str, Any] = {}
        for point in entry_points(group=self.group):
            if point.name in points or point.name in self._things:
                warnings.warn(f"{point.value} is ignored: there is a {self.kind} {point.name!r} already", stacklevel=2)
            else:
                points[point.name] = point
        return points

    def _load(self, name: str) -> Any:
        point = self._entry_points[name]
        try:
            return point.load()
        except (Exception, SystemExit) as error:  # whatever that module does
            reason = " ".join(str(error).split())
            raise ValueError(
                f"{self.kind} {name!r}: the entry point {point.value} cannot be loaded: {reason}"
            ) from None


def _path(thing: Any) -> str:
    """Find where a thing is defined; a ``functools.partial`` counts as its function."""
    thing = getattr(thing, "func", thing)
    return f"{thing.__module__}.{thing.__qualname__}"


def _of_type(value: Any, parameter: inspect.Parameter, label: str) -> Any:
    """Return the value if it is of the parameter's type; only plain types are checked here."""
    if isinstance(value, list):
        value = tuple(value)

    hint = parameter.annotation
    if not isinstance(hint, str):
        hint = getattr(hint, "__name__", "")
    types = _PLAIN.get(hint)
    if types is None and isinstance(parameter.default, tuple):
        types = (tuple,)
    if types is None:
        return value

    number_as_flag = isinstance(value, bool) and bool not in types
    if not isinstance(value, types) or number_as_flag:
        raise ValueError(f"{label} must be {types[-1].__name__}, got {value!r}")
    return value
