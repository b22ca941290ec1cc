"""Trees of arrays: choosing between them, making them parameters or constants."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ._types import Array, ArrayLike, PyTree, is_concrete


def tree_where(condition: Array, yes, no):
    """One tree or the other, leaf by leaf."""
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), yes, no)


def as_array(value: ArrayLike) -> Array | np.ndarray:
    """NumPy's, of numbers and lists: JAX would compile programs to convert them."""
    made = isinstance(value, jax.Array) or not is_concrete(value)
    return jnp.asarray(value) if made else np.asarray(value)


def as_floats(value: ArrayLike) -> Array:
    """An array of floating-point numbers, none of them weakly typed."""
    array = as_array(value)
    if isinstance(array, np.ndarray):
        # NumPy would take nothing, and text, for numbers.
        array = array.astype(float, casting="same_kind")
    return jnp.asarray(array, float)


def as_parameters(tree: PyTree) -> PyTree:
    """NumPy's numbers are parameters, too. Weakly typed ones would compile anew."""

    def as_parameter(leaf: Any) -> Any:
        weak = isinstance(leaf, jax.Array) and leaf.weak_type
        if not weak and not isinstance(leaf, (np.ndarray, np.generic)):
            return leaf
        # As NumPy's arrays where they can be: JAX compiles a program to convert others.
        return jnp.asarray(np.asarray(leaf) if is_concrete(leaf) else leaf, leaf.dtype)

    return jax.tree.map(as_parameter, tree)


def constant(tree: PyTree) -> PyTree:
    """The tree with nothing of it that could be differentiated."""
    arrays, others = eqx.partition(tree, eqx.is_inexact_array)
    return eqx.combine(jax.lax.stop_gradient(arrays), others)


def is_differentiated(tree: PyTree) -> bool:
    """Whether a derivative by any of it is being taken, as far as can be seen.

    Inside `jax.jit` only transformations inside it are seen.
    """
    before = jax.tree.leaves(eqx.filter(tree, eqx.is_inexact_array))
    after = jax.lax.stop_gradient(before)
    return any(type(a) is not type(b) for a, b in zip(before, after, strict=True))
