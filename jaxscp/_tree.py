"""Trees of arrays: choosing between them, and holding them constant."""

import equinox as eqx
import jax
import jax.numpy as jnp

from ._types import Array, PyTree


def tree_where(condition: Array, yes, no):
    """One tree or the other, leaf by leaf."""
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), yes, no)


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
