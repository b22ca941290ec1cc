"""`verify`: what a trajectory does in continuous time, judged by other code."""

import math
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float

from ._limit_checks import (
    Points,
    Violation,
    broken_boundaries,
    broken_integrals,
    broken_limits,
    path_ranges,
    range_of_limits,
    range_of_motion,
)
from ._problem import OptimalControlProblem
from ._repropagation import (
    Nodes,
    Rates,
    along_intervals,
    integral_names,
    rates_of,
    whole_flight,
)
from ._trajectory import Trajectory, time_grid
from ._tree import as_floats
from ._validation import check_precision
from ._verification import Dense, Verification

# Straying from a node by this many ranges ends the re-propagation of a whole flight.
FLIGHT_LIMIT = 10.0
# By name: the solver's holds are not used, only which one it was.
HOLDS = ("ZeroOrderHold", "FirstOrderHold")


@runtime_checkable
class Solved(Protocol):
    """What `verify` reads of a solution."""

    trajectory: Trajectory
    discretization: Any


def verify(
    problem: OptimalControlProblem,
    solution: Solved | Trajectory,
    *,
    between: bool = False,
    hold: Any = None,
    tolerance: float = 1e-4,
    interval_tolerance: float = 1e-4,
    samples: int = 20,
) -> Verification:
    """Re-propagate a solution with SciPy's DOP853 and check every limit.

    Shares no code with the solver's discretization: integrator, hold and accumulation
    of integrals are its own; only the problem's functions are the same.

    **Arguments:**

    - `solution`: a [`Solution`][], or any [`Trajectory`][].
    - `between`: let limits broken between the nodes count against `verified` too. They
        are reported either way.
    - `hold`: [`ZeroOrderHold`][] or [`FirstOrderHold`][]; by default the solution's,
        and zero-order for a bare trajectory.
    - `tolerance`: breach allowed, relative. Limits on states and controls are measured
        in the range between them, or in ten times the range the trajectory covers where
        that is less, else in their typical size (`Bounds.scale`), else in the range
        covered; boundary states and path constraints in the
        range covered; an integral and the flight time in the size of their limit.
    - `interval_tolerance`: distance allowed between the flow's end and the next node,
        relative to the range the trajectory covers: 0.05 m for 500 m.
    - `samples`: moments of each interval to check, both its ends included, at least 2.

    **Raises:** `ValueError` for a trajectory that does not fit the problem, an unknown
    hold, or fewer than 2 samples; `RuntimeError` if JAX is not in 64-bit mode.
    """
    check_precision()
    nodes = _read(problem, solution, hold)
    if samples < 2:
        raise ValueError(f"samples={samples}: give at least 2, the ends of an interval.")
    rates = rates_of(problem)
    motion = range_of_motion(problem.state, nodes.states)
    # Non-finite values are found and reported, not warned of.
    with np.errstate(all="ignore"):
        sizes = _integral_sizes(problem, rates, nodes)
        ranges = np.concatenate([motion, sizes])
        fractions = np.linspace(0.0, 1.0, samples)
        values = along_intervals(rates, nodes, ranges, fractions)
        end = whole_flight(rates, nodes, ranges, FLIGHT_LIMIT * motion)
        dense, running_cost = _dense(problem, rates, nodes, fractions, values)
        at_nodes, everywhere = _violations(
            problem, nodes, dense, motion, sizes, tolerance
        )
    last = as_floats(nodes.times[-1]), as_floats(nodes.states[-1])
    terminal_cost = problem.terminal_cost(*last)
    objective = running_cost + float(terminal_cost)
    errors = np.abs(values[-1, :, : problem.state_size] - nodes.states[1:])
    allowed = interval_tolerance * motion
    sound = math.isfinite(objective) and bool(np.all(errors <= allowed))
    return Verification(
        verified=sound and not (everywhere if between else at_nodes),
        interval_errors=errors,
        interval_tolerances=allowed,
        flight_error=None if end is None else np.abs(end - nodes.states[-1]),
        objective=objective,
        integrals=_totals(dense),
        node_violations=at_nodes,
        violations=everywhere,
        dense=dense,
        times=nodes.times,
        state_names=problem.state_names,
        units={
            name: problem.unit(name)
            for name in (*problem.state_names, *problem.integrals)
        },
    )


