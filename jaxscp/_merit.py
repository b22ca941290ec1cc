"""Merit functions: one number for a point's cost and for what it violates."""

import abc

import equinox as eqx
import jax
import jax.numpy as jnp

from ._constraints import violations
from ._per_constraint import PerConstraint
from ._transcription import Residuals
from ._types import Array, Float, Scalar


class AbstractMerit(eqx.Module):
    """What a step ought to reduce."""

    @abc.abstractmethod
    def cost(
        self,
        residuals: Residuals,
        limits: tuple[Float[Array, " q"], Float[Array, " q"]],
    ) -> Scalar:
        """Of a point with these scaled residuals.

        **Arguments:**

        - `limits`: of the integrals.
        """

    @abc.abstractmethod
    def following(self, multipliers: PerConstraint, ceiling: Scalar) -> "AbstractMerit":
        """The merit once a subproblem has told its multipliers.

        **Arguments:**

        - `ceiling`: price of virtual variables.
        """


class ExactPenalty(AbstractMerit):
    """Cost plus the weighted L1 norm of all violations.

    - `weights`: never negative.
    """

    weights: PerConstraint

    def cost(
        self,
        residuals: Residuals,
        limits: tuple[Float[Array, " q"], Float[Array, " q"]],
    ) -> Scalar:
        broken = violations(residuals, limits)
        terms = jax.tree.map(jnp.vdot, self.weights, broken)
        charged = terms.dynamics + terms.path + terms.between + terms.integral
        return residuals.objective + charged

    def following(self, multipliers: PerConstraint, ceiling: Scalar) -> "ExactPenalty":
        """Weights just above the multipliers, falling only by halves.

        Powell's rule. Weights far above the multipliers make the merit's valley narrow,
        and the steps short; an entry whose multiplier happens to vanish keeps a share of
        the mean, or its defect would be free.
        """

        def follow(weight: Array, multiplier: Array) -> Array:
            if not weight.size:
                return weight
            wanted = 1.1 * jnp.abs(multiplier)
            least = 0.1 * jnp.mean(jnp.abs(multiplier))
            kept = jnp.maximum(wanted, 0.5 * (weight + wanted))
            return jnp.clip(kept, least, 10.0 * ceiling)

        return ExactPenalty(jax.tree.map(follow, self.weights, multipliers))
