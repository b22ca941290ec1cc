"""Who is told of every iteration: Python functions, from inside compiled programs.

A program knows only the number of whom it tells. It is the same for all of them, and in
every process.
"""

import functools
import types
from collections.abc import Callable

import jax.numpy as jnp
import numpy as np

from ._host import tell_host
from ._types import Array, ArrayLike, Float

# Kept for good, as JAX keeps the functions that its programs call.
_listeners: list[Callable[[dict], None]] = []
# What comes before the values of an iteration: which listener, guess and iteration.
_COUNTS = 3


def listener(function: Callable[[dict], None] | None) -> Array | None:
    """The function's number, to be passed to a program."""
    if function is None:
        return None
    known = (i for i, each in enumerate(_listeners) if _is_same(each, function))
    number = next(known, len(_listeners))
    if number == len(_listeners):
        _listeners.append(function)
    return jnp.asarray(number)


def _is_same(one: Callable, other: Callable) -> bool:
    """Two recorders may be equal and yet two. A method is made anew each time that it is
    asked for; it equals another if it is the same one of the same object.
    """
    methods = (types.MethodType, types.BuiltinMethodType)
    return one is other or (isinstance(one, methods) and one == other)


def tell(
    listener: Array, attempt: ArrayLike, iteration: Array, values: dict[str, Array]
) -> None:
    """Call a listener with an iteration's numbers."""
    names = tuple(values)
    counts = [listener, jnp.asarray(attempt), iteration]
    vector = jnp.stack([jnp.asarray(v, float) for v in [*counts, *values.values()]])
    tell_host(
        f"jaxscp_progress_{'_'.join(names)}", functools.partial(_heard, names), vector
    )


def _heard(names: tuple[str, ...], vector: Float[np.ndarray, " v"]) -> None:
    number, attempt, iteration = (int(count) for count in vector[:_COUNTS])
    told = dict(zip(names, vector[_COUNTS:].tolist(), strict=True))
    _listeners[number]({"attempt": attempt, "iteration": iteration, **told})