def _read(
    problem: OptimalControlProblem, solution: Solved | Trajectory, hold: Any
) -> Nodes:
    """The trajectory as NumPy arrays, checked against the problem."""
    if isinstance(solution, Trajectory):
        trajectory = solution
    else:
        trajectory = solution.trajectory
        hold = solution.discretization.hold if hold is None else hold
    name = "ZeroOrderHold" if hold is None else type(hold).__name__
    if name not in HOLDS:
        raise ValueError(
            f"hold={hold!r}: verify knows ZeroOrderHold() and FirstOrderHold()."
        )
    fractions = np.asarray(time_grid(trajectory.fractions), float)
    states = np.asarray(trajectory.states, float)
    controls = np.array(trajectory.controls, float)
    for what, array, width in (
        ("states", states, problem.state_size),
        ("controls", controls, problem.control_size),
    ):
        if array.shape != (fractions.size, width):
            raise ValueError(
                f"{what} has shape {array.shape}: the problem and {fractions.size} "
                f"nodes need ({fractions.size}, {width})."
            )
    final_time = float(trajectory.final_time)
    if not 0 < final_time < math.inf:
        raise ValueError(f"final_time={final_time}: give a positive number of seconds.")
    linear = name == "FirstOrderHold"
    if not linear:
        controls[-1] = controls[-2]  # acts on no interval
    return Nodes(final_time * fractions, states, controls, linear)


def _integral_sizes(
    problem: OptimalControlProblem, rates: Rates, nodes: Nodes
) -> Float[np.ndarray, " r"]:
    """Typical size of each integral and of the running cost: mean rate times time."""
    values = rates(nodes.times[:-1], nodes.states[:-1], nodes.controls[:-1])
    sizes = np.diff(nodes.times) @ np.abs(values[:, problem.state_size :])
    return np.where(np.isfinite(sizes) & (sizes > 0), sizes, 1.0)


def _dense(
    problem: OptimalControlProblem,
    rates: Rates,
    nodes: Nodes,
    fractions: Float[np.ndarray, " S"],
    values: Float[np.ndarray, "S I w"],
) -> tuple[Dense, float]:
    """Samples in order of time, and the running cost over the whole flight."""
    n = problem.state_size
    widths = np.diff(nodes.times)
    moments = nodes.times[:-1, None] + widths[:, None] * fractions
    held = np.stack([nodes.controls_at(fraction) for fraction in fractions], axis=1)
    by_interval = np.swapaxes(values, 0, 1)
    states = by_interval[:, :, :n].reshape(-1, n)
    controls = held.reshape(-1, held.shape[-1])
    # Each interval starts from zero: add what the intervals before it gathered.
    gathered = np.cumsum(by_interval[:, -1, n:], axis=0)
    before = np.concatenate([np.zeros((1, gathered.shape[1])), gathered[:-1]])
    accumulated = (by_interval[:, :, n:] + before[:, None]).reshape(states.shape[0], -1)
    names = integral_names(problem)
    integrands = rates(moments.ravel(), states, controls)[:, n:] if names else accumulated
    dense = Dense(
        times=moments.ravel(),
        states=states,
        controls=controls,
        integrands={name: integrands[:, j] for j, name in enumerate(names)},
        accumulated={name: accumulated[:, j] for j, name in enumerate(names)},
    )
    return dense, float(gathered[-1, -1])


def _totals(dense: Dense) -> dict[str, float]:
    return {name: float(values[-1]) for name, values in dense.accumulated.items()}


def _violations(
    problem: OptimalControlProblem,
    nodes: Nodes,
    dense: Dense,
    motion: Float[np.ndarray, " n"],
    sizes: Float[np.ndarray, " r"],
    tolerance: float,
) -> tuple[dict[str, Violation], dict[str, Violation]]:
    """Broken limits at the nodes, and at the nodes and between them."""
    points = Points.of(
        problem,
        np.concatenate([nodes.times, dense.times]),
        np.concatenate([nodes.states, dense.states]),
        np.concatenate([nodes.controls, dense.controls]),
    )
    at_nodes = points.first(nodes.times.size)
    allowed = (
        tolerance * range_of_limits(problem.state, nodes.states),
        tolerance * range_of_limits(problem.control, nodes.controls),
        {name: tolerance * size for name, size in path_ranges(at_nodes).items()},
    )
    final_time = float(nodes.times[-1])
    named_sizes = dict(zip(integral_names(problem), sizes.tolist(), strict=False))
    always = broken_boundaries(problem, at_nodes, tolerance * motion, tolerance)
    always |= broken_integrals(
        problem, _totals(dense), named_sizes, final_time, tolerance
    )
    return (
        broken_limits(problem, at_nodes, *allowed) | always,
        broken_limits(problem, points, *allowed) | always,
    )
