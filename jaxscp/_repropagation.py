"""Re-propagation of nodal values with SciPy's DOP853, for `verify` alone.

The hold, the grid and the accumulation of integrals are written a second time here, in
NumPy, so that a mistake in the discretization cannot hide in its own check.

Axes besides the usual ones: `I` intervals, `S` samples of each, and `w` columns: the
states, then the integrals, then the running cost.
"""

import dataclasses
import functools
import math
from collections.abc import Callable
from typing import TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ._problem import OptimalControlProblem

# Local error allowed in each entry, relative to its value and to its range.
RELATIVE_TOLERANCE = 1e-10
RANGE_TOLERANCE = 1e-12
# Steps after which an interval, and a whole flight, counts as impossible to follow.
INTERVAL_STEPS = 2_000
FLIGHT_STEPS = 10_000
# Of an interval, to begin with.
FIRST_STEP = 0.1

# Of times (k,), states (k, n) and controls (k, m), shape (k, w).
Rates: TypeAlias = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]


@dataclasses.dataclass(frozen=True)
class Nodes:
    """A trajectory's values as NumPy arrays.

    - `times`: time of each node [s].
    - `states`, `controls`: nodal values.
    - `linear`: whether controls vary linearly between nodes, or are held.
    """

    times: Float[np.ndarray, " N"]
    states: Float[np.ndarray, "N n"]
    controls: Float[np.ndarray, "N m"]
    linear: bool

    @property
    def intervals(self) -> int:
        return self.times.size - 1

    def controls_at(
        self, fraction: float, intervals: slice = slice(None)
    ) -> Float[np.ndarray, "intervals m"]:
        """Control at the same fraction of each of the chosen intervals."""
        left = self.controls[:-1][intervals]
        if not self.linear:
            return left
        right = self.controls[1:][intervals]
        return (1.0 - fraction) * left + fraction * right


def integral_names(problem: OptimalControlProblem) -> tuple[str, ...]:
    """The integrals in the order of every column here: sorted.

    A dictionary comes out of `jax.jit` with sorted keys, whatever its order was.
    """
    return tuple(sorted(problem.integrals))


def rates_of(problem: OptimalControlProblem) -> Rates:
    """A compiled function of times (k,), states (k, n) and controls (k, m).

    It returns the rates of the states, then of each integral, then the running cost,
    shape (k, w). Problems that differ in parameter values share one compilation.
    """
    leaves, structure = jax.tree.flatten(problem)
    parameters = [leaf for leaf in leaves if _is_array(leaf)]
    others = tuple(None if _is_array(leaf) else leaf for leaf in leaves)
    compiled = _compiled_rates(structure, others)

    def rates(times, states, controls):
        return np.asarray(compiled(parameters, times, states, controls))

    return rates


def _is_array(leaf: object) -> bool:
    return isinstance(leaf, (np.ndarray, jax.Array))


@functools.lru_cache(maxsize=16)
def _compiled_rates(structure, others):
    # `eqx.filter_jit` would do, but sorts parameters from the rest at every call: four
    # times the cost of a call, and the integrator makes thousands of them.
    def rates(parameters, times, states, controls):
        remaining = iter(parameters)
        leaves = [next(remaining) if leaf is None else leaf for leaf in others]
        problem = jax.tree.unflatten(structure, leaves)

        def at_once(t, x, u):
            integrals = [problem.integrals[name] for name in integral_names(problem)]
            scalars = [integral.integrand(t, x, u) for integral in integrals]
            scalars.append(problem.running_cost(t, x, u))
            columns = [jnp.reshape(value, 1) for value in scalars]
            return jnp.concatenate([problem.dynamics(t, x, u), *columns])

        return jax.vmap(at_once)(times, states, controls)

    return jax.jit(rates)


def along_intervals(
    rates: Rates,
    nodes: Nodes,
    ranges: Float[np.ndarray, " w"],
    fractions: Float[np.ndarray, " S"],
) -> Float[np.ndarray, "S I w"]:
    """States and accumulated integrals along each interval, from its own left node.

    All intervals are one system of equations in normalized interval time: few calls of
    the dynamics, each for all intervals, with steps short enough for the hardest one.
    If one cannot be followed, each is tried alone, and NaN marks those that fail.

    **Arguments:**

    - `ranges`: typical size of each column, for absolute tolerances.
    - `fractions`: where to sample an interval, rising from 0 to 1.
    """
    every = slice(0, nodes.intervals)
    values, *_ = _follow(rates, nodes, every, nodes.states[:-1], ranges, fractions)
    if np.all(np.isfinite(values)):
        return values
    steps = 0
    for k in range(nodes.intervals):
        alone = slice(k, k + 1)
        if steps < FLIGHT_STEPS:
            start = nodes.states[alone]
            run = _follow(rates, nodes, alone, start, ranges, fractions)
            values[:, alone], _, taken = run
            steps += taken
    return values


