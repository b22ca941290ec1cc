"""States, controls and convergence of any solution."""

import numpy as np
from matplotlib.axes import Axes

from .._bounds import Bounds
from .._solution import Solution
from .._trajectory import Trajectory
from ._style import BLUE, CYCLE, ManyAxes, label, listed, shade_limits

SAMPLES = 1001


def dense(solution: Solution) -> Trajectory:
    """The solution between its nodes, evenly spaced in time."""
    final_time = float(solution.trajectory.final_time)
    return solution.sample(np.linspace(0.0, final_time, SAMPLES))


def states(axes: ManyAxes, solution: Solution) -> ManyAxes:
    """Draw every state over time: a curve, its nodes, and its limits shaded.

    **Arguments:**

    - `axes`: one Axes for each state, as from `figure.subplots(n, sharex=True)`.
    - `solution`: of any problem.

    **Raises:** `ValueError` if the number of Axes is not that of the states.
    """
    problem = solution.problem
    each = listed(axes, problem.state_names, "state")
    between, nodal = dense(solution), solution.trajectory
    for index, (ax, name) in enumerate(zip(each, problem.state_names, strict=True)):
        ax.plot(between.times, between.states[:, index], color=BLUE)
        ax.plot(nodal.times, nodal.states[:, index], ".", color=BLUE, markersize=3)
        _finish(ax, name, problem.unit(name), problem.state, index)
    each[-1].set_xlabel("time [s]")
    return axes


def controls(axes: ManyAxes, solution: Solution) -> ManyAxes:
    """Draw every control over time, with the hold that was used and limits shaded.

    **Arguments:**

    - `axes`: one Axes for each control, as from `figure.subplots(m, sharex=True)`.
    - `solution`: of any problem.

    **Raises:** `ValueError` if the number of Axes is not that of the controls.
    """
    problem = solution.problem
    each = listed(axes, problem.control_names, "control")
    for index, (ax, name) in enumerate(zip(each, problem.control_names, strict=True)):
        control(ax, solution, index)
        _finish(ax, name, problem.unit(name), problem.control, index)
    each[-1].set_xlabel("time [s]")
    return axes


def control(ax: Axes, solution: Solution, index: int) -> Axes:
    """One control over time, as a staircase where the hold makes it one."""
    nodal = solution.trajectory
    held = solution.discretization.hold.control_nodes(nodal.nodes) < nodal.nodes
    drawstyle = "steps-post" if held else "default"
    ax.plot(nodal.times, nodal.controls[:, index], color=BLUE, drawstyle=drawstyle)
    return ax


def convergence(ax: Axes, solution: Solution) -> Axes:
    """Draw how far each subproblem was from the end, on a logarithmic axis.

    Shown are the distance of the penalized cost from its last value, the predicted
    reduction, and the largest defect of the step tried, all of them scaled.
    """
    history = solution.history
    cost = np.asarray(history.penalized_cost, float)
    finite = cost[np.isfinite(cost)]
    last = finite[-1] if finite.size else np.nan
    rows = {
        "penalized cost above its last value": np.abs(cost - last),
        "predicted reduction": np.asarray(history.predicted_reduction, float),
        "largest defect": np.asarray(history.defect, float),
    }
    for (name, values), colour in zip(rows.items(), CYCLE, strict=False):
        # A logarithmic axis has no place for zero.
        shown = np.where(values > 0, values, np.nan)
        numbers = np.arange(1, shown.size + 1)
        ax.plot(numbers, shown, ".-", color=colour, label=name)
    ax.set_yscale("log")
    ax.set_xlim(0.5, max(finite.size, 1) + 0.5)
    ax.set_xlabel("subproblem")
    ax.legend()
    return ax


def curves(ax: Axes, times: np.ndarray, values: dict[str, np.ndarray]) -> Axes:
    """Several named curves over time."""
    for colour, (name, column) in zip(CYCLE, values.items(), strict=False):
        ax.plot(times, column, color=colour, label=name)
    if len(values) > 1:
        ax.legend(ncols=len(values), fontsize="small")
    return ax


def _finish(ax: Axes, name: str, unit: str, bounds: Bounds, index: int) -> None:
    shade_limits(ax, float(bounds.lower[index]), float(bounds.upper[index]))
    ax.set_ylabel(label(name, unit))
