"""Limits of a problem checked on samples of a trajectory, for `verify` alone."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ._bounds import Bounds
from ._problem import OptimalControlProblem, entry_name

# A state that hardly moves is measured by this share of its typical size, or of the
# range of its limits (of the largest range covered, or one unit, if they lie farther
# apart), or, lacking both, of one unit (of the largest range covered, if that is
# smaller). Noise must not pass for motion, and a solver whose tolerances are relative to
# a state's scale does no better on a state that stays near zero.
LEAST_MOTION = 0.2
# Limits farther apart than so many ranges covered do not tell how large a breach is.
MOST_MOTIONS = 10.0
# A path constraint that hardly changes is measured by this, in its own unit.
LEAST_PATH_RANGE = 0.1


@dataclasses.dataclass(frozen=True)
class Violation:
    """The worst breach of one limit.

    - `value`: amount by which it is broken, positive; infinite where the quantity is
        not a number.
    - `unit`: its unit, "" if the problem does not name one.
    - `time`: when [s].
    """

    value: float
    unit: str
    time: float

    def __str__(self) -> str:
        amount = f"{self.value:.3g} {self.unit}".rstrip()
        return f"{amount} at {self.time:.3f} s"


@dataclasses.dataclass(frozen=True)
class Points:
    """Moments of a trajectory, with the path constraints' values."""

    times: Float[np.ndarray, " K"]
    states: Float[np.ndarray, "K n"]
    controls: Float[np.ndarray, "K m"]
    path: dict[str, Float[np.ndarray, "K _"]]

    @classmethod
    def of(
        cls,
        problem: OptimalControlProblem,
        times: Float[np.ndarray, " K"],
        states: Float[np.ndarray, "K n"],
        controls: Float[np.ndarray, "K m"],
    ) -> "Points":
        values = _path_values(problem, times, states, controls)
        path = {name: np.asarray(values[name]) for name in problem.path_constraints}
        return cls(times, states, controls, path)

    def first(self, count: int) -> "Points":
        """The first `count` of them."""
        return Points(
            self.times[:count],
            self.states[:count],
            self.controls[:count],
            {name: values[:count] for name, values in self.path.items()},
        )


def range_of_limits(
    bounds: Bounds, values: Float[np.ndarray, "K n"]
) -> Float[np.ndarray, " n"]:
    """What a breach is measured by: limits' range, typical size or range covered.

    Limits far beyond what is covered only say that there are none on that side.
    """
    width, typical = _width_and_typical(bounds)
    motion = range_of_motion(bounds, values)
    near = np.minimum(width, MOST_MOTIONS * motion)
    return np.where(width > 0, near, np.where(typical > 0, typical, motion))


def range_of_motion(
    bounds: Bounds, values: Float[np.ndarray, "K n"]
) -> Float[np.ndarray, " n"]:
    """Range that the values cover, with a floor for entries that hardly move."""
    covered = np.nan_to_num(np.ptp(values, axis=0), nan=0.0, posinf=0.0)
    width, typical = _width_and_typical(bounds)
    largest = np.max(covered)
    unit = min(1.0, largest) or 1.0
    near = np.minimum(width, max(1.0, largest))
    size = np.where(typical > 0, typical, np.where(width > 0, near, unit))
    return np.maximum(covered, LEAST_MOTION * size)


def path_ranges(nodes: Points) -> dict[str, Float[np.ndarray, " _"]]:
    """Range that each path constraint covers over the nodes."""
    return {
        name: np.maximum(np.nan_to_num(np.ptp(g, axis=0), posinf=0.0), LEAST_PATH_RANGE)
        for name, g in nodes.path.items()
    }