def whole_flight(
    rates: Rates,
    nodes: Nodes,
    ranges: Float[np.ndarray, " w"],
    limit: Float[np.ndarray, " n"],
) -> Float[np.ndarray, " n"] | None:
    """State at the end of a flight from the first node under the nodes' controls.

    `None` if the flight cannot be followed, or strays from a node by more than `limit`:
    beyond that the dynamics need not mean anything.
    """
    end = np.ones(1)
    state = nodes.states[:1]
    steps, step = 0, FIRST_STEP
    for k in range(nodes.intervals):
        alone = slice(k, k + 1)
        values, step, taken = _follow(rates, nodes, alone, state, ranges, end, step)
        state = values[-1, :, : state.shape[1]]
        steps += taken
        strays = np.any(np.abs(state[0] - nodes.states[k + 1]) > limit)
        if strays or steps > FLIGHT_STEPS or not np.all(np.isfinite(state)):
            return None
    return state[0]


def _follow(
    rates: Rates,
    nodes: Nodes,
    intervals: slice,
    start: Float[np.ndarray, "I n"],
    ranges: Float[np.ndarray, " w"],
    fractions: Float[np.ndarray, " S"],
    first_step: float = FIRST_STEP,
) -> tuple[Float[np.ndarray, "S I w"], float, int]:
    """Samples along some intervals, the longest step and the number of steps.

    All samples are NaN if one of the intervals cannot be followed to its end.
    """
    starts = nodes.times[:-1][intervals]
    widths = np.diff(nodes.times)[intervals]
    count, size = start.shape
    shape = (count, ranges.size)

    def slope(fraction: float, y: np.ndarray) -> np.ndarray:
        states = y.reshape(shape)[:, :size]
        controls = nodes.controls_at(fraction, intervals)
        values = rates(starts + fraction * widths, states, controls)
        return (widths[:, None] * values).ravel()

    initial = np.zeros(shape)
    initial[:, :size] = start
    scales = np.tile(ranges, count)
    samples, longest, steps = _integrate(
        slope, initial.ravel(), scales, fractions, first_step
    )
    return samples.reshape(fractions.size, *shape), longest, steps


def _integrate(
    slope: Callable[[float, np.ndarray], np.ndarray],
    initial: Float[np.ndarray, " w"],
    ranges: Float[np.ndarray, " w"],
    fractions: Float[np.ndarray, " S"],
    first_step: float,
) -> tuple[Float[np.ndarray, "S w"], float, int]:
    """DOP853 from 0 to 1, sampled at `fractions`; NaN if it does not get there."""
    # Here, as it takes half a second, and most who import jaxscp do not verify at once.
    from scipy.integrate import DOP853

    samples = np.full((fractions.size, initial.size), np.nan)
    if not np.all(np.isfinite(initial)):
        return samples, FIRST_STEP, 0
    # SciPy bounds the root mean square over all entries; dividing by the root of their
    # number bounds each entry.
    share = math.sqrt(initial.size)
    solver = DOP853(
        slope,
        0.0,
        initial,
        1.0,
        # SciPy's own guess of it would never end on a non-finite rate; steps that meet
        # one are rejected and shortened until DOP853 gives up.
        first_step=first_step,
        rtol=RELATIVE_TOLERANCE / share,
        atol=RANGE_TOLERANCE * ranges / share,
    )
    samples[fractions <= 0.0] = initial
    steps, longest = 0, 0.0
    while solver.status == "running" and steps < INTERVAL_STEPS:
        solver.step()
        steps += 1
        longest = max(longest, solver.t - (solver.t_old or 0.0))
        inside = (solver.t_old or 0.0) < fractions
        inside &= (fractions <= solver.t) & (fractions < 1.0)
        if inside.any():
            samples[inside] = solver.dense_output()(fractions[inside]).T
    samples[fractions >= 1.0] = solver.y
    if solver.status != "finished" or not np.all(np.isfinite(samples)):
        samples[:] = np.nan
    return samples, longest or FIRST_STEP, steps
