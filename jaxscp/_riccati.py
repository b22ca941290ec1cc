"""Equality-constrained quadratic programs along linearized dynamics, stage by stage.

    minimize 1/2 z'Hz + g'z  subject to the linearized dynamics, some variables forced

A Riccati recursion from the last node to the first eliminates one stage after the other.
It needs no convexity but along the dynamics, and tells whether there is any. Its cost is
linear in the number of nodes; once it is done, further right-hand sides are cheap.

Stages, their state y and their decision v are those of `_stages`.
"""

import equinox as eqx
import jax
import jax.numpy as jnp

from ._stages import Matrices, Vectors
from ._types import Array, Float, Scalar

# Decisions of a stage that are eliminated without a loop.
_FEW = 8


class Forced(eqx.Module):
    """Variables that are told what to be: which ones, and what.

    - `first`: at the first node, the totals (zero) and the flight time included.
    - `controls`: the decisions.
    """

    first: tuple[Float[Array, " y"], Float[Array, " y"]]
    controls: tuple[Float[Array, "I m"], Float[Array, "I m"]]


class Factors(eqx.Module):
    """What the recursion leaves.

    - `ahead`: second derivatives of the cost still to come by y at each right end.
    - `first`: at the first node; `begin`: the inverse of that, zero where y is forced.
    - `inverse`: of what is left of each stage's second derivatives by v, zero where v is
        forced; `own` that remainder. `cross`: what is left of those by v and y.
    - `gain`: of the best decision by y. `closed`: y at the right end by y at the left
        with that decision.
    - `convexity`: least curvature that was met along the dynamics: of one variable with
        those already eliminated at their best, relative to that with them at rest.
    """

    ahead: Float[Array, "I y y"]
    first: Float[Array, "y y"]
    begin: Float[Array, "y y"]
    inverse: Float[Array, "I m m"]
    own: Float[Array, "I m m"]
    cross: Float[Array, "I m y"]
    gain: Float[Array, "I m y"]
    closed: Float[Array, "I y y"]
    convexity: Scalar


def factorize(matrices: Matrices, forced: Forced) -> Factors:
    """The recursion for the second derivatives."""
    size = matrices.last.shape[0]

    # Little work and many stages: what counts is how few programs each of them calls.
    def back(ahead, stage):
        onward, transposed, cost, told = stage
        whole = cost + transposed @ (ahead @ onward)
        # Where rounding leaves it askew, what is askew grows from stage to stage.
        whole = 0.5 * (whole + whole.T)
        swept, pivots = _swept(whole, told)
        return swept[:size, :size], (swept[size:], whole[size:], ahead, pivots)

    first, (swept, left, ahead, pivots) = jax.lax.scan(
        back,
        matrices.last,
        # Transposed in advance: small products of transposed matrices are slow.
        (matrices.onward, matrices.onward.mT, matrices.cost, forced.controls[0]),
        reverse=True,
    )
    gain, inverse = -swept[:, :, :size], -swept[:, :, size:]
    by_state, by_control = matrices.onward[:, :, :size], matrices.onward[:, :, size:]
    closed = by_state + jnp.einsum("kyi,kiz->kyz", by_control, gain)
    begin, begun = _swept(first, forced.first[0])
    return Factors(
        ahead=ahead,
        first=first,
        begin=-begin,
        inverse=inverse,
        own=left[:, :, size:],
        cross=left[:, :, :size],
        gain=gain,
        closed=closed,
        convexity=jnp.minimum(jnp.min(pivots), jnp.min(begun)),
    )


def _swept(
    matrix: Float[Array, "a a"], told: Float[Array, " b"]
) -> tuple[Float[Array, "a a"], Float[Array, " b"]]:
    """A quadratic form with its last variables eliminated, but for those that are told.

    The symmetric sweep operator: Goodnight, The American Statistician 33 (1979). Of

        [A  B'; B  C]  it makes  [A - B' inv(C) B, (inv(C) B)'; inv(C) B, -inv(C)],

    zero where a variable is told.

    **Returns:** that, and the pivots, each relative to its entry before.
    """
    size = matrix.shape[0]
    kept = size - told.size
    free = jnp.concatenate([jnp.ones(kept), 1.0 - told])
    # What is told must not pass for a lack of convexity.
    left = matrix * jnp.outer(free, free) + jnp.diag(1.0 - free)
    before = jnp.abs(jnp.diagonal(left))[kept:]

    def sweep(left: Array, k: Array) -> tuple[Array, Scalar]:
        own = jnp.arange(size) == k
        row, pivot = left[k], left[k, k]
        inverse = 1.0 / jnp.where(pivot == 0.0, 1.0, pivot)
        divided = inverse * row
        rest = left - row[:, None] * divided[None]
        rest = jnp.where(own[:, None], divided[None], rest)
        rest = jnp.where(own[None], divided[:, None], rest)
        return jnp.where(own[:, None] & own[None], -inverse, rest), pivot

    # The few of a stage are written out: a loop in a loop takes longer.
    left, pivots = jax.lax.scan(
        sweep, left, jnp.arange(kept, size), unroll=told.size <= _FEW
    )
    relative = pivots / jnp.where(before > 0.0, before, 1.0)
    return left * jnp.outer(free, free), relative


def solve(
    matrices: Matrices, vectors: Vectors, forced: Forced, factors: Factors
) -> tuple[Float[Array, "N y"], Float[Array, "I m"], Float[Array, "I y"]]:
    """The y of every node, the decisions, and the costates of the intervals' ends.

    A costate is what the cost still to come changes by with y at the right end.
    """
    size = matrices.last.shape[0]
    drift = jnp.einsum("kyz,kz->ky", factors.ahead, vectors.drift)
    slope = vectors.slope + jnp.einsum("kyw,ky->kw", matrices.onward, drift)
    told, target = forced.controls
    told = told * target
    pushed = slope[:, size:] + jnp.einsum("kij,kj->ki", factors.own, told)
    rest = told - jnp.einsum("kij,kj->ki", factors.inverse, pushed)
    slope = slope[:, :size] + jnp.einsum("kmy,km->ky", factors.cross, rest)

    def back(ahead, stage):
        closed, slope = stage
        return closed.T @ ahead + slope, ahead

    first, ahead = jax.lax.scan(back, vectors.last, (factors.closed, slope), reverse=True)
    fed = jnp.einsum("kym,ky->km", matrices.onward[:, :, size:], ahead)
    rest -= jnp.einsum("kij,kj->ki", factors.inverse, fed)
    told, target = forced.first
    told = told * target
    begin = told - factors.begin @ (first + factors.first @ told)

    def onward(y, stage):
        matrix, gain, drift, rest = stage
        both = jnp.concatenate([y, rest + gain @ y])
        # Not by the closed loop's matrix: rounded, that breaks the dynamics a little,
        # and the cost to come is steep in what breaks them.
        return matrix @ both + drift, both

    last, both = jax.lax.scan(
        onward, begin, (matrices.onward, factors.gain, vectors.drift, rest)
    )
    y = jnp.concatenate([both[:, :size], last[None]])
    costates = ahead + jnp.einsum("kyz,kz->ky", factors.ahead, y[1:])
    return y, both[:, size:], costates
