"""`max_norm`: the size of many numbers."""

from typing import Any

import jax
import jax.numpy as jnp

from ._types import Scalar


def max_norm(tree: Any) -> Scalar:
    """Largest absolute value in a tree of arrays; 0 of nothing."""
    sizes = [jnp.max(jnp.abs(leaf), initial=0.0) for leaf in jax.tree.leaves(tree)]
    return jnp.max(jnp.stack(sizes))
