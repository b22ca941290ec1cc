"""Axis names and aliases used in every shape annotation.

=====  ==========================================================
Axis   Meaning
=====  ==========================================================
`N`    nodes of the time grid
`I`    intervals between them, N - 1
`n`    entries of the state
`m`    entries of the control
`p`    entries of one path constraint
`q`    integral constraints
`r`    quantities accumulated along the flow: the integrals and the running cost
`w`    state and control together, n + m
=====  ==========================================================
"""

from collections.abc import Callable, Sequence
from typing import Any, TypeAlias

import jax
import numpy as np
from jax.typing import ArrayLike as JaxArrayLike
from jaxtyping import Array, Float, PyTree

# Lists are welcome too, as in NumPy.
ArrayLike: TypeAlias = JaxArrayLike | Sequence[Any]
Scalar: TypeAlias = Float[Array, ""]
State: TypeAlias = Float[Array, " n"]
Control: TypeAlias = Float[Array, " m"]
# f(t, x, u): the signature of dynamics, costs, path constraints and integrands.
TimeStateControl: TypeAlias = Callable[[Scalar, State, Control], Array]

__all__ = [
    "Array",
    "ArrayLike",
    "Control",
    "Float",
    "PyTree",
    "Scalar",
    "State",
    "TimeStateControl",
    "check_count",
    "check_kind",
    "is_concrete",
]


def is_concrete(*values: object) -> bool:
    """Whether every value is a number now, not a tracer of some transformation.

    Checks of values run only on concrete ones: under `jax.jit`, `jax.grad` or
    `jax.vmap` the numbers do not exist yet when Python runs.
    """
    return not any(
        isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(values)
    ) and all(
        isinstance(leaf, (np.ndarray, np.generic, jax.Array, int, float, bool))
        for leaf in jax.tree.leaves(values)
    )


def check_kind(name: str, value: object, kind: Any, give: str) -> None:
    """**Raises:** `ValueError` saying what to give where something else is given."""
    if not isinstance(value, kind):
        given = value.__name__ if isinstance(value, type) else type(value).__name__
        raise ValueError(f"{name} is {given}; give {give}.")


def check_count(name: str, value: object, least: int) -> None:
    """**Raises:** `ValueError` for anything but a whole number from `least`."""
    if not isinstance(value, int) or value < least:
        raise ValueError(f"{name}={value!r}: give a whole number from {least}.")
