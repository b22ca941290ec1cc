"""The last iterate of a solve as a `Solution`: named, and in physical units."""

import jax.numpy as jnp

from ._attempt import Attempt
from ._constraints import integral_limits, violations, worst_violation
from ._diagnosis import Violations
from ._packed import Packed
from ._per_constraint import PerConstraint
from ._solution import Multipliers, Solution, Statistics
from ._state import SCPState
from ._status import Status
from ._transcription import Transcription
from ._types import Array, Float


def outcome(transcription: Transcription, state: SCPState, status: Status) -> Solution:
    """What the state holds, with the status it ended in."""
    scaling, iterate = state.scaling, state.iterate
    totals = iterate.residuals.totals * scaling.integral
    objective = iterate.residuals.objective * scaling.objective
    limits = integral_limits(transcription, scaling)
    missed = worst_violation(iterate.residuals, limits)
    return Solution(
        packed_problem=Packed.of(transcription.problem),
        discretization=transcription.discretization,
        trajectory=transcription.trajectory(iterate.variables),
        objective=objective,
        integrals=_by_integral(transcription, totals),
        multipliers=_multipliers(transcription, state),
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
        attempts=(Attempt(objective, missed, status, None, jnp.asarray(True)),),
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


def _multipliers(transcription: Transcription, state: SCPState) -> Multipliers:
    scaling, solution = state.scaling, state.solution
    size = scaling.objective
    physical = scaling.physical(solution.multipliers)
    missing = transcription.nodes - transcription.control_nodes
    control: Float[Array, "N m"] = jnp.pad(solution.control, ((0, missing), (0, 0)))
    lower, upper, path = _by_interval(transcription, physical.between, jnp.sum)
    return Multipliers(
        # A defect is the next node minus the flow: pushing the flow is its negative.
        dynamics=-physical.dynamics,
        path_constraints=_by_name(transcription, physical.path),
        integrals=_by_integral(transcription, physical.integral),
        state=solution.state * size / scaling.state[None],
        control=control * size / scaling.control[None],
        final_time=solution.final_time * size / scaling.time,
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
