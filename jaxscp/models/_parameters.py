"""Conversion and checks of the numbers a model is made of."""

import math
import reprlib
from typing import Any, TypeAlias

import jax
import numpy as np

from .._tree import as_array, as_floats
from .._types import Array, is_concrete

# Numbers, nested lists of them, or arrays. Left open on purpose: `parameter` meets
# anything else with a message that says what to give.
Numbers: TypeAlias = Any


def parameter(
    name: str,
    value: Numbers,
    *,
    shape: tuple[int | None, ...] = (),
    unit: str = "",
    above: float = -math.inf,
    at_least: float = -math.inf,
    at_most: float = math.inf,
) -> Array:
    """`value` as a floating-point array, so that it is a parameter of the problem.

    **Arguments:**

    - `name`: what messages call it, such as `Quadrotor.mass`.
    - `shape`: the shape it must have; `None` stands for any number of rows.
    - `unit`: for messages.
    - `above`, `at_least`, `at_most`: range of every entry; each must be finite besides.
        A traced value has no number yet and is not compared.

    **Raises:** `ValueError` naming the field, the value and what to give instead.
    """
    expected = _expected(shape, unit, above, at_least, at_most)
    array = _converted(name, value, expected)
    if array.size == 0 and shape[:1] == (None,):
        # An empty list has lost its trailing axes.
        array = array.reshape(0, *(size or 0 for size in shape[1:]))
    array = as_floats(array)
    if len(array.shape) != len(shape) or any(
        size not in {None, found} for size, found in zip(shape, array.shape, strict=True)
    ):
        raise ValueError(f"{name} has shape {array.shape}: give {expected}.")
    if not is_concrete(array):
        return array
    entries = np.asarray(array)
    allowed = (
        np.isfinite(entries)
        & (entries > above)
        & (entries >= at_least)
        & (entries <= at_most)
    )
    if not allowed.all():
        worst = tuple(np.argwhere(~allowed)[0])
        at = "".join(f"[{index}]" for index in worst)
        raise ValueError(f"{name}{at}={entries[worst]:g}: give {expected}.")
    return array


def optional_parameter(name: str, value: Numbers | None, **rules) -> Array | None:
    """None, or what [`parameter`][] makes of the value."""
    return None if value is None else parameter(name, value, **rules)


def _converted(name: str, value: Numbers, expected: str) -> Array | np.ndarray:
    # Python would take a truth value for a number as well.
    leaves = jax.tree.leaves(value, is_leaf=lambda leaf: leaf is None)
    numeric = not any(isinstance(leaf, (bool, str, type(None))) for leaf in leaves)
    try:
        array = as_array(value) if numeric else None
    except (TypeError, ValueError, OverflowError):
        array = None
    if array is None or array.dtype.kind not in "iuf":
        raise ValueError(f"{name}={reprlib.repr(value)}: give {expected}.")
    return array


def _expected(
    shape: tuple[int | None, ...],
    unit: str,
    above: float,
    at_least: float,
    at_most: float,
) -> str:
    """What to give, in words: count, range and unit."""
    if not shape:
        words = ["a finite number"]
    elif shape[-1] is None:
        words = ["a list of finite numbers"]
    elif len(shape) == 1:
        words = [f"{shape[0]} finite numbers"]
    else:
        words = [f"a list of rows of {shape[-1]} finite numbers"]
    limits = {"above": above, "at least": at_least, "at most": at_most}
    stated = [f"{word} {end:g}" for word, end in limits.items() if math.isfinite(end)]
    if stated:
        words.append(" and ".join(stated))
    if unit:
        words.append(f"[{unit}]")
    return " ".join(words)
