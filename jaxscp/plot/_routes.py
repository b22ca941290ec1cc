"""Where the vehicle flies: from above, and in space."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Circle
from mpl_toolkits.mplot3d import Axes3D

from .._trajectory import Trajectory
from ..missions import Mission
from ._style import BLACK, BLUE, GREEN, GREY, ORANGE, PURPLE

GUESS: dict[str, Any] = {
    "color": BLACK,
    "linestyle": ":",
    "linewidth": 1.2,
    "label": "initial guess",
}
ROUTE: dict[str, Any] = {"color": BLUE, "linewidth": 1.8, "label": "trajectory"}


def top_view(
    ax: Axes, mission: Mission, route: Trajectory, guess: Trajectory | None = None
) -> Axes:
    """Draw the route from above, as in the paper's figures.

    **Arguments:**

    - `mission`: gives buildings with safe circles, ground station, start and goal.
    - `route`, `guess`: trajectories whose first three states are the position [m].
    """
    for center, distance in _buildings(mission):
        ax.add_patch(Circle(center, distance, color=GREY, alpha=0.35, linewidth=0))
        ax.add_patch(Circle(center, distance, fill=False, color=GREY))
        ax.plot(*center, "s", color=GREY, markersize=7)
    if guess is not None:
        ax.plot(*_positions(guess)[:, :2].T, **GUESS)
    ax.plot(*_positions(route)[:, :2].T, **ROUTE)
    for point, style in _landmarks(mission):
        ax.plot(*point[:2], **style)
    ax.set_aspect("equal", adjustable="datalim")
    ax.set_xlabel("x [m]")
    ax.set_ylabel("y [m]")
    return ax


def isometric(
    ax: Axes3D, mission: Mission, route: Trajectory, guess: Trajectory | None = None
) -> Axes3D:
    """Draw the route in space, as in the paper's figures, with its ground track.

    Buildings have no height in the model; they are drawn a little taller than the
    highest point of the route. The vertical axis is stretched so that climbs show.

    **Arguments:** as [`top_view`][], and `ax` made with `projection="3d"`.
    """
    positions = _positions(route)
    finite = positions[np.isfinite(positions).all(axis=1)]
    points = np.vstack([finite, *(point for point, _ in _landmarks(mission))])
    top = 1.15 * max(points[:, 2].max(), 1.0)
    for center, distance in _buildings(mission):
        _cylinder(ax, center, distance, top)
    if guess is not None:
        ax.plot(*_positions(guess).T, **GUESS)
    ax.plot(*positions[:, :2].T, 0.0, color=GREY, linewidth=1.0)
    ax.plot(*positions.T, **ROUTE)
    for point, style in _landmarks(mission):
        ax.plot(*(np.array([value]) for value in point), **style)
    low, high = points[:, :2].min(axis=0), points[:, :2].max(axis=0)
    middle, half = 0.5 * (low + high), 0.55 * max(np.max(high - low), 1.0)
    ax.set_xlim(middle[0] - half, middle[0] + half)
    ax.set_ylim(middle[1] - half, middle[1] + half)
    ax.set_zlim(0.0, top)
    ax.set_box_aspect((1.0, 1.0, 0.45))
    ax.set_proj_type("ortho")
    ax.view_init(elev=30.0, azim=-60.0)
    ax.set_xlabel("x [m]")
    ax.set_ylabel("y [m]")
    ax.set_zlabel("z [m]")
    return ax


def _positions(trajectory: Trajectory) -> np.ndarray:
    return np.asarray(trajectory.states)[:, :3]


def _buildings(mission: Mission) -> list[tuple[tuple[float, float], float]]:
    centers = np.asarray(mission.obstacles.centers, float)
    distances = np.asarray(mission.obstacles.safe_distances, float)
    return [
        ((float(x), float(y)), float(distance))
        for (x, y), distance in zip(centers, distances, strict=True)
    ]


def _landmarks(mission: Mission) -> list[tuple[np.ndarray, dict[str, Any]]]:
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


def _cylinder(
    ax: Axes3D, center: tuple[float, float], radius: float, height: float
) -> None:
    angle, level = np.meshgrid(np.linspace(0.0, 2.0 * np.pi, 49), [0.0, height])
    ax.plot_surface(
        center[0] + radius * np.cos(angle),
        center[1] + radius * np.sin(angle),
        level,
        color=GREY,
        alpha=0.3,
        linewidth=0,
    )
