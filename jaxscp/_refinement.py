"""`Refinement`: how far the passes that refine a step have come."""

import equinox as eqx
import jax.numpy as jnp

from ._per_limit import PerLimit
from ._transcription import Variables
from ._types import Array, Float, Scalar

# Each pass leaves about a thousandth of the gap, more where a constraint hardly gives
# way. Where it no longer falls after a few, rounding is all that is left.
_PASSES = 32
_FEW = 4


class Refinement(eqx.Module):
    """How far the refinement of a step has come.

    - `pushes`: multipliers of what is pulled. `gap`: how far that is from its limits.
        `falls`: whether the last pass has made it smaller.
    """

    step: Variables
    costates: Float[Array, "I n"]
    pushes: PerLimit
    gap: Scalar
    falls: Array
    count: Array

    @classmethod
    def begun(
        cls, step: Variables, costates: Float[Array, "I n"], pushes: PerLimit
    ) -> "Refinement":
        """Before the first one."""
        gap, falls, count = jnp.asarray(jnp.inf), jnp.asarray(True), jnp.zeros((), int)
        return cls(step, costates, pushes, gap, falls, count)

    def unfinished(self, closed: Scalar) -> Array:
        """Whether another pass is worth it; gaps below `closed` are closed."""
        promising = (self.count < _FEW) | self.falls
        more = (self.gap > closed) & (self.count < _PASSES) & promising
        return (self.count < 2) | more
