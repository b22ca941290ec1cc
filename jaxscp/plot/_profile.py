"""How high the vehicle flies."""

from typing import Any

import jax
import numpy as np
from matplotlib.axes import Axes

from .._trajectory import Trajectory
from ..missions import Mission
from ._places import Routes, positions, styled
from ._style import GREY, shade_limits

_ABSCISSAE = {"distance": "distance over ground [m]", "time": "time [s]"}
# A building is passed where less than this, in safe distances, is left to its circle.
_BESIDE = 0.5
_BAND: dict[str, Any] = {
    "color": GREY,
    "alpha": 0.4,
    "linewidth": 9.0,
    "solid_capstyle": "butt",
    "zorder": 1.0,
}


def profile(ax: Axes, mission: Mission, route: Routes, *, over: str = "distance") -> Axes:
    """Draw the altitude along routes, with the floor shaded.

    A broad grey band follows a route where it passes a building: within one and a half
    safe distances of its axis.

    **Arguments:**

    - `mission`: gives the floor, if there is one, and buildings.
    - `route`: a trajectory whose first three states are the position [m], or several by
        name. Curves are straight between nodes: `solution.sample` gives finer ones.
    - `over`: "distance", flown over ground, or "time".

    **Raises:** `ValueError` for another `over`, or if there is no route.
    """
    if over not in _ABSCISSAE:
        raise ValueError(f"over={over!r}: choose 'distance' or 'time'.")
    bands = []
    for flown, style in styled(route):
        place = positions(flown)
        along = np.asarray(flown.times) if over == "time" else _distance(place)
        ax.plot(along, place[:, 2], **style)
        beside = _beside(mission, flown)
        if beside.any():
            bands.append((along, np.where(beside, place[:, 2], np.nan)))
    name: str | None = "beside a building"
    for band in bands:
        ax.plot(*band, label=name, **_BAND)
        name = None
    floor = mission.altitude_floor
    lowest = -np.inf if floor is None else float(floor)
    shade_limits(ax, lowest, np.inf, always=True, name="altitude floor")
    ax.set_xlabel(_ABSCISSAE[over])
    ax.set_ylabel("altitude [m]")
    ax.legend()
    return ax


def _distance(place: np.ndarray) -> np.ndarray:
    """Way over ground up to each node, shape (N,) [m]."""
    steps = np.linalg.norm(np.diff(place[:, :2], axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(steps)])


def _beside(mission: Mission, route: Trajectory) -> np.ndarray:
    """Whether each node is beside a building, shape (N,)."""
    clearance = jax.vmap(mission.obstacles.clearance)(route.states[:, :2])
    reach = _BESIDE * np.asarray(mission.obstacles.safe_distances)
    return np.any(np.asarray(clearance) <= reach, axis=1)
