"""A distance that can be differentiated everywhere."""

import jax.numpy as jnp

from .._types import Array

# The length [m] below which a distance is rounded off. Far below anything a vehicle
# resolves (at 10 m it adds 5e-8 m), far above where squares of it would be lost in
# double precision.
SMOOTHING_LENGTH = 1e-3


def smooth_norm(*components: Array) -> Array:
    """Euclidean norm with a rounded tip, sqrt(sum c^2 + SMOOTHING_LENGTH^2).

    The exact norm has a kink where all components vanish: its derivative there is 0/0.
    Rounding off the argument of the root keeps every derivative finite, without the
    case distinction whose second derivative would again be wrong at that point.
    """
    squares = [component * component for component in components]
    return jnp.sqrt(sum(squares) + SMOOTHING_LENGTH**2)
