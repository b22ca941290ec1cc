"""The last iterate of a solve as a `Solution`: named, and in physical units."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp

from ._active_set import active_sides
from ._attempt import Attempt
from ._constraints import integral_limits, violations, worst_violation
from ._diagnosis import Violations
from ._kkt import KKTPoint, Optimum
from ._packed import Packed
from ._per_constraint import PerConstraint
from ._scaling import Scaling
from ._sensitivity import optimal_objective, optimal_point, optimal_totals
from ._smoothing import softened
from ._solution import Multipliers, Solution, Statistics
from ._state import SCPState
from ._status import Status
from ._subproblem import step_limits
from ._transcription import Transcription, Variables
from ._tree import constant
from ._types import Array, Float, Scalar

# Multipliers and gaps of which neither says whether a constraint is active.
_NEGLIGIBLE = 1e-10


def outcome(transcription: Transcription, state: SCPState, status: Status) -> Solution:
    """What the state holds, with the status it ended in."""
    scaling, iterate = state.scaling, state.iterate
    reached = _optimum(transcription, state, status)
    totals = iterate.residuals.totals * scaling.integral
    limits = integral_limits(transcription, scaling)
    missed = worst_violation(iterate.residuals, limits)
    return Solution(
        packed_problem=Packed.of(transcription.problem),
        discretization=transcription.discretization,
        trajectory=transcription.trajectory(iterate.variables),
        objective=reached.objective,
        integrals=_by_integral(transcription, totals),
        multipliers=_multipliers(transcription, scaling, reached.point),
        violations=_violations(transcription, state),
        status=status,
        optimality=state.optimality,
        history=state.history,
        statistics=Statistics(
            iterations=state.iterations,
            polish_iterations=state.polish,
            subproblems=state.subproblems,
            qp_iterations=state.qp_iterations,
            substeps=iterate.substeps,
            integration_error=iterate.integration_error,
            qp_seconds=state.qp_seconds,
            seconds=jnp.asarray(jnp.nan),
        ),
        attempts=(Attempt(reached.objective, missed, status, None, jnp.asarray(True)),),
        packed_transcription=Packed.of(transcription),
        optimum=reached,
    )


def _violations(transcription: Transcription, state: SCPState) -> Violations:
    scaling = state.scaling
    limits = integral_limits(transcription, scaling)
    broken = violations(state.iterate.residuals, limits)
    physical = PerConstraint(
        dynamics=state.iterate.residuals.defects * scaling.state[None],
        path=broken.path * scaling.path[None],
        between=broken.between * scaling.between[None],
        integral=broken.integral * scaling.integral,
    )
    lower, upper, path = _by_interval(transcription, physical.between, jnp.max)
    return Violations(
        dynamics=physical.dynamics,
        path_constraints=_by_name(transcription, physical.path),
        integrals=_by_integral(transcription, physical.integral),
        state_between=jnp.maximum(lower, upper),
        path_between=_by_name(transcription, path),
        scales=(
            scaling.state,
            _by_name(transcription, scaling.path),
            _by_integral(transcription, scaling.integral),
        ),
    )


def _optimum(transcription: Transcription, state: SCPState, status: Status) -> Optimum:
    """What derivatives of the outcome need."""
    scaling, iterate, solution = state.scaling, state.iterate, state.solution
    limits = step_limits(transcription, scaling, iterate.variables)
    still = jax.tree.map(jnp.zeros_like, solution.step)
    of_limits = Variables(solution.state, solution.control, solution.final_time)
    point = KKTPoint(still, solution.multipliers, of_limits)
    sides = active_sides(iterate.residuals, limits, solution, still, _NEGLIGIBLE)
    return Optimum(
        variables=iterate.variables,
        point=point,
        scaling=scaling,
        substeps=iterate.substeps,
        sides=sides,
        objective=iterate.residuals.objective * scaling.objective,
        polished=jnp.asarray(status == Status.converged),
    )


@eqx.filter_jit
def differentiable(
    transcription: Transcription, solution: Solution, smoothing: Scalar | None = None
) -> Solution:
    """The solution as a function of the problem: objective, integrals, trajectory and
    multipliers move with it. All else is what it was.
    """
    optimum = solution.optimum
    if smoothing is not None:
        optimum = softened(*constant((transcription, optimum, smoothing)))
    return moved(transcription, solution, optimal_point(transcription, optimum))


def moved(transcription: Transcription, solution: Solution, point: KKTPoint) -> Solution:
    """The solution where the optimality conditions have led to this point."""
    found = solution.optimum
    variables = found.scaling.move(found.variables, point.step)
    totals = optimal_totals(transcription, found, point)
    return dataclasses.replace(
        solution,
        packed_problem=Packed.of(transcription.problem),
        trajectory=transcription.trajectory(variables),
        objective=optimal_objective(transcription, found),
        integrals=_by_integral(transcription, totals),
        multipliers=_multipliers(transcription, found.scaling, point),
    )


def _multipliers(
    transcription: Transcription, scaling: Scaling, point: KKTPoint
) -> Multipliers:
    size, limits = scaling.objective, point.limits
    physical = scaling.physical(point.multipliers)
    missing = transcription.nodes - transcription.control_nodes
    control: Float[Array, "N m"] = jnp.pad(limits.controls, ((0, missing), (0, 0)))
    lower, upper, path = _by_interval(transcription, physical.between, jnp.sum)
    return Multipliers(
        # A defect is the next node minus the flow: pushing the flow is its negative.
        dynamics=-physical.dynamics,
        path_constraints=_by_name(transcription, physical.path),
        integrals=_by_integral(transcription, physical.integral),
        state=limits.states * size / scaling.state[None],
        control=control * size / scaling.control[None],
        final_time=limits.final_time * size / scaling.time,
        state_between=upper - lower,
        path_between=_by_name(transcription, path),
    )


def _by_integral(transcription: Transcription, values: Array) -> dict[str, Array]:
    return dict(zip(transcription.problem.integrals, values, strict=True))


def _by_name(transcription: Transcription, values: Array) -> dict[str, Array]:
    """Columns of all path constraints, by their names."""
    named, start = {}, 0
    for name, size in transcription.problem.path_sizes.items():
        named[name] = values[..., start : start + size]
        start += size
    return named


def _by_interval(
    transcription: Transcription, between: Float[Array, "I b"], together
) -> tuple[Float[Array, "I n"], Float[Array, "I n"], Float[Array, "I p"]]:
    """All parts of an interval together: of lower and upper limits, and of paths."""
    watch, parts = transcription.watch, transcription.discretization.between
    intervals, states = transcription.nodes - 1, transcription.problem.state_size
    by_part = between.reshape(intervals, parts, watch.size)
    whole = together(by_part, axis=1, initial=0.0)
    lows, below = len(watch.lower), jnp.zeros((intervals, states))
    entries = watch.entries
    return (
        below.at[:, entries[:lows]].set(whole[:, :lows]),
        below.at[:, entries[lows:]].set(whole[:, lows : watch.limits]),
        whole[:, watch.limits :],
    )
