"""How the optimum moves with the parameters: the derivative rules of a solve.

At a solution w(p) of the optimality conditions F(w; p) = 0 (`_kkt`), where no constraint
is weakly active, the implicit function theorem gives

    K dw = -F_p dp,  K = F_w symmetric,

and as F is the gradient of the Lagrangian L, whose value is the objective J,

    dJ = L_w dw + L_p dp = L_p dp:

the envelope theorem: no system is solved. Both rules take the solution they are about
from `optimal_point`, so that differentiating them again is right, too. What needs K is
kept inside the solver of the linear system, and what F_p dp needs inside a checkpoint:
neither is evaluated for the sake of a field nobody differentiates.

Fiacco, "Introduction to Sensitivity and Stability Analysis in Nonlinear Programming",
1983, Theorem 3.2.1.
"""

import dataclasses
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree

from ._active_system import ActiveSystem, PerLimit
from ._damping import Damping
from ._kkt import KKTPoint, Optimum, conditions, lagrangian, totals
from ._max_norm import max_norm
from ._model import Model, exact_curvature
from ._transcription import Derivatives, Residuals, Transcription
from ._tree import constant
from ._types import Array, Float, Scalar

# What may be left of the linear system, relative to its right-hand side: less is asked
# for, more makes the answer worthless.
_PRECISION = 1e-11
_WORTHLESS = 1e-5


@eqx.filter_custom_jvp
def optimal_point(transcription: Transcription, optimum: Optimum) -> KKTPoint:
    """The solution; its derivatives are those of the implicit function theorem."""
    del transcription
    return optimum.point


@optimal_point.def_jvp
def _optimal_point_jvp(primals, tangents):
    transcription, optimum = primals
    point, left = _along(conditions, primals, tangents)
    # One vector: JAX transposes no system of which a part is known.
    flat, unravel = ravel_pytree(left)
    numbers = constant((transcription, optimum))

    def matrix(change: Float[Array, " w"]) -> Float[Array, " w"]:
        def at(point):
            return conditions(transcription, optimum, point)

        return ravel_pytree(jax.jvp(at, (point,), (unravel(change),))[1])[0]

    # Traced once for both directions.
    @jax.jit
    def solved(right: Float[Array, " w"]) -> Float[Array, " w"]:
        answer = kkt_solve(numbers[0], numbers[1], unravel(right))
        worthless = answer.left > _WORTHLESS
        return jnp.where(worthless, jnp.nan, ravel_pytree(answer.point)[0])

    moved = jax.lax.custom_linear_solve(
        matrix, -flat, lambda _, right: solved(right), symmetric=True
    )
    return point, _or_nan(optimum, optimum.physical(unravel(moved)))


@eqx.filter_custom_jvp
def optimal_objective(transcription: Transcription, optimum: Optimum) -> Scalar:
    """The objective; its derivatives are those of the envelope theorem."""
    del transcription
    return optimum.objective


@optimal_objective.def_jvp
def _optimal_objective_jvp(primals, tangents):
    _, optimum = primals
    _, change = _along(lagrangian, primals, tangents)
    change = optimum.scaling.objective * change
    return optimal_objective(*primals), _or_nan(optimum, change)


def optimal_totals(
    transcription: Transcription, optimum: Optimum, point: KKTPoint
) -> Float[Array, " q"]:
    """The integrals over the whole flight, at `optimal_point`."""
    return eqx.filter_checkpoint(totals)(transcription, optimum, point.step)


def _along(function, primals, tangents):
    """The solution, and how a function of the problem there changes along a direction.

    `None` in the direction stands for what does not change.
    """
    (transcription, optimum), (tangent, _) = primals, tangents
    point = optimal_point(transcription, optimum)
    moves = jax.tree.map(lambda t: t is not None, tangent, is_leaf=_is_none)
    arrays, others = eqx.partition(transcription, moves)

    @jax.checkpoint
    def of_arrays(arrays):
        return function(eqx.combine(arrays, others), optimum, point)

    return point, jax.jvp(of_arrays, (arrays,), (tangent,))[1]


