"""How far a point is from satisfying the discrete problem's optimality conditions."""

import equinox as eqx
import jax
import jax.numpy as jnp

from ._model import cost_gradient, integral_limits, linear_prediction, worst_violation
from ._scaling import Scaling
from ._state import Iterate
from ._subproblem import SubproblemSolution, step_limits
from ._transcription import Transcription, Variables, held
from ._types import Array, Scalar


class Optimality(eqx.Module):
    """Residuals of the Karush-Kuhn-Tucker conditions, scaled, largest entry of each.

    - `stationarity`: of the Lagrangian's gradient.
    - `feasibility`: of the constraints.
    - `complementarity`: of the products of multipliers and slacks.
    """

    stationarity: Scalar
    feasibility: Scalar
    complementarity: Scalar

    @property
    def residual(self) -> Scalar:
        """The largest of all."""
        dual = jnp.maximum(self.stationarity, self.complementarity)
        return jnp.maximum(dual, self.feasibility)


def optimality(
    transcription: Transcription,
    scaling: Scaling,
    iterate: Iterate,
    solution: SubproblemSolution,
) -> Optimality:
    """Residuals at a point with fresh derivatives, with a subproblem's multipliers."""
    limits = integral_limits(transcription, scaling)
    multipliers, residuals = solution.multipliers, iterate.residuals
    gradient = _lagrangian_gradient(iterate, solution)
    slack = step_limits(transcription, scaling, iterate.variables)
    totals = residuals.totals
    products = [
        _products(solution.state, *slack.state),
        _products(solution.control, *slack.control),
        _products(solution.final_time[None], *slack.time),
        _products(multipliers.integral, limits[0] - totals, limits[1] - totals),
        jnp.abs(multipliers.path * residuals.path),
    ]
    return Optimality(
        stationarity=_largest(jax.tree.leaves(gradient)),
        feasibility=worst_violation(residuals, limits),
        complementarity=_largest(products),
    )


def _lagrangian_gradient(iterate: Iterate, solution: SubproblemSolution) -> Variables:
    still = jax.tree.map(jnp.zeros_like, solution.step)

    def constraints(step: Variables):
        controls = held(step.controls, step.states.shape[0])
        after = linear_prediction(iterate.residuals, iterate.derivatives, step, controls)
        return after.defects, after.path, after.totals

    _, pull_back = jax.vjp(constraints, still)
    own = solution.multipliers
    (pulled,) = pull_back((own.dynamics, own.path, own.integral))
    of_limits = Variables(solution.state, solution.control, solution.final_time)
    slope = cost_gradient(iterate.derivatives)
    return jax.tree.map(lambda a, b, c: a + b + c, slope, pulled, of_limits)


def _products(multiplier: Array, below: Array, above: Array) -> Array:
    """Multipliers times the way to their limits: upper ones are positive."""
    way = jnp.where(multiplier > 0.0, above, below)
    # An infinite limit is no limit, whatever trace of a multiplier it has.
    return jnp.abs(jnp.where(jnp.isfinite(way), multiplier * way, 0.0))


def _largest(parts: list[Array]) -> Scalar:
    return jnp.max(jnp.stack([jnp.max(jnp.abs(part), initial=0.0) for part in parts]))