def broken_limits(
    problem: OptimalControlProblem,
    points: Points,
    allowed_state: Float[np.ndarray, " n"],
    allowed_control: Float[np.ndarray, " m"],
    allowed_path: dict[str, Float[np.ndarray, " _"]],
) -> dict[str, Violation]:
    """Limits on states and controls and path constraints, wherever they are sampled."""
    times = points.times
    found = _worst(
        problem,
        problem.state_names,
        _excess(problem.state, points.states),
        times,
        allowed_state,
    )
    controls = _worst(
        problem,
        problem.control_names,
        _excess(problem.control, points.controls),
        times,
        allowed_control,
    )
    found |= controls
    for name, g in points.path.items():
        entries = [entry_name(name, j, g.shape[1]) for j in range(g.shape[1])]
        broken = _worst(
            problem, entries, g, times, allowed_path[name], problem.unit(name)
        )
        # A path constraint may bear the name of a state or control.
        found |= {f"path {key}" if key in found else key: v for key, v in broken.items()}
    return found


def broken_boundaries(
    problem: OptimalControlProblem,
    nodes: Points,
    allowed: Float[np.ndarray, " n"],
    tolerance: float,
) -> dict[str, Violation]:
    """First state, last state and flight time."""
    found: dict[str, Violation] = {}
    for side, bounds, node in (
        ("initial", problem.initial_state, slice(0, 1)),
        ("final", problem.final_state, slice(-1, None)),
    ):
        broken = _worst(
            problem,
            problem.state_names,
            _excess(bounds, nodes.states[node]),
            nodes.times[node],
            allowed,
        )
        found |= {f"{side} {name}": violation for name, violation in broken.items()}
    final_time = float(nodes.times[-1])
    amount = _relative_breach(problem.final_time, final_time, final_time, tolerance)
    if amount > 0:
        found["final_time"] = Violation(amount, "s", final_time)
    return found


def broken_integrals(
    problem: OptimalControlProblem,
    totals: dict[str, float],
    sizes: dict[str, float],
    final_time: float,
    tolerance: float,
) -> dict[str, Violation]:
    """Totals of the integrals; `sizes` measure a limit of zero."""
    found = {}
    for name, integral in problem.integrals.items():
        total = totals[name]
        amount = _relative_breach(integral.bounds, total, sizes[name], tolerance)
        if amount > 0:
            found[name] = Violation(amount, problem.unit(name), final_time)
    return found


def _relative_breach(bounds: Bounds, value: float, size: float, tolerance: float):
    """Amount by which a scalar breaks a limit, 0 if less than is tolerated."""
    if not np.isfinite(value):
        return np.inf
    worst = 0.0
    for sign, limit in ((-1.0, bounds.lower), (1.0, bounds.upper)):
        limit = np.asarray(limit).item()
        amount = sign * (value - limit)
        if amount > tolerance * (abs(limit) or abs(size) or 1.0):
            worst = max(worst, amount)
    return worst


def _worst(problem, names, excess, times, allowed, unit=None) -> dict[str, Violation]:
    """Per column the largest excess, where it is more than allowed."""
    excess = np.where(np.isnan(excess), np.inf, excess)
    rows = np.argmax(excess, axis=0)
    return {
        name: Violation(
            float(excess[rows[j], j]),
            problem.unit(name) if unit is None else unit,
            float(times[rows[j]]),
        )
        for j, name in enumerate(names)
        if excess[rows[j], j] > allowed[j]
    }


def _excess(bounds: Bounds, values: np.ndarray) -> np.ndarray:
    """Amount by which values are outside; negative inside, NaN where they are."""
    lower, upper = np.asarray(bounds.lower), np.asarray(bounds.upper)
    return np.maximum(lower - values, values - upper)


def _width_and_typical(bounds: Bounds) -> tuple[np.ndarray, np.ndarray]:
    """Finite distance between the limits and typical size, 0 where there is none."""
    width = np.asarray(bounds.upper) - np.asarray(bounds.lower)
    typical = np.zeros(1) if bounds.scale is None else np.asarray(bounds.scale)
    return (
        np.where(np.isfinite(width), width, 0.0),
        np.broadcast_to(np.where(np.isfinite(typical), typical, 0.0), width.shape),
    )


@eqx.filter_jit
def _path_values(problem, times, states, controls):
    def at_once(t, x, u):
        return {
            name: jnp.ravel(constraint(t, x, u))
            for name, constraint in problem.path_constraints.items()
        }

    return jax.vmap(at_once)(times, states, controls)