def _is_none(leaf) -> bool:
    return leaf is None


def _or_nan(optimum: Optimum, tangent):
    """A point that does not meet the conditions has no derivatives."""
    # A factor, not a choice: that would be zero on the way back.
    factor = jnp.where(optimum.polished, 1.0, jnp.nan)
    return jax.tree.map(lambda leaf: factor * leaf, tangent)


class Answer(NamedTuple):
    """What solves K w = right.

    - `left`: what is left of the equations, relative to the right-hand side.
    - `convexity`: least curvature of the Lagrangian along dynamics and active limits. If
        it is positive, K has the inertia of a strict minimum; as active limits are held
        by squares of great but finite weight, a negative one leaves that open.
    """

    point: KKTPoint
    left: Scalar
    convexity: Scalar


def kkt_solve(transcription: Transcription, optimum: Optimum, right: KKTPoint) -> Answer:
    """The answer of K w = right, by the factorization that polishes."""
    size = max_norm(right)
    unit = jnp.where(size > 0.0, size, 1.0)
    right = jax.tree.map(lambda leaf: leaf / unit, right)
    root = jax.tree.map(jnp.sqrt, optimum.active)
    targets = jax.tree.map(lambda root, r: r / _or_one(root), root, right)
    system = _system(transcription, optimum, targets)
    nothing = jax.tree.map(jnp.zeros_like, optimum.sides)
    found = system.solved(nothing, jnp.asarray(_PRECISION))
    solution = found.solution
    of_limits = PerLimit.multipliers(solution).variables
    answer = KKTPoint(solution.step, solution.multipliers, of_limits)
    # Multipliers of what is not active answer for themselves.
    answer = jax.tree.map(
        lambda root, yes, no: unit * jnp.where(root > 0.0, yes / _or_one(root), -no),
        *(root, answer, right),
    )
    return Answer(answer, jnp.maximum(found.gap, found.left), found.convexity)


def _or_one(root: Array) -> Array:
    """To divide by."""
    return jnp.where(root > 0.0, root, 1.0)


def _system(
    transcription: Transcription, optimum: Optimum, right: KKTPoint
) -> ActiveSystem:
    """K and a right-hand side, as a step that rests on active constraints.

    The right-hand side has targets for the multipliers' rows.
    """
    scaling, substeps, sides = optimum.scaling, optimum.substeps, optimum.sides
    variables, multipliers = optimum.variables, optimum.point.multipliers
    residuals, derivatives = transcription.linearize(variables, substeps)
    curvature = exact_curvature(transcription, scaling, variables, substeps, multipliers)
    asked = right.multipliers
    wanted = Residuals(
        objective=jnp.zeros(()),
        defects=-asked.dynamics,
        path=-asked.path,
        between=-asked.between,
        increments=jnp.zeros_like(residuals.increments),
    )
    model = Model(wanted, _of_constraints(scaling.derivatives(derivatives)), curvature)
    no_metric = Damping.of(wanted, jax.tree.map(jnp.zeros_like, right.step))
    slope = jax.tree.map(jnp.negative, right.step)
    return ActiveSystem.of(model, no_metric, sides, right.limits, asked.integral, slope)


def _of_constraints(derivatives: Derivatives) -> Derivatives:
    """Without those of the cost."""
    rates = derivatives.intervals.increments
    silent = jax.tree.map(lambda block: block.at[:, -1].set(0.0), rates)
    nodes = dataclasses.replace(
        derivatives.nodes,
        terminal_state=jnp.zeros_like(derivatives.nodes.terminal_state),
        terminal_time=jnp.zeros_like(derivatives.nodes.terminal_time),
    )
    intervals = dataclasses.replace(derivatives.intervals, increments=silent)
    return Derivatives(intervals, nodes)
