"""What a flight's control effort goes into."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.axes import Axes
from scipy.integrate import simpson

from .._solution import Solution
from .._types import Array
from ..missions import Mission
from ._style import BLACK, BLUE, GREEN, MINUS, ORANGE, label, typeset

# Points an interval, ends included: Simpson's rule is exact for the squares of controls
# that are constant or linear.
_POINTS = 9


def energy(ax: Axes, mission: Mission, solution: Solution) -> Axes:
    """Draw the running cost over time, split into hovering and manoeuvring.

    Hovering is what the vehicle would spend at rest; the rest is spent beyond that, or
    saved below it. The legend has the total of each: together they are the objective.

    **Arguments:**

    - `mission`: gives the vehicle and its hover control.
    - `solution`: of the mission's problem.
    """
    problem = solution.problem
    unit = problem.unit("objective")
    times, controls = _held(solution)
    # Where and when do not matter.
    instant = (jnp.zeros(()), solution.trajectory.states[0])
    cost = jax.vmap(lambda control: problem.running_cost(*instant, control))
    spent = np.asarray(cost(controls.reshape(-1, controls.shape[-1])))
    level = float(problem.running_cost(*instant, mission.vehicle.hover_control))
    beyond = np.maximum(spent - level, 0.0)
    below = np.minimum(spent - level, 0.0)
    areas: tuple[tuple[str, np.ndarray, float, dict[str, Any]], ...] = (
        ("hovering", np.full_like(spent, level), 0.0, {"color": BLUE, "alpha": 0.3}),
        ("beyond it", beyond, level, {"color": ORANGE, "alpha": 0.7}),
        ("below it", below, level, {"color": GREEN, "alpha": 0.6}),
    )
    moments = np.ravel(times)
    for name, height, base, look in areas:
        total = simpson(height.reshape(times.shape), x=times).sum()
        text = f"{name}: {total:,.0f} {typeset(unit)}".replace("-", MINUS)
        ax.fill_between(moments, base, base + height, linewidth=0, label=text, **look)
    ax.plot(moments, spent, color=BLACK, linewidth=0.9)
    ax.set_xlim(moments[0], moments[-1])
    ax.set_ylim(0.0, 1.05 * max(float(np.max(spent)), level))
    ax.set_xlabel("time [s]")
    ax.set_ylabel(label("control effort", unit.removesuffix(" s")))
    # There is room under the level of hovering.
    ax.legend(loc="lower right", fontsize="small")
    return ax


def _held(solution: Solution) -> tuple[np.ndarray, Array]:
    """Moments of each interval, (I, k) [s], and the controls then, (I, k, m)."""
    nodal, hold = solution.trajectory, solution.discretization.hold
    shares = jnp.linspace(0.0, 1.0, _POINTS)
    within = jax.vmap(hold.interpolate, (None, None, 0))
    controls = jax.vmap(within, (0, 0, None))(
        nodal.controls[:-1], nodal.controls[1:], shares
    )
    times = np.asarray(nodal.times)
    return times[:-1, None] + np.diff(times)[:, None] * np.asarray(shares), controls
