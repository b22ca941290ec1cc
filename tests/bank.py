"""Problems with known optima, each with what a solve of it must find.

The figures come from the literature or from algebra, never from this library.
"""

import dataclasses
import math
from collections.abc import Callable

import jax.numpy as jnp
import numpy as np

from jaxscp import (
    AbstractHold,
    FirstOrderHold,
    OptimalControlProblem,
    Solution,
    Trajectory,
    ZeroOrderHold,
    straight_line,
    textbook,
    through_waypoints,
)


@dataclasses.dataclass(frozen=True)
class Known:
    """A problem and its optimum.

    - `build`: makes the problem.
    - `hold`, `nodes`: the discretization whose optimum is closest to the true one. Tests
        of derivatives share it, as another would be compiled anew.
    - `objective`: the optimum of the continuous problem.
    - `tolerance`: relative distance from it that this discretization explains.
    - `source`: where the figure comes from.
    - `guess`: where a solve starts.
    """

    name: str
    build: Callable[[], OptimalControlProblem]
    hold: AbstractHold
    nodes: int | np.ndarray
    objective: float
    tolerance: float
    source: str
    guess: Callable[[OptimalControlProblem, int | np.ndarray], Trajectory] = straight_line


def steps(solution: Solution) -> int:
    """Of the method, in all."""
    statistics = solution.statistics
    return int(statistics.iterations) + int(statistics.polish_iterations)


def hypersensitive_optimum(start: float, end: float, duration: float) -> float:
    """Half the integral of x^2 + u^2 for x' = -x + u between two given ends.

    Substituting u = x' + x leaves x'^2 + 2 x^2 + (x^2)', and x'' = 2 x.
    """
    s = math.sqrt(2.0)
    sinh, cosh = math.sinh(s * duration), math.cosh(s * duration)
    quadratic = s * (cosh * (start**2 + end**2) - 2 * start * end) / sinh
    return 0.5 * (quadratic + end**2 - start**2)


def bryson_denham_optimum(limit: float) -> float:
    """Bryson, Denham and Dreyfus (1963): free, touching, and resting on the limit."""
    if limit >= 1 / 4:
        return 2.0
    if limit >= 1 / 6:
        return 2 + 6 * (1 - 4 * limit) ** 2
    return 4 / (9 * limit)


def nodes_at(limit: float) -> np.ndarray:
    """Nine nodes, where Bryson and Denham's acceleration has its kinks."""
    touch = 3 * limit
    if touch >= 0.5:
        return np.linspace(0, 1, 9)
    parts = (0, touch, 4), (touch, 1 - touch, 3), (1 - touch, 1, 4)
    return np.unique(np.concatenate([np.linspace(*part) for part in parts]))


def cycloid_time(width: float, drop: float, gravity: float) -> float:
    """Least time of descent: solve (1 - cos p) width = (p - sin p) drop for p."""

    def residual(p: float) -> float:
        return (p - math.sin(p)) * drop - (1 - math.cos(p)) * width

    low, high = 1e-3, 2 * math.pi - 1e-3
    for _ in range(200):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if residual(middle) < 0 else (low, middle)
    radius = drop / (1 - math.cos(low))
    return low * math.sqrt(radius / gravity)


def _down_a_straight_wire(
    problem: OptimalControlProblem, nodes: int | np.ndarray
) -> Trajectory:
    """At rest nothing moves whatever the angle: the bead must be guessed in motion."""
    ends = jnp.array([[0.0, 10.0, 0.0], [10.0, 5.0, math.sqrt(2 * 9.81 * 5.0)]])
    angle = jnp.array([math.atan2(10.0, 5.0)])
    return through_waypoints(problem, ends, nodes=nodes, final_time=2.0, control=angle)


def _double_integrators() -> list[Known]:
    return [
        # The optimal acceleration is linear in time: first-order hold has it exactly.
        Known(
            "minimum-energy",
            lambda: textbook.minimum_energy_double_integrator(3.0, 2.0),
            FirstOrderHold(),
            7,
            12 * 3.0**2 / 2.0**3,
            1e-8,
            "12 d^2 / T^3, from linear costates",
        ),
        # An even number of intervals puts a node where the bang-bang control switches.
        Known(
            "minimum-time",
            lambda: textbook.minimum_time_double_integrator(3.0, 2.0),
            ZeroOrderHold(),
            7,
            2 * math.sqrt(3.0 / 2.0),
            1e-8,
            "2 sqrt(d / a), full acceleration and full braking",
        ),
    ]


def _bryson_denham(name: str, limit: float, tolerance: float) -> Known:
    return Known(
        f"bryson-denham-{name}",
        lambda: textbook.bryson_denham(limit),
        FirstOrderHold(),
        nodes_at(limit),
        bryson_denham_optimum(limit),
        tolerance,
        "Bryson, Denham and Dreyfus, AIAA Journal 1 (1963)",
    )


BANK: tuple[Known, ...] = (
    *_double_integrators(),
    Known(
        "brachistochrone",
        lambda: textbook.brachistochrone(9.81),
        FirstOrderHold(),
        # Along a cycloid the wire's direction turns evenly: linear in time.
        21,
        cycloid_time(10.0, 5.0, 9.81),
        1e-7,
        "cycloid through both ends, Bernoulli (1697)",
        guess=_down_a_straight_wire,
    ),
    Known(
        "hypersensitive",
        lambda: textbook.hypersensitive(10.0),
        FirstOrderHold(),
        101,
        hypersensitive_optimum(1.5, 1.0, 10.0),
        1e-6,
        "linear-quadratic with both ends given",
    ),
    _bryson_denham("free", 0.3, 1e-7),
    # Nodes at 1/2, where the limit is touched, and at 3l and 1 - 3l, where it is
    # reached and left. While resting, the limit holds at nodes only.
    _bryson_denham("touching", 0.2, 1e-7),
    _bryson_denham("resting", 0.1, 1e-6),
)
