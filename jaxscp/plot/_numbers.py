"""Checks of numbers that are handed in to be drawn."""

import numpy as np

from .._types import ArrayLike


def finite(name: str, value: ArrayLike, shape: tuple[int, ...]) -> np.ndarray:
    """`value` as an array of floats.

    **Raises:** `ValueError` naming it unless it has the shape and is finite.
    """
    array = np.asarray(value, float)
    if array.shape != shape:
        raise ValueError(f"{name} has shape {array.shape}: give shape {shape}.")
    if not np.isfinite(array).all():
        at = tuple(np.argwhere(~np.isfinite(array))[0])
        place = "".join(f"[{index}]" for index in at)
        raise ValueError(f"{name}{place}={array[at]}: leave out what is not finite.")
    return array


def rising(name: str, value: ArrayLike) -> np.ndarray:
    """`value` as a vector of at least two floats that rise strictly.

    **Raises:** `ValueError` naming it, and the entry where it does not.
    """
    array = finite(name, value, (np.size(value),))
    if array.size < 2:
        raise ValueError(f"{name} has {array.size} entries: give at least 2.")
    stuck = np.diff(array) <= 0.0
    if stuck.any():
        at = int(np.argmax(stuck))
        raise ValueError(
            f"{name}[{at + 1}]={array[at + 1]:g} follows {array[at]:g}: sort them and "
            "drop repeated ones."
        )
    return array
