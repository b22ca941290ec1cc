"""When a method takes Newton's steps, and how long they may be."""

import equinox as eqx
import jax.numpy as jnp

from ._optimality import Optimality
from ._scp import AbstractSCP
from ._state import SCPState
from ._types import Array, Scalar, check_count


class AbstractNewtonSCP(AbstractSCP):
    """A method that takes steps with all of the Lagrangian's curvature, convex or not,
    where its multipliers are good enough.

    Its settings are those of [`ProximalSCP`][].
    """

    max_polish: eqx.AbstractVar[int]
    curvature: eqx.AbstractVar[str]
    close: eqx.AbstractVar[float]
    near: eqx.AbstractVar[float]
    far: eqx.AbstractVar[float]
    longest: eqx.AbstractVar[float]

    def __check_init__(self):
        if self.curvature not in ("all", "nodes", "cost"):
            raise ValueError(
                f"curvature={self.curvature!r}: choose 'all', 'nodes' or 'cost'."
            )
        check_count("max_polish", self.max_polish, 0)

    def is_near(self, state: SCPState, gap: Optimality) -> Array:
        """Whether Newton's method may be trusted without a merit function.

        Once it is, also a little farther away: a long step along directions that the
        cost hardly sees is worth the steps that take its side effects back.
        """
        limit = jnp.where(state.near, self.far, self.near)
        small = (gap.stationarity <= limit) & (gap.feasibility <= 10.0 * limit)
        return small & self.trusts_newton(state)

    def is_sound(self, state: SCPState) -> Array:
        """Whether the multipliers are good for the dynamics' curvature.

        Not those of virtual control, nor those of a subproblem that failed.
        """
        sound = ~state.solution.effort.relaxed & (state.failures == 0)
        return sound & (self.curvature == "all")

    def may_polish(self, state: SCPState) -> Array:
        """Whether any of Newton's steps are left, and wanted."""
        return (state.polish < self.max_polish) & (self.curvature == "all")

    def trusts_newton(self, state: SCPState) -> Array:
        """Whether the next step is tried with all of the curvature, convex or not.

        Not with the multipliers of a step that was refused.
        """
        ready = self.is_sound(state) & self.may_polish(state)
        return ready & (state.near | state.own) & (state.optimality < self.close)

    def longest_step(self, state: SCPState) -> Scalar:
        """How long Newton's next step may be."""
        return jnp.minimum(state.reach.length, self.longest)
