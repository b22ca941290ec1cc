"""What is watched between the nodes, and where along a step it is largest."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ._problem import OptimalControlProblem
from ._types import Array, Float

# Moments of a step compared before the best of them is refined, and Newton's steps.
_SAMPLES = 5
_REFINEMENTS = 3
# A share of a step within which they have found a peak.
_FOUND = 1e-6
# How far a peak may exceed its limit, in shares of the scale. Where nodes rest on a limit
# one after the other, the ripple between them would make twice as many constraints
# active as there are controls to meet them.
PEAK_TOLERANCE = 1e-6


class Watch(eqx.Module):
    """The quantities that must not rise above zero, in this order.

    - `lower`, `upper`: entries of the state with a lower or an upper limit: how far they
        are below or above it.
    - `path`: how many path constraints follow.
    """

    lower: tuple[int, ...] = eqx.field(static=True)
    upper: tuple[int, ...] = eqx.field(static=True)
    path: int = eqx.field(static=True)

    @classmethod
    def of(cls, problem: OptimalControlProblem) -> "Watch":
        lower, upper = (
            tuple(np.flatnonzero(limited).tolist()) for limited in problem.state.limited
        )
        return cls(lower, upper, sum(problem.path_sizes.values()))

    @property
    def limits(self) -> int:
        """How many of them are limits of the state."""
        return len(self.lower) + len(self.upper)

    @property
    def size(self) -> int:
        return self.limits + self.path

    @property
    def entries(self) -> np.ndarray:
        """The entry of the state each limit belongs to."""
        return np.array(self.lower + self.upper, int)

    def excess(
        self, problem: OptimalControlProblem, states: Float[Array, " limits"]
    ) -> Float[Array, " limits"]:
        """How far the watched entries of the state are beyond their limits."""
        below, above = np.array(self.lower, int), np.array(self.upper, int)
        split = len(self.lower)
        return jnp.concatenate(
            [
                problem.state.lower[below] - states[:split],
                states[split:] - problem.state.upper[above],
            ]
        )


def derivatives(
    function: Callable[[Float[Array, " e"]], Float[Array, " e"]],
    shares: Float[Array, " e"],
) -> tuple[Float[Array, " e"], Float[Array, " e"]]:
    """First and second derivative of each entry by its own share."""
    ones = jnp.ones_like(shares)

    def slope(at):
        return jax.jvp(function, (at,), (ones,))[1]

    return jax.jvp(slope, (shares,), (ones,))


def largest(
    function: Callable[[Float[Array, " e"]], Float[Array, " e"]],
    ends: Float[Array, "2"],
    size: int,
) -> Float[Array, " e"]:
    """The share between two ends at which each entry of a function is largest.

    An entry depends on its own share only. The best of a few samples is refined by
    Newton's method where it has a neighbour on either side.
    """
    samples = jnp.linspace(ends[0], ends[1], _SAMPLES)
    values = jax.vmap(lambda share: function(jnp.full(size, share)))(samples)
    shares, reach = samples[jnp.argmax(values, axis=0)], samples[1] - samples[0]
    low = jnp.maximum(shares - reach, ends[0])
    high = jnp.minimum(shares + reach, ends[1])

    # A loop, not its passes one by one: these take long to compile.
    def refined(_, shares):
        slope, bend = derivatives(function, shares)
        move = jnp.where(bend < 0.0, -slope / jnp.where(bend < 0.0, bend, 1.0), 0.0)
        # Towards the end of a stretch that only rises.
        move = jnp.where(bend < 0.0, move, jnp.sign(slope) * reach)
        return jnp.clip(shares + move, low, high)

    shares = jax.lax.fori_loop(0, _REFINEMENTS, refined, shares)
    return jax.lax.stop_gradient(shares)


def inner_peaks(slope: Float[Array, " e"], bend: Float[Array, " e"]) -> Array:
    """Where the first derivative vanishes and the second is negative."""
    return (bend < 0.0) & (jnp.abs(slope) <= _FOUND * jnp.abs(bend))


def moving(
    function: Callable[[Float[Array, " e"]], Float[Array, " e"]],
    shares: Float[Array, " e"],
) -> Float[Array, " e"]:
    """The same shares, which move with what the function depends on.

    Where a peak's slope vanishes it moves by what its slope changes by over its
    curvature. At the end of what is looked at it stays.
    """
    slope, bend = derivatives(function, shares)
    inner = inner_peaks(*jax.lax.stop_gradient((slope, bend)))
    move = -slope / jnp.where(inner, jax.lax.stop_gradient(bend), 1.0)
    move -= jax.lax.stop_gradient(move)
    return shares + jnp.where(inner, move, 0.0)
