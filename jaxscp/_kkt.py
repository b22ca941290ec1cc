"""The optimality conditions of the discrete problem, as functions of its parameters.

With the active constraints known they are the equations F(w; p) = 0 of Karush, Kuhn and
Tucker, in the variables and multipliers w and the parameters p: F is the gradient by w of

    J + sum over active constraints (multiplier x distance from the limit)
      - 1/2 sum over the others (multiplier^2),

and its Jacobian by w therefore symmetric. The function is the Lagrangian where
multipliers of inactive constraints vanish.

A constraint that is soft (`_smoothing`), active by the share a, joins both: along the
solution's own F it obeys, with v for its multiplier as an unknown,

    sqrt(a) distance - (1 - a) v = 0,  d multiplier = sqrt(a) dv.
"""

import equinox as eqx
import jax
import jax.numpy as jnp

from ._active_set import resting, rooms
from ._per_constraint import PerConstraint
from ._per_limit import PerLimit
from ._scaling import Scaling
from ._subproblem import step_limits
from ._transcription import Residuals, Transcription, Variables
from ._types import Array, Float, Scalar


class KKTPoint(eqx.Module):
    """Variables and multipliers, scaled.

    - `step`: away from the variables of an [`Optimum`][].
    - `limits`: multipliers of the variables' limits, upper minus lower.
    """

    step: Variables
    multipliers: PerConstraint
    limits: Variables


def of_inequalities(point: KKTPoint) -> PerLimit:
    """A point's multipliers without the costates."""
    own = point.multipliers
    return PerLimit(point.limits, own.path, own.between, own.integral)


class Optimum(eqx.Module):
    """A point that meets the optimality conditions: numbers, nothing to differentiate.

    - `variables`: in physical units. `point`: with no step.
    - `sides`: where each constraint rests: 1 on its upper limit, -1 on its lower one,
        less where it is soft.
    - `objective`: in its own unit.
    - `polished`: whether the conditions hold well enough for derivatives.
    """

    variables: Variables
    point: KKTPoint
    scaling: Scaling
    substeps: Array
    sides: PerLimit
    objective: Scalar
    polished: Array

    @property
    def active(self) -> KKTPoint:
        """1 for each equation that is a constraint's or the Lagrangian's, else 0; its
        share where a constraint is soft.
        """
        share: PerLimit = jax.tree.map(jnp.abs, self.sides)
        ones = jax.tree.map(jnp.ones_like, self.point)
        own = PerConstraint(
            ones.multipliers.dynamics, share.path, share.between, share.integral
        )
        return KKTPoint(ones.step, own, share.variables)

    @property
    def roots(self) -> KKTPoint:
        """What variables and multipliers change by with the unknowns."""
        return jax.tree.map(jnp.sqrt, self.active)


def lagrangian(transcription: Transcription, optimum: Optimum, at: KKTPoint) -> Scalar:
    """The Lagrangian of the active constraints, scaled."""
    multipliers = jax.tree.map(
        lambda active, own: jnp.where(active > 0.0, own, 0.0), optimum.active, at
    )
    objective, distances = _distances(transcription, optimum, at.step)
    products = jax.tree.map(
        jnp.vdot, (multipliers.multipliers, multipliers.limits), distances
    )
    return objective + sum(jax.tree.leaves(products))


def conditions(transcription: Transcription, optimum: Optimum, at: KKTPoint) -> KKTPoint:
    """What is left of the equations F where the unknowns are those of a point."""
    return jax.grad(lambda at: potential(transcription, optimum, at))(at)


def potential(transcription: Transcription, optimum: Optimum, at: KKTPoint) -> Scalar:
    """The function whose gradient is F."""
    active, own = optimum.active, optimum.point
    # The equations of the variables are all active.
    idle = jax.tree.map(lambda a, own: jnp.sum((1.0 - a) * own**2), active, at)
    there = jax.tree.map(
        lambda root, own, at: own + root * (at - own), optimum.roots, own, at
    )
    squares = 0.5 * sum(jax.tree.leaves(idle))
    return lagrangian(transcription, optimum, there) - squares


def objective(transcription: Transcription, optimum: Optimum, step: Variables) -> Scalar:
    """The cost, in its own unit."""
    return _residuals(transcription, optimum, step).objective * optimum.scaling.objective


def totals(
    transcription: Transcription, optimum: Optimum, step: Variables
) -> Float[Array, " q"]:
    """The integrals, in their own units."""
    return _residuals(transcription, optimum, step).totals * optimum.scaling.integral


def slacks(
    transcription: Transcription, optimum: Optimum, step: Variables
) -> tuple[PerLimit, PerLimit]:
    """The way to every lower and to every upper limit, infinite where there is none."""
    residuals = _residuals(transcription, optimum, step)
    limits = step_limits(transcription, optimum.scaling, optimum.variables)
    return rooms(residuals, limits, step)


def _residuals(
    transcription: Transcription, optimum: Optimum, step: Variables
) -> Residuals:
    variables = optimum.scaling.move(optimum.variables, step)
    found = transcription.evaluate(variables, optimum.substeps, reversible=True)
    return optimum.scaling.residuals(found)


def _distances(
    transcription: Transcription, optimum: Optimum, step: Variables
) -> tuple[Scalar, tuple[PerConstraint, Variables]]:
    """The objective, and how far each constraint is from where it rests."""
    sides, scaling = optimum.sides, optimum.scaling
    residuals = _residuals(transcription, optimum, step)
    limits = step_limits(transcription, scaling, optimum.variables)
    rests = jax.tree.map(resting, sides.variables, *limits.ends)
    integral = residuals.totals - resting(sides.integral, *limits.integral)
    constraints = PerConstraint(
        residuals.defects,
        residuals.path,
        # Peaks of what has no limit are infinitely low.
        jnp.where(sides.between > 0.0, residuals.between, 0.0),
        integral,
    )
    return residuals.objective, (constraints, jax.tree.map(jnp.subtract, step, rests))
