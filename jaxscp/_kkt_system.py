"""The linear system of the optimality conditions, solved as polishing solves it."""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp

from ._active_system import ActiveSystem
from ._damping import Damping
from ._kkt import KKTPoint, Optimum
from ._max_norm import max_norm
from ._model import Model, exact_curvature
from ._per_limit import PerLimit
from ._transcription import Derivatives, Residuals, Transcription
from ._types import Array, Scalar

# What may be left of it, relative to its right-hand side.
_PRECISION = 1e-11


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
    roots = optimum.roots
    targets = jax.tree.map(lambda root, r: r / _or_one(root), roots, right)
    system = _system(transcription, optimum, targets)
    nothing = jax.tree.map(jnp.zeros_like, optimum.sides)
    found = system.solved(nothing, jnp.asarray(_PRECISION))
    solution = found.solution
    of_limits = PerLimit.multipliers(solution).variables
    answer = KKTPoint(solution.step, solution.multipliers, of_limits)
    # Multipliers of what is not active answer for themselves.
    answer = jax.tree.map(
        lambda root, yes, no: unit * jnp.where(root > 0.0, yes / _or_one(root), -no),
        *(roots, answer, right),
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
