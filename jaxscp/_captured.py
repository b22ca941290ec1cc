"""What a problem's functions capture, and derivatives that would be lost there."""

import functools
import inspect
from collections.abc import Callable, Iterator
from types import FunctionType
from typing import Any

import jax

from ._problem import OptimalControlProblem
from ._tree import is_differentiated


def check_captured(problem: OptimalControlProblem) -> None:
    """**Raises:** `ValueError` where a function captured a number by which a derivative
    is being taken, or over which is mapped: it is no leaf of the problem.
    """
    for path, leaf in jax.tree_util.tree_leaves_with_path(problem):
        if not callable(leaf):
            continue
        for name, value in _captured(leaf):
            if is_differentiated(value):
                use, can = "by which a derivative is being taken", "have derivatives"
            elif _is_mapped(value):
                use, can = "over which jax.vmap maps", "differ from element to element"
            else:
                continue
            where = jax.tree_util.keystr(path, simple=True, separator=".")
            field = name if name.isidentifier() else "value"
            raise ValueError(
                f"{where} captured {name!r}, {use}; only leaves of the problem {can}. "
                f"Make the function a Module with {field!r} as a field: "
                f"class Dynamics(equinox.Module): {field}: jax.Array; "
                "def __call__(self, t, x, u): ..."
            )


def _is_mapped(tree: Any) -> bool:
    tracers = [x for x in jax.tree.leaves(tree) if isinstance(x, jax.core.Tracer)]
    # JAX keeps the class of these to itself.
    return any(hasattr(tracer, "batch_dim") for tracer in tracers)


def _captured(function: Callable, depth: int = 3) -> Iterator[tuple[str, Any]]:
    """Names and values a function holds, those of functions it calls included."""
    if isinstance(function, functools.partial):
        held = {f"argument {place}": value for place, value in enumerate(function.args)}
        held |= function.keywords | {"function": function.func}
    elif inspect.ismethod(function):
        held = {"self": function.__self__, function.__name__: function.__func__}
    elif inspect.isfunction(function):
        names, closure = function.__code__.co_freevars, function.__closure__ or ()
        cells = zip(names, closure, strict=True)
        held = {name: cell.cell_contents for name, cell in cells if _is_filled(cell)}
        held |= _defaults(function)
    elif hasattr(function, "__wrapped__"):
        # As `jax.jit` and `functools.wraps` leave it.
        held = {"function": function.__wrapped__}
    elif hasattr(function, "__dict__") and not inspect.isclass(function):
        held = vars(function)
    else:
        return
    for name, value in held.items():
        yield name, value
        if depth and callable(value):
            yield from _captured(value, depth - 1)


def _defaults(function: FunctionType) -> dict[str, Any]:
    """What arguments are if they are not given."""
    code, values = function.__code__, function.__defaults__ or ()
    names = code.co_varnames[code.co_argcount - len(values) : code.co_argcount]
    return dict(zip(names, values, strict=True)) | (function.__kwdefaults__ or {})


def _is_filled(cell: Any) -> bool:
    """A function that calls itself may be looked at before it has its name."""
    try:
        cell.cell_contents  # noqa: B018
    except ValueError:
        return False
    return True
