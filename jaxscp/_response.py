"""How an optimum answers a change of parameters, on either side of where it stands.

Where a limit is weakly active, its multiplier and its slack both zero, the optimum has
one derivative to either side. Each is that of the active set that holds there: limits
whose multiplier would become negative let go, those that would be broken hold.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from ._compiler import compiled
from ._exchange import exchanged
from ._free_intervals import lowered
from ._kkt import of_inequalities, slacks
from ._limit_names import LimitName, flat, names_at
from ._outcome import moved
from ._per_limit import PerLimit
from ._regularity import Regularity, by_side
from ._sensitivity import optimal_point
from ._solution import Multipliers, Solution
from ._trajectory import Trajectory
from ._transcription import Transcription
from ._types import PyTree, Scalar

# Active sets tried, and rates that count as none, relative to the largest.
_TRIES = 30
_NONE = 1e-9


class Rates(eqx.Module):
    """Derivatives of a solution along a direction, field by field."""

    objective: Scalar
    trajectory: Trajectory
    integrals: dict[str, Scalar]
    multipliers: Multipliers


class Response(eqx.Module):
    """What moving parameters along a direction does, to first order.

    - `rates`: derivatives by the share of the direction that is gone; NaN where no active
        set was found that holds on that side.
    - `reach`: share of the direction at which the next limit begins or ceases to hold,
        negative behind, infinite where none does.
    - `next_limit`: which one; `None` if there is none.
    """

    rates: Rates
    reach: float = eqx.field(static=True)
    next_limit: LimitName | None

    def __str__(self) -> str:
        if not self.known:
            return "no active set was found that holds: the derivatives are not known"
        text = (
            f"objective {float(self.rates.objective):+.6g}, "
            f"final time {float(self.rates.trajectory.final_time):+.6g}; "
        )
        if self.next_limit is None:
            return text + "no limit changes"
        return f"{text}to {self.reach:+.3g} of the direction: {self.next_limit}"

    @property
    def known(self) -> bool:
        """Whether an active set was found that holds."""
        return bool(np.isfinite(flat(self.rates)).all())


def response(
    solution: Solution, standing: Regularity, tangent: PyTree, weak: float, side: int
) -> Response:
    """How the optimum moves ahead (`side` 1) or behind (-1).

    **Arguments:**

    - `tangent`: of the discrete problem. `weak`: margin of weakly active limits.
    """
    unravel = ravel_pytree(solution.optimum.sides)[1]
    for _ in range(_TRIES):
        rates, *changes = _rates(solution, tangent)
        if not np.isfinite(flat(rates)).all():
            break
        trends = [_Trend.of(solution, standing, changes, i, side) for i in (0, 1)]
        leaving = trends[0].leaving(weak) | trends[1].leaving(weak)
        entering = [limit for trend in trends if (limit := trend.entering(weak)).any()]
        optimum = solution.optimum
        if leaving.any():
            sides = jnp.asarray(np.where(leaving, 0.0, flat(optimum.sides)))
            optimum = eqx.tree_at(lambda o: o.sides, optimum, unravel(sides))
        elif entering:
            first = unravel(jnp.asarray(entering[0]))
            optimum = exchanged(solution.transcription, optimum, first)
        else:
            return Response(rates, *_next(solution, trends, weak, side))
        solution = eqx.tree_at(lambda s: s.optimum, solution, optimum)
    nothing = jax.tree.map(lambda leaf: jnp.full_like(leaf, jnp.nan), rates)
    return Response(nothing, side * np.inf, None)


@compiled
def _rates(
    solution: Solution, tangent: PyTree
) -> tuple[Rates, PerLimit, tuple[PerLimit, PerLimit]]:
    """Derivatives of the solution, and of the multipliers and slacks of its limits."""

    def of(transcription: Transcription):
        optimum = solution.optimum
        point = optimal_point(transcription, optimum)
        found = moved(transcription, solution, point)
        if solution.discretization.interval_ratio is not None:
            found = lowered(found, solution.problem)
        fields = (found.objective, found.trajectory, found.integrals, found.multipliers)
        ways = slacks(transcription, optimum, point.step)
        return Rates(*fields), of_inequalities(point), ways

    values, rates = eqx.filter_jvp(of, (solution.transcription,), (tangent,))
    # What cannot change has no rate.
    return eqx.combine(rates, jax.tree.map(jnp.zeros_like, values))


class _Trend(NamedTuple):
    """All lower or all upper limits in one row: how they stand and where they go.

    - `sign`: of their side: -1 for lower limits, whose multipliers are negative, or 1.
    - `multiplier`, `slack`: never negative. `grows`, `opens`: what they gain on the way.
    - `held`, `free`: whether the limit is active, and whether no limit of it is.
    """

    sign: int
    multiplier: np.ndarray
    slack: np.ndarray
    grows: np.ndarray
    opens: np.ndarray
    held: np.ndarray
    free: np.ndarray

    @classmethod
    def of(
        cls, solution: Solution, standing: Regularity, changes, limit: int, side: int
    ) -> "_Trend":
        sign, slack = (-1, 1)[limit], flat(standing.slacks[limit])
        grows = sign * side * flat(changes[0])
        # What there is no limit of has no way to it.
        opens = np.where(np.isfinite(slack), side * flat(changes[1][limit]), 0.0)
        # Those of the point, which exchanges may have changed.
        multiplier = flat(by_side(of_inequalities(solution.optimum.point))[limit])
        sides = flat(solution.optimum.sides)
        return cls(sign, multiplier, slack, grows, opens, sides == sign, sides == 0.0)

    def undecided(self, weak: float) -> np.ndarray:
        """Where neither the multiplier nor the slack is positive."""
        return np.maximum(self.multiplier, self.slack) <= weak

    def leaving(self, weak: float) -> np.ndarray:
        """Active limits whose multipliers become negative."""
        shrinks = self.grows < -_NONE * np.max(np.abs(self.grows))
        return self.undecided(weak) & self.held & shrinks

    def entering(self, weak: float) -> np.ndarray:
        """Its sign where the limit is that would be broken most, zero elsewhere."""
        closes = self.opens < -_NONE * np.max(np.abs(self.opens))
        broken = np.where(self.undecided(weak) & self.free & closes, self.opens, 0.0)
        first = np.arange(broken.size) == np.argmin(broken)
        return np.where(first & (broken < 0.0), self.sign, 0.0)

    def shares(self, weak: float) -> np.ndarray:
        """Share of the way at which each limit begins or ceases to hold."""
        value = np.where(self.held, self.multiplier, self.slack)
        rate = np.where(self.held, self.grows, self.opens)
        nearing = np.isfinite(self.slack) & ~self.undecided(weak) & (rate < 0.0)
        return np.where(nearing, value, np.inf) / np.where(nearing, -rate, 1.0)


def _next(
    solution: Solution, trends: list[_Trend], weak: float, side: int
) -> tuple[float, LimitName | None]:
    """When the active set changes next, and by which limit."""
    shares = [trend.shares(weak) for trend in trends]
    limit = int(np.argmin([np.min(each) for each in shares]))
    first = int(np.argmin(shares[limit]))
    nearest = float(shares[limit][first])
    if not nearest < np.inf:
        return side * np.inf, None
    only = np.arange(shares[limit].size) == first
    return side * nearest, names_at(solution, limit, only)[0]
