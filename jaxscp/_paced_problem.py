r"""A problem by the share of its intervals that has passed, a clock among its states.

$$\frac{dx}{ds} = e^p f(t, x, u), \quad \frac{dt}{ds} = e^p, \quad \frac{dp}{ds} = w,
  \quad |w| \le (N - 1) \log r$$

Evenly spaced s are then intervals of free durations: the one that starts at pace p lasts
$e^p (e^a - 1) / (a (N - 1))$ seconds with $a = w / (N - 1)$. That differs from the next
one's by a factor of at most r: by exactly that where both a are at the same limit. Held
controls are held all the same, so that nothing else about the flight changes.
"""

import math
from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp

from ._bounds import Bounds
from ._problem import Integral, OptimalControlProblem
from ._types import Array, Float, Scalar, State, TimeStateControl

# What comes behind the problem's own states, and behind its own controls.
PACE_STATES, PACE_CONTROLS = ("time", "pace"), ("change of pace",)
_TIME, _PACE = -2, -1
# Typical size of the pace and, in shares of its limit, of its change. Both are larger
# than what is likely: the trust region must not hold the grid back. The cost's scale,
# which all tolerances are relative to, grows with the square of the first.
_PACE_SCALE, _CHANGE_SCALE = 10.0, 3.0


class Paced(eqx.Module):
    """A function of (t, x, u), the time taken from the clock."""

    function: TimeStateControl

    def __call__(self, s: Scalar, x: State, u: Array) -> Array:
        del s
        return self.function(x[_TIME], x[:_TIME], u[:-1])


class PacedRate(eqx.Module):
    """A rate by the second, made one by the share."""

    function: TimeStateControl

    def __call__(self, s: Scalar, x: State, u: Array) -> Array:
        return jnp.exp(x[_PACE]) * Paced(self.function)(s, x, u)


class PacedDynamics(eqx.Module):
    """Dynamics with those of the clock and the pace."""

    function: TimeStateControl

    def __call__(self, s: Scalar, x: State, u: Array) -> State:
        own = PacedRate(self.function)(s, x, u)
        return jnp.concatenate([own, jnp.exp(x[_PACE])[None], u[-1:]])


class PacedCost(eqx.Module):
    """A running cost with the price of changing the pace.

    - `steepest`: largest change of the pace. `price`: of keeping to it throughout.
    """

    function: TimeStateControl
    steepest: Scalar
    price: Scalar

    def __call__(self, s: Scalar, x: State, u: Array) -> Scalar:
        return PacedRate(self.function)(s, x, u) + self.of_change(u[-1])

    def of_change(self, change: Scalar) -> Scalar:
        """What the objective owes to the grid alone, by the share."""
        return self.price * (change / self.steepest) ** 2


class PacedEnd(eqx.Module):
    """A terminal cost, the time taken from the clock."""

    function: Callable[[Scalar, State], Array]

    def __call__(self, s: Scalar, x: State) -> Array:
        del s
        return self.function(x[_TIME], x[:_TIME])


def paced_problem(
    problem: OptimalControlProblem,
    intervals: int,
    ratio: float,
    *,
    duration: Scalar,
    longest: Scalar,
    price: Scalar,
) -> OptimalControlProblem:
    """The problem by shares of its intervals.

    **Arguments:**

    - `intervals`: how many there are. `ratio`: of the durations of two neighbours.
    - `duration`: typical flight time [s], if the problem states none.
    - `longest`: longest interval [s], for intervals whose pace does not change.
    - `price`: of changing the pace as fast as allowed, all the way, in the cost's unit.
    """
    steepest = jnp.asarray(intervals * math.log(ratio))
    total = problem.final_time
    scale = duration if total.scale is None else total.scale
    anything = Bounds.free(1)
    return OptimalControlProblem(
        PacedDynamics(problem.dynamics),
        state=problem.state.followed_by(
            Bounds(
                jnp.full(2, -jnp.inf),
                jnp.stack([jnp.asarray(jnp.inf), jnp.log(longest * intervals)]),
                scale=jnp.stack([scale, jnp.asarray(_PACE_SCALE)]),
                fixed=(False, False),
                # Between the nodes the pace changes evenly: nothing to watch.
                limited=((False, False), (False, False)),
            )
        ),
        control=problem.control.followed_by(
            Bounds(
                -steepest[None],
                steepest[None],
                scale=_CHANGE_SCALE * steepest[None],
                fixed=(False,),
            )
        ),
        initial_state=problem.initial_state.followed_by(
            Bounds.exactly(jnp.zeros(1)).followed_by(anything)
        ),
        final_state=problem.final_state.followed_by(total.followed_by(anything)),
        final_time=Bounds.exactly(1.0),
        running_cost=PacedCost(problem.running_cost, steepest, price),
        terminal_cost=PacedEnd(problem.terminal_cost),
        path_constraints={
            name: Paced(constraint)
            for name, constraint in problem.path_constraints.items()
        },
        integrals={
            name: Integral(PacedRate(integral.integrand), integral.bounds)
            for name, integral in problem.integrals.items()
        },
        state_names=problem.state_names + PACE_STATES,
        control_names=problem.control_names + PACE_CONTROLS,
        units={"time": "s", **dict(problem.units)},
    )


def durations(pace: Float[Array, " N"]) -> Float[Array, " I"]:
    """Seconds of each interval: the pace changes evenly along it."""
    rise = jnp.diff(pace)
    flat = jnp.abs(rise) < 1e-5
    # Divided by a number that is never small: the other branch is computed as well.
    safe = jnp.where(flat, 1.0, rise)
    mean = jnp.where(flat, 1.0 + 0.5 * rise, jnp.expm1(safe) / safe)
    return jnp.exp(pace[:-1]) * mean / rise.size
