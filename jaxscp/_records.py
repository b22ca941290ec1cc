"""Modules made of numbers, as nested dictionaries and dotted paths."""

import dataclasses
from collections.abc import Iterable, Mapping
from typing import Any, TypeVar

import equinox as eqx
import numpy as np

_Module = TypeVar("_Module", bound=eqx.Module)


def to_dict(module: eqx.Module) -> dict[str, Any]:
    """Fields of a Module and of the Modules in it; arrays become lists of floats.

    Nothing is rounded: the floats, and JSON text written of them, give the same Module
    again.
    """
    return {
        field.name: plain(getattr(module, field.name))
        for field in dataclasses.fields(module)
    }


def from_dict(kind: type[_Module], values: Any, path: str = "") -> _Module:
    """The Module of class `kind` whose fields have these values, a dictionary.

    **Raises:** `ValueError` if an entry is missing, unknown or not valid, by its dotted
    path from the outermost Module.
    """
    if not isinstance(values, Mapping):
        what = f"{path}={values!r}" if path else f"{values!r}"
        raise ValueError(f"{what}: give an object with named entries.")
    fields: dict[str, Any] = {
        field.name: field.type for field in dataclasses.fields(kind)
    }
    for name in values:
        if name not in fields:
            raise unknown_path(_join(path, str(name)), (_join(path, f) for f in fields))
    entries = {}
    for name, annotation in fields.items():
        if name not in values:
            raise ValueError(f"{_join(path, name)} is missing: give it a value.")
        entries[name] = (
            from_dict(annotation, values[name], _join(path, name))
            if _is_module(annotation)
            else values[name]
        )
    try:
        return kind(**entries)
    except ValueError as error:
        # A Module calls itself by its class; here it has a place.
        named = str(error).replace(f"{kind.__name__}.", f"{path}." if path else "", 1)
        raise ValueError(named) from None


def with_entries(values: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """Nested dictionaries with the entries at some dotted paths changed.

    **Raises:** `ValueError` on a path that is not in `values`, listing those that are.
    """
    valid = tuple(flat(values))
    changed = _copied(values)
    for path, value in changes.items():
        if path not in valid:
            raise unknown_path(path, valid)
        *parents, name = path.split(".")
        inner = changed
        for parent in parents:
            inner = inner[parent]
        inner[name] = value
    return changed


def flat(values: Mapping[str, Any], path: str = "") -> dict[str, Any]:
    """All entries that are not themselves dictionaries, by their dotted paths."""
    found: dict[str, Any] = {}
    for name, value in values.items():
        whole = _join(path, name)
        found |= flat(value, whole) if isinstance(value, Mapping) else {whole: value}
    return found


def unknown_path(path: str, valid: Iterable[str]) -> ValueError:
    """The error for a path that does not exist."""
    return ValueError(f"{path}: no such entry; valid ones are {', '.join(valid)}.")


def plain(value: Any) -> Any:
    """As JSON has it: Modules become dictionaries, arrays lists, None stays."""
    if isinstance(value, eqx.Module):
        return to_dict(value)
    if value is None or isinstance(value, str):
        return value
    return np.asarray(value).tolist()


def _copied(values: Mapping[str, Any]) -> dict[str, Any]:
    return {
        name: _copied(value) if isinstance(value, Mapping) else value
        for name, value in values.items()
    }


def _is_module(annotation: Any) -> bool:
    return isinstance(annotation, type) and issubclass(annotation, eqx.Module)


def _join(path: str, name: str) -> str:
    return f"{path}.{name}" if path else name
