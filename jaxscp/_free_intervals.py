"""Free-interval grids: each interval has a duration of its own, near its neighbours'.

A solve on such a grid is one of another problem, in which time is a state. Here that
problem and its guess are made, and its solution becomes one of the problem it was made
from.
"""

import dataclasses
import math

import equinox as eqx
import jax
import jax.numpy as jnp

from ._paced_problem import (
    PACE_CONTROLS,
    PACE_STATES,
    PacedCost,
    durations,
    paced_problem,
)
from ._packed import Packed
from ._problem import OptimalControlProblem
from ._scaling import automatic_scaling
from ._solution import Multipliers, Solution
from ._trajectory import Trajectory
from ._transcription import Transcription
from ._types import Array, Float, Scalar

# The objective may rise by this share of its scale for the sake of an even grid: where
# it is all the same how long intervals are, their durations must still be determined.
EVENNESS = 1e-4
_REFINEMENTS = 30


@eqx.filter_jit
def lifted(
    transcription: Transcription, guess: Trajectory
) -> tuple[Transcription, Trajectory]:
    """The problem and the guess with free intervals."""
    problem, settings = transcription.problem, transcription.discretization
    assert settings.interval_ratio is not None
    steepest = math.log(settings.interval_ratio)
    variables = transcription.variables(guess)
    size = automatic_scaling(transcription, variables).objective
    intervals = transcription.nodes - 1
    duration, size = jax.lax.stop_gradient((variables.final_time, size))
    paced = paced_problem(
        problem,
        intervals,
        settings.interval_ratio,
        duration=duration,
        longest=settings.longest_interval * duration / intervals,
        price=EVENNESS * size,
    )
    pace = _guessed_pace(variables.final_time * jnp.diff(guess.fractions), steepest)
    times = jnp.append(0.0, jnp.cumsum(durations(pace)))
    fractions = times / times[-1]
    at = jax.vmap(jnp.interp, in_axes=(None, None, 1), out_axes=1)
    states = at(fractions, guess.fractions, guess.states)
    controls = at(fractions, guess.fractions, guess.controls)
    change = jnp.diff(pace, append=pace[-1:]) * intervals
    even = jnp.linspace(0.0, 1.0, transcription.nodes)
    return Transcription(paced, settings, even), Trajectory(
        fractions=even,
        states=jnp.column_stack([states, times, pace]),
        controls=jnp.column_stack([controls, change]),
        final_time=jnp.ones(()),
    )


def lowered(solution: Solution, problem: OptimalControlProblem) -> Solution:
    """The solution of a lifted problem as one of the problem itself.

    Violations keep what the clock and the pace miss, as they may be all that is wrong.
    """
    trajectory, multipliers = solution.trajectory, solution.multipliers
    states, controls = len(PACE_STATES), len(PACE_CONTROLS)
    time, pace = trajectory.states[:, -states], trajectory.states[:, -1]
    # From the pace, as they are positive even before the clock agrees with it.
    elapsed = jnp.append(0.0, jnp.cumsum(durations(pace)))
    cost = solution.problem.running_cost
    assert isinstance(cost, PacedCost)
    widths, changes = jnp.diff(trajectory.fractions), trajectory.controls[:-1, -1]
    own = multipliers.state
    return dataclasses.replace(
        solution,
        packed_problem=Packed.of(problem),
        trajectory=Trajectory(
            fractions=elapsed / elapsed[-1],
            states=trajectory.states[:, :-states],
            controls=trajectory.controls[:, :-controls],
            final_time=time[-1],
        ),
        objective=solution.objective - widths @ jax.vmap(cost.of_change)(changes),
        multipliers=Multipliers(
            dynamics=multipliers.dynamics[:, :-states],
            path_constraints=multipliers.path_constraints,
            integrals=multipliers.integrals,
            state=own[:, :-states],
            control=multipliers.control[:, :-controls],
            # Of what the clock shows in the end.
            final_time=own[-1, -states],
            state_between=multipliers.state_between[:, :-states],
            path_between=multipliers.path_between,
        ),
    )


def _guessed_pace(
    seconds: Float[Array, " I"], steepest: float | Scalar
) -> Float[Array, " N"]:
    """A pace that leads to durations near those given, within the limit of its change."""
    wanted = _flattened(jnp.log(seconds * seconds.size), steepest)

    def refined(_, pace):
        missing = wanted - jnp.log(durations(pace) * seconds.size)
        return pace + _at_nodes(missing)

    pace = jax.lax.fori_loop(0, _REFINEMENTS, refined, _at_nodes(wanted))
    pace = _flattened(pace, steepest)
    return pace + jnp.log(jnp.sum(seconds) / jnp.sum(durations(pace)))


def _at_nodes(values: Float[Array, " I"]) -> Float[Array, " N"]:
    """Means of neighbours; at both ends the only neighbour's."""
    around = jnp.concatenate([values[:1], values, values[-1:]])
    return 0.5 * (around[:-1] + around[1:])


def _flattened(values: Array, steepest: float | Scalar) -> Array:
    """The largest values, none above those given, that change by so much at most."""
    places = jnp.arange(values.size)
    apart = jnp.abs(places[:, None] - places[None])
    return jnp.min(values[None] + steepest * apart, axis=1)
