"""How far a point is from satisfying the discrete problem's optimality conditions."""

import equinox as eqx
import jax
import jax.numpy as jnp

from ._constraints import integral_limits, worst_violation
from ._max_norm import max_norm
from ._model import cost_gradient, linear_prediction
from ._scaling import Scaling
from ._state import Iterate
from ._subproblem import SubproblemSolution, step_limits
from ._transcription import Transcription, Variables
from ._types import Array, Scalar


class Optimality(eqx.Module):
    """Residuals of the Karush-Kuhn-Tucker conditions, scaled, largest entry of each.

    - `stationarity`: of the Lagrangian's gradient by everything that is not fixed.
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
    slack = step_limits(transcription, scaling, iterate.variables)
    totals = residuals.totals
    products = [
        _products(solution.state, *slack.state),
        _products(solution.control, *slack.control),
        _products(solution.final_time[None], *slack.time),
        _products(multipliers.integral, limits[0] - totals, limits[1] - totals),
        _times(multipliers.path, residuals.path),
        _times(multipliers.between, residuals.between),
    ]
    return Optimality(
        stationarity=max_norm(lagrangian_gradient(transcription, iterate, solution)),
        feasibility=worst_violation(residuals, limits),
        complementarity=max_norm(products),
    )


def lagrangian_gradient(
    transcription: Transcription, iterate: Iterate, solution: SubproblemSolution
) -> Variables:
    """The Lagrangian's gradient; zero by variables that are fixed.

    The multiplier of a fixed variable can be anything: whatever makes it vanish.
    """
    still = jax.tree.map(jnp.zeros_like, solution.step)

    def constraints(step: Variables):
        after = linear_prediction(iterate.residuals, iterate.derivatives, step)
        return after.defects, after.path, after.between, after.totals

    _, pull_back = jax.vjp(constraints, still)
    own = solution.multipliers
    (pulled,) = pull_back((own.dynamics, own.path, own.between, own.integral))
    of_limits = Variables(solution.state, solution.control, solution.final_time)
    slope = cost_gradient(iterate.derivatives)
    whole = jax.tree.map(lambda a, b, c: a + b + c, slope, pulled, of_limits)
    problem = transcription.problem
    return Variables(
        jnp.where(transcription.fixed_states, 0.0, whole.states),
        jnp.where(problem.control.is_fixed[None], 0.0, whole.controls),
        jnp.where(problem.final_time.is_fixed, 0.0, whole.final_time),
    )


def _products(multiplier: Array, below: Array, above: Array) -> Array:
    """Multipliers times the way to their limits: upper ones are positive."""
    return _times(multiplier, jnp.where(multiplier > 0.0, above, below))


def _times(multiplier: Array, way: Array) -> Array:
    # An infinite limit is no limit, whatever trace of a multiplier it has.
    return jnp.abs(jnp.where(jnp.isfinite(way), multiplier * way, 0.0))
