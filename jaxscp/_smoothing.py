"""Smoothed derivatives: limits that hold a little before they are active.

At a solution the multiplier and the slack of a limit are the root of a function that is
not smooth where both vanish. Chen, Harker, Kanzow and Smale smooth it:

    multiplier + slack - sqrt((multiplier - slack)^2 + 4 tau) = 0,

which is `multiplier x slack = tau` with both positive. Linearized at the solution it ties
the change of a multiplier to that of its slack by the ratio a : (1 - a), where a is the
share by which the limit counts as active: one half where it is weakly active, close to
one or to zero elsewhere. Kanzow, SIAM Journal on Matrix Analysis and Applications 17
(1996).
"""

import math

import equinox as eqx
import jax
import jax.numpy as jnp

from ._kkt import Optimum, of_inequalities, slacks
from ._regularity import by_side, fixed_limits
from ._transcription import Transcription
from ._types import Array, Scalar, is_concrete


def check_smoothing(smoothing: float | Array) -> None:
    """**Raises:** `ValueError` for what is no product of multiplier and slack."""
    if not is_concrete(smoothing):
        return
    if jnp.shape(smoothing) or not 0.0 <= smoothing < math.inf:
        raise ValueError(
            f"smoothing={smoothing}: give 0 for none, about 1e-6 for little."
        )


def softened(transcription: Transcription, optimum: Optimum, tau: Scalar) -> Optimum:
    """An optimum whose limits are active by shares.

    **Arguments:**

    - `tau`: product of a scaled multiplier and a scaled slack that counts as none. Of
        two limits of one quantity only the one that counts more is kept.
    """
    multipliers = by_side(of_inequalities(optimum.point))
    ways = slacks(transcription, optimum, optimum.point.step)
    low, high = (
        jax.tree.map(lambda own, way: _share(own, way, tau), *each)
        for each in zip(multipliers, ways, strict=True)
    )
    sides = jax.tree.map(
        lambda fixed, side, low, high: jnp.where(
            fixed > 0.0, side, jnp.where(high >= low, high, -low)
        ),
        *(fixed_limits(transcription), optimum.sides, low, high),
    )
    return eqx.tree_at(lambda o: o.sides, optimum, sides)


def _share(multiplier: Array, slack: Array, tau: Scalar) -> Array:
    """By how much a limit counts as active."""
    lead = multiplier - jnp.maximum(slack, 0.0)
    limited = jnp.isfinite(lead)
    lead = jnp.where(limited, lead, 0.0)
    size = jnp.sqrt(lead**2 + 4.0 * tau)
    # Nothing: a weakly active limit, not smoothed.
    share = 0.5 * (1.0 + lead / jnp.where(size > 0.0, size, 1.0))
    return jnp.where(limited, share, 0.0)
