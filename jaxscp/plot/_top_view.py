"""Where the vehicle flies, from above."""

import jax.numpy as jnp
import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Circle

from .._trajectory import Trajectory
from ..missions import Mission
from ..models.channel import Channel
from ._contours import filled_contours
from ._places import GUESS, Routes, buildings, landmarks, positions, styled
from ._style import DARK, GREY, MEGA

# Points along each side of the map, and what it shows around the flight, as a share.
_POINTS, _MARGIN = 161, 0.06


def top_view(
    ax: Axes,
    mission: Mission,
    route: Routes,
    guess: Trajectory | None = None,
    *,
    rate_altitude: float | None = None,
) -> Axes:
    """Draw routes from above, as in the paper's figures.

    **Arguments:**

    - `mission`: gives buildings with safe circles, ground station, start and goal.
    - `route`: a trajectory whose first three states are the position [m], or several by
        name, which `ax.legend()` shows: solid, dashed, dash-dotted.
    - `guess`: a trajectory to draw dotted.
    - `rate_altitude`: draws the data rate at this altitude [m] underneath, and a colour
        bar, for which `Figure(layout="compressed")` leaves room.

    **Raises:** `ValueError` if there is no route, or the altitude is not finite.
    """
    routes = styled(route)
    if rate_altitude is not None and not np.isfinite(rate_altitude):
        raise ValueError(f"rate_altitude={rate_altitude}: give a finite altitude [m].")
    on_map = rate_altitude is not None
    shade = DARK if on_map else GREY
    for center, distance in buildings(mission):
        ax.add_patch(Circle(center, distance, color=shade, alpha=0.35, linewidth=0))
        ax.add_patch(Circle(center, distance, fill=False, color=shade))
        ax.plot(*center, "s", color=shade, markersize=7)
    if guess is not None:
        ax.plot(*positions(guess)[:, :2].T, **GUESS)
    for flown, style in routes:
        path = positions(flown)[:, :2].T
        if on_map:
            ax.plot(*path, color="white", linewidth=style["linewidth"] + 1.6)
        ax.plot(*path, **style)
    for point, style in landmarks(mission):
        ax.plot(*point[:2], **style)
    if rate_altitude is None:
        ax.set_aspect("equal", adjustable="datalim")
    else:
        _rate_map(ax, mission.channel, float(rate_altitude))
    ax.set_xlabel("x [m]")
    ax.set_ylabel("y [m]")
    return ax


def _rate_map(ax: Axes, channel: Channel, altitude: float) -> None:
    """The data rate around what has been drawn, which fills the Axes."""
    corners = ax.dataLim.get_points()
    margin = _MARGIN * max(float(np.max(np.diff(corners, axis=0))), 10.0)
    low, high = corners[0] - margin, corners[1] + margin
    x, y = np.linspace(low, high, _POINTS).T
    grid = np.stack([*np.meshgrid(x, y), np.full((_POINTS, _POINTS), altitude)], axis=-1)
    rates = np.asarray(channel.rate(jnp.asarray(grid))) / MEGA
    filled_contours(ax, x, y, rates, f"data rate at {altitude:g} m [Mbit/s]")
    ax.set_aspect("equal", adjustable="box")
    ax.set_xlim(low[0], high[0])
    ax.set_ylim(low[1], high[1])
