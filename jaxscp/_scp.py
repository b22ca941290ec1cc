"""What an SCP method is, the loop that runs it, and how a solve ends."""

import abc
import functools
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from ._constraints import integral_limits, largest_buffer, violations
from ._progress import tell
from ._state import SCPState
from ._status import Status
from ._transcription import Transcription, Variables
from ._types import Array, ArrayLike, check_count

# The scaled residual of the optimality conditions above which a point is no optimum, not
# even roughly: gradients are of the order of one.
_ROUGH = 1.0
# With scales of its own finding each time: a few lead from any to the right ones.
_BEGINNINGS = 5
# How much smaller the cost's scale must have become.
_SMALLER = 0.1


class AbstractSCP(eqx.Module):
    """A method: how a reference becomes the next one.

    `init` and `step` know nothing of loops; `run` knows nothing of methods.
    """

    max_iterations: eqx.AbstractVar[int]
    tolerance: eqx.AbstractVar[float]
    feasibility_tolerance: eqx.AbstractVar[float]
    min_radius: eqx.AbstractVar[float]
    max_failures: eqx.AbstractVar[int]

    def __check_init__(self):
        for name in ("max_iterations", "max_failures"):
            check_count(name, getattr(self, name), 1)
        for name in ("tolerance", "feasibility_tolerance", "min_radius"):
            value = getattr(self, name)
            if not value > 0.0:
                raise ValueError(f"{name}={value!r}: give a positive number.")

    @abc.abstractmethod
    def init(
        self, transcription: Transcription, guess: Variables, again: bool | Array = False
    ) -> SCPState:
        """The state before the first subproblem.

        **Arguments:**

        - `again`: whether the guess is what this method led to, with scales that were
            wrong.
        """

    @abc.abstractmethod
    def step(self, transcription: Transcription, state: SCPState) -> SCPState:
        """Solve one subproblem, judge its step, take it or not."""

    def is_misled(self, state: SCPState) -> Array:
        """Whether its scales have made a method end where it ought not to."""
        del state
        return jnp.array(False)

    def terminate(
        self, transcription: Transcription, state: SCPState
    ) -> tuple[Array, Status]:
        """Whether to stop, and with which status. Nothing else decides a status."""
        limits = integral_limits(transcription, state.scaling)
        broken = violations(state.iterate.residuals, limits)
        dynamics = jnp.max(broken.dynamics)
        buffer = largest_buffer(broken)
        feasible = jnp.maximum(dynamics, buffer) <= self.feasibility_tolerance
        # Before it is known it is infinite; a method that never asks does not know it.
        astray = jnp.isfinite(state.optimality) & (state.optimality > _ROUGH)
        failed = state.failures >= self.max_failures
        infeasible = state.solution.effort.infeasible
        # Later ones prevail. Typed as anything: a member of an Enumeration is no string.
        outcomes: tuple[tuple[Array, Any], ...] = (
            (state.radius < self.min_radius, Status.trust_region_collapsed),
            (
                state.stationary & ~feasible & (buffer > dynamics),
                Status.virtual_buffer_remains,
            ),
            (
                state.stationary & ~feasible & (buffer <= dynamics),
                Status.virtual_control_remains,
            ),
            (state.stationary & feasible, Status.converged_roughly),
            (state.stationary & feasible & astray, Status.stalled),
            (state.optimality <= self.tolerance, Status.converged),
            (failed, Status.subproblem_failed),
            (failed & infeasible, Status.subproblem_infeasible),
            (~state.finite, Status.non_finite),
        )
        status: Any = Status.iteration_limit
        done = state.iterations >= self.max_iterations
        for happened, outcome in outcomes:
            status = Status.where(happened, outcome, status)
            done = done | happened
        return done, status


class _Course(eqx.Module):
    """How far a method has come.

    - `begins`: whether it is to begin, or to begin again. `begun`: how often it has.
    """

    state: SCPState
    begins: Array
    begun: Array
    ended: Array


def run(
    method: AbstractSCP,
    transcription: Transcription,
    guess: Variables,
    listener: Array | None = None,
    attempt: ArrayLike = 0,
) -> tuple[SCPState, Status]:
    """Iterate until the method terminates, in one compiled loop.

    What it ends with may be the first to tell how large the variables and the cost are.
    Where its scales were far off it begins again from there. The `listener` (`_progress`)
    is told which `attempt` this is.
    """

    def report(state: SCPState) -> None:
        assert listener is not None
        record = jax.tree.map(lambda h: h[state.records - 1], state.history)
        values = {name: getattr(record, name) for name in vars(record)}
        tell(listener, attempt, state.records, values)

    def begin(at: _Course) -> _Course:
        state, again = at.state, at.begun > 0
        fresh = method.init(transcription, state.iterate.variables, again)
        # Some costs are next to nothing, whatever the scales.
        size, before = fresh.scaling.objective, state.scaling.objective
        vain = again & (size > _SMALLER * before)
        state = jax.lax.cond(vain, lambda: state, lambda: fresh.counted_on(state))
        return _Course(state, jnp.array(False), at.begun + 1, vain)

    def step(at: _Course) -> _Course:
        after = method.step(transcription, at.state)
        if listener is not None:
            # The last look may find nothing left to do.
            tried = after.records > at.state.records
            jax.lax.cond(tried, report, lambda _: None, after)
        done, _ = method.terminate(transcription, after)
        left = (at.begun < _BEGINNINGS) & (after.iterations < method.max_iterations)
        again = done & left & method.is_misled(after)
        return _Course(after, again, at.begun, done & ~again)

    blank = SCPState.blank(functools.partial(method.init, transcription), guess)
    # What begins has not ended: with one condition alone XLA tries for seconds to count
    # the loop's turns.
    course = jax.lax.while_loop(
        lambda at: at.begins | ~at.ended,
        lambda at: jax.lax.cond(at.begins, begin, step, at),
        _Course(blank, jnp.array(True), jnp.zeros((), int), jnp.array(False)),
    )
    return course.state, method.terminate(transcription, course.state)[1]
