"""Where things stand: routes and how they are told apart, buildings, landmarks."""

from collections.abc import Mapping
from itertools import cycle
from typing import Any, TypeAlias

import numpy as np

from .._trajectory import Trajectory
from ..missions import Mission
from ._style import BLACK, BLUE, CYCLE, GREEN, ORANGE, PURPLE

# One trajectory, or several by name.
Routes: TypeAlias = Trajectory | Mapping[str, Trajectory]

GUESS: dict[str, Any] = {
    "color": BLACK,
    "linestyle": ":",
    "linewidth": 1.2,
    "label": "initial guess",
}
ROUTE: dict[str, Any] = {"color": BLUE, "linewidth": 1.8, "label": "trajectory"}
# Dotted is kept for guesses.
_LINES = ("-", "--", "-.", (0, (7, 1.5, 1, 1.5, 1, 1.5)), (0, (9, 2.5)))


def styled(routes: Routes) -> list[tuple[Trajectory, dict[str, Any]]]:
    """Each route with how to draw it: by colour, and by line where colours are lost.

    **Raises:** `ValueError` if there is none.
    """
    if isinstance(routes, Trajectory):
        return [(routes, ROUTE)]
    if not routes:
        raise ValueError("route={}: give a trajectory, or at least one by name.")
    looks = zip(cycle(CYCLE), cycle(_LINES), routes.items(), strict=False)
    return [
        (route, ROUTE | {"color": colour, "linestyle": line, "label": name})
        for colour, line, (name, route) in looks
    ]


def positions(trajectory: Trajectory) -> np.ndarray:
    """Positions at the nodes, shape (N, 3) [m]."""
    return np.asarray(trajectory.states)[:, :3]


def buildings(mission: Mission) -> list[tuple[tuple[float, float], float]]:
    """Axis and safe distance of each building [m]."""
    centers = np.asarray(mission.obstacles.centers, float)
    distances = np.asarray(mission.obstacles.safe_distances, float)
    return [
        ((float(x), float(y)), float(distance))
        for (x, y), distance in zip(centers, distances, strict=True)
    ]


def landmarks(mission: Mission) -> list[tuple[np.ndarray, dict[str, Any]]]:
    """Start, goal and ground station: a position [m] and how to mark it."""
    marks = (
        (mission.start, "o", GREEN, "start"),
        (mission.goal, "*", ORANGE, "goal"),
        (mission.channel.ground_station, "^", PURPLE, "ground station"),
    )
    return [
        (
            np.asarray(point, float),
            {
                "marker": marker,
                "color": colour,
                "linestyle": "none",
                "markersize": 9,
                "label": name,
            },
        )
        for point, marker, colour, name in marks
    ]
