"""What limits and states are worth along a flight."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from .._problem import entry_name
from .._shadow_prices import price_unit
from .._solution import Solution
from ._style import BLUE, GREY, ORANGE, ManyAxes, label, listed


def costates(axes: ManyAxes, solution: Solution) -> ManyAxes:
    """Draw the multipliers of the dynamics over time.

    Each is what the optimal objective changes by when its state is pushed by one unit,
    at the end of an interval.

    **Arguments:**

    - `axes`: one Axes for each state, as from `figure.subplots(n, sharex=True)`.
    - `solution`: of any problem. The unit of its "objective" shows where there is one.

    **Raises:** `ValueError` if the number of Axes is not that of the states.
    """
    problem = solution.problem
    each = listed(axes, problem.state_names, "state")
    times, values = solution.trajectory.times[1:], solution.multipliers.dynamics
    for ax, name, column in zip(each, problem.state_names, values.T, strict=True):
        _zero(ax)
        ax.plot(times, column, ".-", color=BLUE, linewidth=1.2, markersize=4)
        ax.set_ylabel(label(f"costate of {name}\n", price_unit(problem, name)))
    each[-1].set_xlabel("time [s]")
    return axes


def active_limits(solution: Solution) -> tuple[str, ...]:
    """Names of states, controls and path constraints whose limits have multipliers."""
    return tuple(
        name
        for name, multipliers in _limits(solution).items()
        if any(np.any(values != 0.0) for values in multipliers)
    )


def multipliers(
    axes: ManyAxes, solution: Solution, names: Sequence[str] | None = None
) -> ManyAxes:
    """Draw the multipliers of limits over time: stems at nodes, bars between them.

    Those of upper limits and path constraints are positive, those of lower limits
    negative. What fixes or limits the states at the ends alone is left out.

    **Arguments:**

    - `axes`: one for each name.
    - `solution`: of any problem.
    - `names`: of states, controls and path constraints, or entries of these as in
        `buildings[1]`; [`active_limits`][] by default.

    **Raises:** `ValueError` for a name that does not exist, or unless there is one Axes
    for each.
    """
    known = _limits(solution)
    names = active_limits(solution) if names is None else tuple(names)
    for name in names:
        if name not in known:
            raise ValueError(f"names: {name!r} is none of {', '.join(known)}.")
    each = listed(axes, names, "active limit")
    times = np.asarray(solution.trajectory.times)
    for ax, name in zip(each, names, strict=True):
        nodal, between = known[name]
        _zero(ax)
        if np.any(between != 0.0):
            bars: dict[str, Any] = {"color": ORANGE, "alpha": 0.6, "linewidth": 0}
            shown = {"align": "edge", "label": "between nodes"} | bars
            ax.bar(times[:-1], between, np.diff(times), **shown)
        ax.vlines(times, 0.0, nodal, color=BLUE, linewidth=1.2)
        ax.plot(times, nodal, ".", color=BLUE, markersize=4, label="at nodes")
        ax.set_ylabel(label(f"{name}\n", price_unit(solution.problem, name)))
        if len(ax.patches):
            ax.legend(fontsize="small")
            ax.use_sticky_edges = False
    if len(names):
        each[-1].set_xlabel("time [s]")
    return axes


def _zero(ax: Axes) -> None:
    ax.axhline(0.0, color=GREY, linewidth=0.6)


def _limits(solution: Solution) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Multipliers at the nodes and between them, by the name of what is limited."""
    problem, values = solution.problem, solution.multipliers
    found = {}
    for name, size in problem.path_sizes.items():
        for entry in range(size):
            nodal = np.asarray(values.path_constraints[name])[:, entry]
            between = np.asarray(values.path_between[name])[:, entry]
            found[entry_name(name, entry, size)] = nodal, between
    nodal, between = np.array(values.state), np.asarray(values.state_between)
    for node, end in ((0, problem.initial_state), (-1, problem.final_state)):
        lower, upper = map(np.asarray, end.prevails(problem.state))
        owned = np.where(nodal[node] < 0.0, lower, upper)
        nodal[node] = np.where(owned, 0.0, nodal[node])
    for entry, name in enumerate(problem.state_names):
        found[name] = nodal[:, entry], between[:, entry]
    nodal = np.asarray(values.control)
    for entry, name in enumerate(problem.control_names):
        found[name] = nodal[:, entry], np.zeros(len(nodal) - 1)
    return found
