"""What a requirement costs."""

import numpy as np
from matplotlib.axes import Axes
from scipy.interpolate import CubicHermiteSpline

from .._types import ArrayLike
from ._numbers import finite, rising
from ._style import BLUE, GREY, ORANGE

# How far a tangent reaches to either side, in distances to the next point, and points
# of the curve.
_REACH, _POINTS = 0.3, 400


def pareto(
    ax: Axes,
    values: ArrayLike,
    objectives: ArrayLike,
    slopes: ArrayLike,
    *,
    requirement: str = "requirement",
    objective: str = "objective",
) -> Axes:
    """Draw a front: the objective against a requirement, with its slopes as tangents.

    A curve of third order leads through the points, in the directions of the slopes.

    **Arguments:**

    - `values`: of the requirement, rising, shape (k,), k >= 2.
    - `objectives`: the optimum at each, shape (k,). `slopes`: their derivatives by the
        requirement, shape (k,), as from [`jaxscp.shadow_prices`][].
    - `requirement`, `objective`: what the axes are called, units in brackets.

    **Raises:** `ValueError` on shapes that do not agree, values that do not rise, and
    numbers that are not finite.
    """
    x = rising("values", values)
    y = finite("objectives", objectives, x.shape)
    slope = finite("slopes", slopes, x.shape)
    fine = np.linspace(x[0], x[-1], _POINTS)
    curve = CubicHermiteSpline(x, y, slope)(fine)
    ax.plot(fine, curve, color=GREY, linewidth=1.0, label="cubics in between")
    gaps = np.diff(x)
    reach = _REACH * np.minimum(np.append(gaps, gaps[-1]), np.append(gaps[0], gaps))
    rise = slope * reach
    ends = np.stack([x - reach, x + reach]), np.stack([y - rise, y + rise])
    first, *_ = ax.plot(*ends, color=ORANGE, linewidth=2.0, solid_capstyle="butt")
    first.set_label("exact slopes")
    ax.plot(x, y, "o", color=BLUE, markersize=5, label="solutions")
    ax.set_xlabel(requirement)
    ax.set_ylabel(objective)
    ax.legend()
    return ax
