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
    - `convexity`: least curvature that was met along the dynamics.
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
        cross = whole[size:, :size]
        inverse, least = _inverse(whole[size:, size:], told)
        left = whole[:size, :size] - cross.T @ inverse @ cross
        return 0.5 * (left + left.T), (inverse, whole[size:], ahead, least)

    first, (inverse, left, ahead, least) = jax.lax.scan(
        back,
        matrices.last,
        # Transposed in advance: small products of transposed matrices are slow.
        (matrices.onward, matrices.onward.mT, matrices.cost, forced.controls[0]),
        reverse=True,
    )
    cross, own = left[:, :, :size], left[:, :, size:]
    gain = -jnp.einsum("kij,kjy->kiy", inverse, cross)
    by_state, by_control = matrices.onward[:, :, :size], matrices.onward[:, :, size:]
    closed = by_state + jnp.einsum("kyi,kiz->kyz", by_control, gain)
    begin, begun = _inverse(first, forced.first[0])
    convexity = jnp.minimum(jnp.min(least), begun)
    return Factors(ahead, first, begin, inverse, own, cross, gain, closed, convexity)


def _inverse(matrix: Float[Array, "a a"], told: Float[Array, " a"]):
    """Inverse by the entries that are free, and their least eigenvalue."""
    free = 1.0 - told
    kept = matrix * jnp.outer(free, free)
    # What is forced must not pass for a lack of convexity.
    kept += jnp.diag(told)
    # Controls may act more than a thousand times stronger than others.
    size = jnp.abs(jnp.diagonal(kept))
    unit = jnp.where(size > 0.0, 1.0 / jnp.sqrt(jnp.where(size > 0.0, size, 1.0)), 1.0)
    values, vectors = jnp.linalg.eigh(kept * jnp.outer(unit, unit))
    inverse = (vectors / values[None]) @ vectors.T
    return inverse * jnp.outer(unit * free, unit * free), jnp.min(values)


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
