"""The moves every SCP method makes: start, linearize, try, judge, advance."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp

from ._constraints import integral_limits, largest_buffer, violations
from ._discretization import Discretization
from ._merit import AbstractMerit, ExactPenalty
from ._scaling import Scaling, automatic_scaling
from ._state import History, Iterate, Judgement, Reach, SCPState, Trial
from ._subproblem import SubproblemSolution
from ._transcription import Transcription, Variables
from ._tree import tree_where
from ._types import Array, Scalar

# Between one linearization and the next the substeps change at most so much: a wild
# first step would otherwise ask for hundreds.
_MOST_GROWTH = 4.0
# The integration error of a scaled cost below the first counts for as much more as the
# cost is smaller than that, at most for one over the second.
_SMALL_COST, _LEAST_SHARE = 0.1, 0.01
# So often too few, and never again fewer.
_MOST_RAISED = 3


def linearized(
    transcription: Transcription, scaling: Scaling, iterate: Iterate
) -> Iterate:
    """The same point with fresh derivatives."""

    def renew() -> Iterate:
        residuals, derivatives = transcription.linearize(
            iterate.variables, iterate.substeps
        )
        return dataclasses.replace(
            iterate,
            residuals=scaling.residuals(residuals),
            derivatives=scaling.derivatives(derivatives),
            fresh=jnp.array(True),
        )

    return jax.lax.cond(iterate.fresh, lambda: iterate, renew)


def is_finite(iterate: Iterate) -> Array:
    """Whether every value and derivative at a point is finite."""
    # Where there is no limit, its peak is infinitely low.
    peaks = iterate.residuals.between
    peaks = jnp.where(jnp.isneginf(peaks), 0.0, peaks)
    # How wrong they are may be unknown: more steps are taken then.
    known = jnp.zeros(())
    tree = eqx.tree_at(
        lambda at: (at.residuals.between, at.integration_error), iterate, (peaks, known)
    )
    leaves = jax.tree.leaves(eqx.filter(tree, eqx.is_inexact_array))
    return jnp.all(jnp.stack([jnp.all(jnp.isfinite(leaf)) for leaf in leaves]))


def start(
    transcription: Transcription,
    guess: Variables,
    nothing: SubproblemSolution,
    again: bool | Array = False,
    *,
    radius: float,
    ceiling: float,
    records: int,
) -> SCPState:
    """The state before the first subproblem."""
    substeps = jnp.asarray(transcription.discretization.least_substeps)
    # The first step linearizes; until then there is only the room for it.
    residuals, derivatives = jax.tree.map(
        lambda leaf: jnp.zeros(leaf.shape),
        jax.eval_shape(transcription.linearize, guess, substeps),
    )
    zero = jnp.zeros((), int)
    iterate = Iterate(
        variables=guess,
        residuals=residuals,
        derivatives=derivatives,
        fresh=jnp.array(False),
        substeps=substeps,
        raised=zero,
        integration_error=jnp.zeros(()),
    )
    return SCPState(
        iterate=iterate,
        scaling=automatic_scaling(transcription, guess, again),
        solution=nothing,
        merit=ExactPenalty(nothing.multipliers),
        ceiling=jnp.asarray(ceiling),
        radius=jnp.asarray(radius),
        reach=Reach(jnp.asarray(jnp.inf), jnp.asarray(1.0 / radius)),
        own=jnp.array(False),
        history=History.empty(records),
        records=zero,
        iterations=zero,
        polish=zero,
        subproblems=zero,
        qp_iterations=zero,
        qp_seconds=jnp.zeros(()),
        stationary=jnp.array(False),
        failures=zero,
        optimality=jnp.asarray(jnp.inf),
        near=jnp.array(False),
        finite=jnp.array(True),
    )


def try_step(
    transcription: Transcription,
    scaling: Scaling,
    iterate: Iterate,
    solution: SubproblemSolution,
    merit: AbstractMerit,
) -> Trial:
    """Evaluate the discrete problem where a subproblem's step leads."""
    variables = scaling.move(iterate.variables, solution.step)
    # Once with the steps in force and once with half as many, or twice one: as the
    # method is of order four, their difference tells the error.
    steps = iterate.substeps
    others = jnp.where(steps > 1, (steps + 1) // 2, 2)
    both = jax.vmap(transcription.evaluate, in_axes=(None, 0))(
        variables, jnp.stack([steps, others])
    )
    residuals = scaling.residuals(jax.tree.map(lambda leaf: leaf[0], both))
    rough = scaling.residuals(jax.tree.map(lambda leaf: leaf[1], both))
    totals = jnp.sum(jnp.abs(residuals.increments - rough.increments), axis=0)
    # A cost that is small beside its scale is to be as exact as one that is not.
    share = jnp.clip(jnp.abs(residuals.objective) / _SMALL_COST, _LEAST_SHARE, 1.0)
    difference = jnp.maximum(
        jnp.max(jnp.abs(residuals.defects - rough.defects)),
        jnp.max(totals.at[-1].divide(share)),
    )
    error = difference / jnp.abs((steps / others) ** 4 - 1.0)
    # Longer steps may leave a function's domain where shorter ones do not.
    error = jnp.where(jnp.isnan(error), jnp.inf, error)
    limits = integral_limits(transcription, scaling)
    cost = merit.cost(residuals, limits)
    # A step into a singularity is a bad step, not a broken solve.
    cost = jnp.where(jnp.isnan(cost), jnp.inf, cost)
    return Trial(solution, variables, residuals, cost, error)


def _needed_substeps(settings: Discretization, at: Iterate, error: Scalar) -> Array:
    """As many as keep the local error within its tolerance, for a method of order 4."""
    factor = 1.1 * (error / settings.tolerance) ** 0.25
    # Fewer only if it is far fewer: the penalized cost changes with them, a little. And
    # not for ever: of stiff dynamics a few less may be far too few.
    kept = (factor > 0.5) | (at.raised >= _MOST_RAISED)
    factor = jnp.where((factor < 1.0) & kept, 1.0, factor)
    factor = jnp.where(error > settings.tolerance, jnp.maximum(factor, 1.0), factor)
    factor = jnp.clip(factor, 1.0 / _MOST_GROWTH, _MOST_GROWTH)
    wanted = jnp.ceil(at.substeps * factor).astype(at.substeps.dtype)
    return jnp.clip(wanted, settings.least_substeps, settings.max_substeps)


def judge(
    reference: Scalar, predicted: Scalar, trial: Trial, accept_ratio: float
) -> Judgement:
    """Compare the reduction of the penalized cost with the predicted one."""
    actual = reference - trial.cost
    # At a stationary point both are rounding errors, and their quotient means nothing.
    noise = 1e-13 * jnp.abs(reference)
    meaningful = predicted > noise
    ratio = jnp.where(meaningful, actual / jnp.where(meaningful, predicted, 1.0), 1.0)
    ratio = jnp.where(trial.solution.effort.solved, ratio, -jnp.inf)
    accepted = ratio >= accept_ratio
    return Judgement(reference, predicted, actual, ratio, accepted)


def advance(
    transcription: Transcription,
    state: SCPState,
    trial: Trial,
    judgement: Judgement,
    *,
    merit: AbstractMerit,
    ceiling: Scalar,
    radius: Scalar,
    stationary: Array,
    iterations: Array,
    polish: Array,
    near: Array,
    reach: Reach,
    own: Array,
) -> SCPState:
    """Take the step if it was accepted, and write it down either way.

    The keyword arguments are the fields of the state that each method decides itself.
    """
    accepted, old = judgement.accepted, state.iterate
    error = trial.integration_error
    substeps = _needed_substeps(transcription.discretization, old, error)
    moved = Iterate(
        variables=trial.variables,
        residuals=trial.residuals,
        derivatives=old.derivatives,
        fresh=jnp.array(False),
        substeps=substeps,
        raised=old.raised + (substeps > old.substeps),
        integration_error=error,
    )
    iterate = tree_where(accepted, moved, old)
    limits = integral_limits(transcription, state.scaling)
    broken = violations(trial.residuals, limits)
    effort = trial.solution.effort
    history = state.history.write(
        state.records,
        objective=trial.residuals.objective * state.scaling.objective,
        penalized_cost=judgement.reference,
        predicted_reduction=judgement.predicted,
        actual_reduction=judgement.actual,
        ratio=judgement.ratio,
        radius=state.radius,
        defect=jnp.max(broken.dynamics),
        buffer=largest_buffer(broken),
        accepted=accepted.astype(float),
    )
    return dataclasses.replace(
        state,
        iterate=iterate,
        solution=trial.solution,
        merit=merit,
        ceiling=ceiling,
        radius=radius,
        history=history,
        records=state.records + 1,
        iterations=iterations,
        polish=polish,
        near=near,
        reach=reach,
        own=own,
        subproblems=state.subproblems + effort.solves,
        qp_iterations=state.qp_iterations + effort.iterations,
        qp_seconds=state.qp_seconds + effort.seconds,
        stationary=stationary,
        failures=jnp.where(effort.solved, 0, state.failures + 1),
    )
