"""Weights of the exact penalty, from the multipliers."""

import jax
import jax.numpy as jnp

from ._per_constraint import PerConstraint
from ._types import Array, Scalar


def following(
    weights: PerConstraint, multipliers: PerConstraint, ceiling: Scalar
) -> PerConstraint:
    """Penalty weights just above the multipliers, falling only by halves.

    Powell's rule. Weights far above the multipliers make the merit's valley narrow, and
    the steps short; an entry whose multiplier happens to vanish keeps a share of the
    mean, or its defect would be free.
    """

    def follow(weight: Array, multiplier: Array) -> Array:
        if not weight.size:
            return weight
        wanted = 1.1 * jnp.abs(multiplier)
        least = 0.1 * jnp.mean(jnp.abs(multiplier))
        kept = jnp.maximum(wanted, 0.5 * (weight + wanted))
        return jnp.clip(kept, least, 10.0 * ceiling)

    return jax.tree.map(follow, weights, multipliers)
