"""The figure of a solved mission."""

from typing import cast

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d import Axes3D

from .._solution import Solution
from .._trajectory import Trajectory
from ..missions import Mission
from ._isometric import isometric
from ._link import rate, rates
from ._series import control, curves, dense
from ._style import BLUE, LIMIT, MEGA, shade_limits
from ._top_view import top_view


def mission(
    mission: Mission, solution: Solution, guess: Trajectory | None = None
) -> Figure:
    """Draw a solved mission: its route from above and in space, and what limits it.

    **Arguments:**

    - `mission`: whose problem was solved.
    - `solution`: states in the mission's order.
    - `guess`: the trajectory the solve started from, drawn dotted.

    **Returns:** a `Figure`; `figure.savefig("file.pdf")` writes it.
    """
    figure = Figure(figsize=(12.0, 9.0), layout="constrained")
    columns = figure.add_gridspec(1, 2, width_ratios=(1.15, 1.0))
    places, series = columns[0].subgridspec(2, 1), columns[1].subgridspec(5, 1)
    route = dense(solution)
    above = figure.add_subplot(places[0])
    top_view(above, mission, route, guess)
    above.legend(loc="upper left", fontsize="small")
    space = cast(Axes3D, figure.add_subplot(places[1], projection="3d"))
    isometric(space, mission, route, guess)
    first = figure.add_subplot(series[0])
    panels = [first]
    panels += [figure.add_subplot(series[row], sharex=first) for row in range(1, 5)]
    for ax in panels:
        ax.label_outer()
    _speed(panels[0], route)
    _tilt(panels[1], mission, route)
    _thrust(panels[2], mission, solution)
    rate(panels[3], mission, route)
    _data(panels[4], mission, route)
    panels[-1].set_xlabel("time [s]")
    figure.suptitle(_title(mission, solution))
    return figure


def _title(mission: Mission, solution: Solution) -> str:
    objective = float(solution.objective)
    final_time = float(solution.trajectory.final_time)
    return f"{mission.name}: {objective:,.0f} N² s in {final_time:.2f} s"


def _speed(ax: Axes, route: Trajectory) -> None:
    speed = np.linalg.norm(np.asarray(route.states)[:, 3:6], axis=1)
    curves(ax, np.asarray(route.times), {"speed": speed})
    ax.set_ylabel("speed [m/s]")


def _tilt(ax: Axes, mission: Mission, route: Trajectory) -> None:
    angles = np.degrees(np.asarray(route.states)[:, 6:8])
    roll, pitch = angles.T
    curves(ax, np.asarray(route.times), {"roll": roll, "pitch": pitch})
    limit = float(np.degrees(mission.limits.tilt))
    shade_limits(ax, -limit, limit, always=True)
    ax.set_ylabel("tilt [deg]")


def _thrust(ax: Axes, mission: Mission, solution: Solution) -> None:
    control(ax, solution, 0)
    shade_limits(ax, 0.0, float(mission.limits.thrust), always=True)
    ax.set_ylabel("thrust [N]")


def _data(ax: Axes, mission: Mission, route: Trajectory) -> None:
    flow, times = rates(mission, route), np.asarray(route.times)
    steps = 0.5 * (flow[1:] + flow[:-1]) * np.diff(times)
    ax.plot(times, np.concatenate([[0.0], np.cumsum(steps)]) / MEGA, color=BLUE)
    if mission.data_required is not None:
        required = float(mission.data_required) / MEGA
        ax.axhline(required, color=LIMIT, linewidth=0.8, label="required at the end")
        ax.legend(loc="upper left", fontsize="small")
    ax.set_ylabel("data [Mbit]")
