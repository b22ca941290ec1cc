"""Where the vehicle flies, in space."""

import numpy as np
from mpl_toolkits.mplot3d import Axes3D

from .._trajectory import Trajectory
from ..missions import Mission
from ._places import GUESS, Routes, buildings, landmarks, positions, styled
from ._style import GREY


def isometric(
    ax: Axes3D, mission: Mission, route: Routes, guess: Trajectory | None = None
) -> Axes3D:
    """Draw routes in space, as in the paper's figures, with their ground tracks.

    Buildings have no height in the model; they are drawn a little taller than the
    highest point of the routes. The vertical axis is stretched so that climbs show.

    **Arguments:** as [`top_view`][], and `ax` made with `projection="3d"`.
    """
    routes = styled(route)
    flown = np.vstack([positions(each) for each, _ in routes])
    finite = flown[np.isfinite(flown).all(axis=1)]
    points = np.vstack([finite, *(point for point, _ in landmarks(mission))])
    top = 1.15 * max(points[:, 2].max(), 1.0)
    for center, distance in buildings(mission):
        _cylinder(ax, center, distance, top)
    if guess is not None:
        ax.plot(*positions(guess).T, **GUESS)
    for each, style in routes:
        line = style.get("linestyle", "-")
        ground = positions(each)[:, :2].T
        ax.plot(*ground, 0.0, color=GREY, linewidth=1.0, linestyle=line)
        ax.plot(*positions(each).T, **style)
    for point, style in landmarks(mission):
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
