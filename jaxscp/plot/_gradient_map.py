"""An objective and its gradient over two parameters."""

import numpy as np
from matplotlib.axes import Axes
from scipy.interpolate import CubicHermiteSpline, CubicSpline

from .._types import ArrayLike
from ._contours import filled_contours
from ._numbers import finite, rising
from ._style import BLACK

_POINTS = 121
# Room around the grid, and the longest arrow, in distances between its points.
_MARGIN, _LONGEST = 0.4, 0.75


def gradient_map(
    ax: Axes,
    x: ArrayLike,
    y: ArrayLike,
    values: ArrayLike,
    gradients: ArrayLike,
    *,
    labels: tuple[str, str, str] = ("x", "y", "objective"),
    same_unit: bool = True,
) -> Axes:
    """Draw an objective as filled contours, and its gradient as arrows, over a grid.

    Between the points of the grid the contours follow a cubic through values and
    gradients. The longest arrow is a little shorter than the distance between points.
    `Figure(layout="compressed")` leaves room for the colour bar.

    **Arguments:**

    - `x`, `y`: values of both parameters, rising, shapes (k,) and (l,).
    - `values`: the objective at each pair, shape (l, k): one row for each y.
    - `gradients`: its derivatives by x and y, shape (l, k, 2).
    - `labels`: of both axes and the colour bar, units in brackets.
    - `same_unit`: whether x and y have one unit and are drawn to one scale. Otherwise
        the Axes are square, and arrows point where the objective rises fastest on paper.

    **Raises:** `ValueError` on shapes that do not agree, x or y that do not rise, and
    numbers that are not finite.
    """
    x, y = rising("x", x), rising("y", y)
    values = finite("values", values, (y.size, x.size))
    gradients = finite("gradients", gradients, (y.size, x.size, 2))
    room = _MARGIN * np.array([np.diff(x).min(), np.diff(y).min()])
    fine_x, fine_y = (np.linspace(each[0], each[-1], _POINTS) for each in (x, y))
    surface = _surface(x, y, values, gradients, fine_x, fine_y)
    filled_contours(ax, fine_x, fine_y, surface, labels[2])
    if same_unit:
        ax.set_aspect("equal", adjustable="box")
        spans = np.ones(2)
    else:
        ax.set_box_aspect(1.0)
        spans = np.array([np.ptp(x), np.ptp(y)]) + 2.0 * room
    # A direction on paper is one in shares of both spans.
    arrows = gradients * spans**2
    lengths = np.linalg.norm(arrows / spans, axis=-1)
    longest = _LONGEST / _MARGIN * np.min(room / spans)
    arrows = arrows * (longest / lengths.max() if lengths.any() else 0.0)
    ax.quiver(
        *(*np.meshgrid(x, y), arrows[..., 0], arrows[..., 1]),
        angles="xy",
        scale_units="xy",
        scale=1.0,
        pivot="mid",
        color=BLACK,
        width=0.006,
    )
    ax.plot(*np.meshgrid(x, y), ".", color=BLACK, markersize=3)
    ax.set_xlim(x[0] - room[0], x[-1] + room[0])
    ax.set_ylim(y[0] - room[1], y[-1] + room[1])
    ax.set_xlabel(labels[0])
    ax.set_ylabel(labels[1])
    return ax


def _surface(
    x: np.ndarray,
    y: np.ndarray,
    values: np.ndarray,
    gradients: np.ndarray,
    fine_x: np.ndarray,
    fine_y: np.ndarray,
) -> np.ndarray:
    """Values between the points of the grid: cubics along rows, then along columns.

    Values and gradients at the points are met. The slopes across a row are cubic
    splines between its points.
    """
    rows = CubicHermiteSpline(x, values, gradients[..., 0], axis=1)(fine_x)
    across = CubicSpline(x, gradients[..., 1], axis=1)(fine_x)
    return CubicHermiteSpline(y, rows, across, axis=0)(fine_y)
