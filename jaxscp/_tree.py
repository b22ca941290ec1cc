"""Choosing between trees of arrays."""

import jax
import jax.numpy as jnp

from ._types import Array


def tree_where(condition: Array, yes, no):
    """One tree or the other, leaf by leaf."""
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), yes, no)
