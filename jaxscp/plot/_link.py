"""The radio link along a flight."""

import numpy as np
from matplotlib.axes import Axes

from .._solution import Solution
from .._trajectory import Trajectory
from ..missions import Mission
from ._series import dense
from ._style import BLUE, MEGA, ManyAxes, listed


def link(axes: ManyAxes, mission: Mission, solution: Solution) -> ManyAxes:
    """Draw what the link to the ground station does over time.

    **Arguments:**

    - `axes`: three: for the rate, the elevation seen from the ground station, and the
        probability of a line of sight.
    - `mission`: gives the channel.
    - `solution`: whose first three states are the position [m].

    **Raises:** `ValueError` unless there are three Axes.
    """
    each = listed(axes, ("rate", "elevation", "line of sight"), "curve")
    route = dense(solution)
    times, place = np.asarray(route.times), route.states[:, :3]
    first, second, third = each
    rate(first, mission, route)
    second.plot(times, mission.channel.elevation(place), color=BLUE)
    second.set_ylabel("elevation [deg]")
    third.plot(times, mission.channel.line_of_sight_probability(place), color=BLUE)
    third.set_ylim(-0.05, 1.05)
    third.set_ylabel("probability of\nline of sight")
    third.set_xlabel("time [s]")
    return axes


def rate(ax: Axes, mission: Mission, route: Trajectory) -> Axes:
    """The data rate over time."""
    ax.plot(route.times, rates(mission, route) / MEGA, color=BLUE)
    ax.set_ylabel("rate [Mbit/s]")
    return ax


def rates(mission: Mission, route: Trajectory) -> np.ndarray:
    """Data rate along the route [bit/s]."""
    return np.asarray(mission.channel.rate(route.states[:, :3]))
