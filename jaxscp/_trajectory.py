"""`Trajectory`: nodal values over a time grid, and the guesses a solve starts from."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from ._problem import OptimalControlProblem
from ._tree import as_floats
from ._types import Array, ArrayLike, Float, Scalar, is_concrete


class Trajectory(eqx.Module):
    """States and controls at the nodes of a time grid.

    - `fractions`: normalized time of each node, from 0 to 1 (paper, Section III-A).
    - `states`, `controls`: nodal values. Under a zero-order hold the control of the last
        node repeats the one before it: it acts on no interval.
    - `final_time`: flight time T [s].
    """

    fractions: Float[Array, " N"] = eqx.field(converter=as_floats)
    states: Float[Array, "N n"] = eqx.field(converter=as_floats)
    controls: Float[Array, "N m"] = eqx.field(converter=as_floats)
    final_time: Scalar = eqx.field(converter=as_floats)

    @property
    def times(self) -> Float[Array, " N"]:
        """Time of each node [s]."""
        return self.final_time * self.fractions

    @property
    def nodes(self) -> int:
        """Their number, N."""
        return self.fractions.shape[0]


def time_grid(nodes: int | ArrayLike) -> Float[Array, " N"]:
    """Normalized node times: evenly spaced for a number, checked for a vector.

    **Raises:** `ValueError` for fewer than two nodes, or fractions that do not rise
    strictly from 0 to 1.
    """
    if isinstance(nodes, (int, np.integer)):
        if nodes < 2:
            raise ValueError(f"nodes={nodes}: a grid needs at least 2 nodes.")
        return as_floats(np.linspace(0.0, 1.0, int(nodes)))
    fractions = as_floats(nodes)
    if fractions.ndim == 0:
        raise ValueError(f"nodes={nodes}: give a whole number, or a vector of fractions.")
    if fractions.ndim != 1 or fractions.size < 2:
        raise ValueError(
            f"nodes has shape {fractions.shape}: give a number of nodes, or a vector of "
            "at least 2 fractions from 0 to 1."
        )
    if is_concrete(fractions):
        values = np.asarray(fractions)
        stuck = ~(np.diff(values) > 0)
        if stuck.any():
            at = int(np.argmax(stuck))
            raise ValueError(
                f"nodes[{at + 1}]={values[at + 1]:g} follows {values[at]:g}: fractions "
                "must rise strictly from 0 to 1; sort them and drop repeated ones."
            )
        if abs(values[0]) > 1e-12 or abs(values[-1] - 1) > 1e-12:
            raise ValueError(
                f"nodes run from {values[0]:g} to {values[-1]:g}: fractions must rise "
                "from 0 to 1; subtract the first and divide by the last."
            )
    return fractions


def straight_line(
    problem: OptimalControlProblem,
    nodes: int | ArrayLike = 50,
    *,
    final_time: ArrayLike | None = None,
    control: ArrayLike | None = None,
) -> Trajectory:
    """The paper's guess: states interpolated between both ends (paper, eqs. 10, 11).

    **Arguments:**

    - `nodes`: number of nodes, or their fractions of the flight time, 0 to 1.
    - `final_time`: guessed flight time [s]; the middle of its range by default.
    - `control`: one control, shape (m,), kept throughout, or the first and last, shape
        (2, m); by default zero, or the nearest limit.

    **Raises:** `ValueError` if no flight time is given and its range is infinite.
    """
    nodes = time_grid(nodes)
    start = _boundary(problem, "initial_state")
    goal = _boundary(problem, "final_state")
    # An end that leaves an entry open takes the other end's value.
    start, goal = (
        jnp.where(jnp.isnan(start), jnp.where(jnp.isnan(goal), 0.0, goal), start),
        jnp.where(jnp.isnan(goal), jnp.where(jnp.isnan(start), 0.0, start), goal),
    )
    return through_waypoints(
        problem,
        jnp.stack([start, goal]),
        nodes=nodes,
        final_time=final_time,
        control=control,
    )


def through_waypoints(
    problem: OptimalControlProblem,
    waypoints: ArrayLike,
    *,
    nodes: int | ArrayLike = 50,
    loiter: ArrayLike | None = None,
    final_time: ArrayLike | None = None,
    control: ArrayLike | None = None,
) -> Trajectory:
    """Straight legs through whole states, with a stay at each of them.

    **Arguments:**

    - `waypoints`: states to pass, first and last included, shape (k, n), k >= 2.
    - `loiter`: seconds to stay at each waypoint, length k; none by default. The legs
        share the rest of the flight time by their lengths, measured entry by entry in
        units of the largest distance covered.
    - `nodes`, `final_time`, `control`: as in [`straight_line`][].

    **Raises:** `ValueError` on wrong shapes, or if the stays exceed the flight time.
    """
    fractions = time_grid(nodes)
    points = as_floats(waypoints)
    if points.ndim != 2 or points.shape[0] < 2 or points.shape[1] != problem.state_size:
        raise ValueError(
            f"waypoints has shape {points.shape}: give at least two states of "
            f"{problem.state_size} entries, first and last included."
        )
    total = _flight_time(problem, final_time)
    stays = jnp.zeros(points.shape[0]) if loiter is None else as_floats(loiter)
    if stays.shape != points.shape[:1]:
        raise ValueError(
            f"loiter has shape {stays.shape}: give the seconds to stay at each of the "
            f"{points.shape[0]} waypoints."
        )
    transit = total - jnp.sum(stays)
    if is_concrete(transit) and float(transit) <= 0:
        raise ValueError(
            f"loiter={np.asarray(stays)} adds up to more than the flight time of "
            f"{float(total):g} s; lengthen final_time or shorten the stays."
        )
    steps = jnp.abs(jnp.diff(points, axis=0))
    largest = jnp.max(steps, axis=0)
    lengths = jnp.linalg.norm(steps / jnp.where(largest > 0, largest, 1.0)[None], axis=1)
    # Waypoints that all coincide share the time evenly.
    lengths = jnp.where(jnp.sum(lengths) > 0, lengths, 1.0)
    legs = transit * lengths / jnp.sum(lengths)
    arrivals = jnp.concatenate([jnp.zeros(1), jnp.cumsum(legs + stays[:-1])])
    knots = jnp.stack([arrivals, arrivals + stays], axis=1).ravel()
    times = total * fractions
    held = jnp.repeat(points, 2, axis=0)
    states = jnp.stack([jnp.interp(times, knots, column) for column in held.T], axis=1)
    return Trajectory(
        fractions=fractions,
        states=states,
        controls=_guessed_controls(problem, fractions, control),
        final_time=total,
    )


def _boundary(problem: OptimalControlProblem, side: str) -> Float[Array, " n"]:
    """Middle of a boundary's range, its finite end if it has one, else NaN."""
    bounds = getattr(problem, side)
    low, high = bounds.lower, bounds.upper
    one_sided = jnp.where(
        jnp.isfinite(low), low, jnp.where(jnp.isfinite(high), high, jnp.nan)
    )
    return jnp.where(
        jnp.isfinite(low) & jnp.isfinite(high), 0.5 * (low + high), one_sided
    )


def _flight_time(problem: OptimalControlProblem, final_time: ArrayLike | None) -> Scalar:
    bounds = problem.final_time
    if final_time is not None:
        return as_floats(final_time)
    if is_concrete(bounds.upper) and not np.isfinite(bounds.upper):
        raise ValueError(
            f"final_time is free up to {float(bounds.upper)}: give the guess a flight "
            "time, final_time=..., in seconds."
        )
    return bounds.target


def _guessed_controls(
    problem: OptimalControlProblem,
    fractions: Float[Array, " N"],
    control: ArrayLike | None,
) -> Float[Array, "N m"]:
    size = problem.control_size
    if control is None:
        control = problem.control.clip(jnp.zeros(size))
    values = as_floats(control)
    if values.shape not in {(size,), (2, size)}:
        raise ValueError(
            f"control has shape {values.shape}: give one control of {size} entries, or "
            f"the first and the last, shape (2, {size})."
        )
    ends = jnp.broadcast_to(values, (2, size))
    return ends[:1] + fractions[:, None] * (ends[1:] - ends[:1])
