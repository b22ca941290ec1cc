"""How far uncertain parameters move a trajectory."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Ellipse

from .._trajectory import Trajectory
from .._types import ArrayLike
from ._numbers import finite
from ._places import positions
from ._style import VERMILLION

# Of the largest variance: below that it is rounding.
_ROUNDING = 1e-9


def ellipses(
    ax: Axes,
    route: Trajectory,
    jacobian: ArrayLike,
    covariance: ArrayLike,
    *,
    probability: float = 0.95,
    every: int = 1,
    magnify: float = 1.0,
) -> Axes:
    """Draw where the nodes of a route lie, from above, if parameters are uncertain.

    To first order, for normally distributed parameters, each node lies in its ellipse
    with the probability given; nodes that nothing moves have none. The route is not
    drawn: [`top_view`][] does it.

    **Arguments:**

    - `route`: whose first two states are x and y [m], N nodes.
    - `jacobian`: of the positions by p parameters, shape (N, 2, p), or (N, 3, p) with
        an altitude, which is left out.
    - `covariance`: of the parameters, shape (p, p).
    - `probability`: above 0, below 1.
    - `every`: draws each node whose number it divides.
    - `magnify`: how much larger than to scale ellipses are; the legend says so.

    **Raises:** `ValueError` on shapes that do not agree, a covariance that is not
    symmetric or has a negative variance, and the rest out of range.
    """
    shape = np.shape(jacobian)
    place = positions(route)[:, :2]
    if len(shape) != 3 or shape[:1] != place.shape[:1] or shape[1] not in {2, 3}:
        raise ValueError(
            f"jacobian has shape {shape}: give ({len(place)}, 2, p), the derivatives of "
            "x and y at each node by p parameters."
        )
    slopes = finite("jacobian", jacobian, shape)[:, :2]
    spread = _checked(finite("covariance", covariance, (shape[2], shape[2])))
    if not 0.0 < probability < 1.0:
        raise ValueError(f"probability={probability:g}: give one above 0 and below 1.")
    if every < 1:
        raise ValueError(f"every={every}: give 1 for all nodes, or more.")
    if not 0.0 < magnify < np.inf:
        raise ValueError(f"magnify={magnify:g}: give a positive factor.")
    # The distribution of chi squared with two degrees of freedom, turned around.
    size = magnify * np.sqrt(-2.0 * np.log1p(-probability))
    variances, axes = np.linalg.eigh(slopes @ spread @ slopes.transpose(0, 2, 1))
    half = size * np.sqrt(np.maximum(variances, 0.0))
    look: dict[str, Any] = {
        "facecolor": (VERMILLION, 0.2),
        "edgecolor": VERMILLION,
        "linewidth": 0.8,
    }
    name: str | None = f"{100 * probability:g} %"
    if magnify != 1.0:
        name = f"{name}, {magnify:g} times as large"
    for node in range(0, len(place), every):
        if half[node].max() == 0.0:
            continue
        angle = np.degrees(np.arctan2(axes[node, 1, 1], axes[node, 0, 1]))
        extent = (2.0 * half[node, 1], 2.0 * half[node, 0])
        ax.add_patch(Ellipse(place[node], *extent, angle=angle, label=name, **look))
        name = None
    return ax


def _checked(covariance: np.ndarray) -> np.ndarray:
    scale = np.abs(covariance).max(initial=0.0)
    if not np.allclose(covariance, covariance.T, rtol=0.0, atol=_ROUNDING * scale):
        raise ValueError("covariance is not symmetric: give (A + A.T) / 2 of it.")
    least = float(np.linalg.eigvalsh(covariance).min(initial=0.0))
    if least < -_ROUNDING * scale:
        raise ValueError(
            f"covariance has the negative variance {least:g}: give a covariance, such "
            "as a diagonal of squared standard deviations."
        )
    return covariance
