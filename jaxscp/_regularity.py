"""Whether an optimum is regular: whether it has derivatives, and how reliable ones."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree

from ._compiler import compiled
from ._kkt import KKTPoint, Optimum, conditions, of_inequalities, slacks
from ._kkt_system import kkt_solve
from ._per_limit import PerLimit
from ._transcription import Transcription, Variables
from ._types import Scalar

# Multiplications that estimate the largest and the least eigenvalue of K.
_POWERS = 8


class Regularity(eqx.Module):
    """How the limits stand at an optimum, and the matrix of its conditions; all scaled.

    - `multipliers`, `slacks`: of every lower and of every upper limit, none negative.
        Slacks are infinite where there is no inequality.
    - `convexity`: least curvature, positive at a strict minimum. `condition`: of K.
    """

    multipliers: tuple[PerLimit, PerLimit]
    slacks: tuple[PerLimit, PerLimit]
    convexity: Scalar
    condition: Scalar

    @property
    def margins(self) -> tuple[PerLimit, PerLimit]:
        """By how much either the multiplier or the slack of each limit is positive."""
        low, high = (
            jax.tree.map(jnp.maximum, *pair)
            for pair in zip(self.multipliers, self.slacks, strict=True)
        )
        return low, high


@compiled
def regularity(transcription: Transcription, optimum: Optimum) -> Regularity:
    """How regular an optimum is."""
    fixed = fixed_limits(transcription)

    def where_limited(ways: PerLimit) -> PerLimit:
        return jax.tree.map(
            lambda fixed, way: jnp.where(fixed > 0.0, jnp.inf, jnp.maximum(way, 0.0)),
            fixed,
            ways,
        )

    below, above = slacks(transcription, optimum, optimum.point.step)
    return Regularity(
        by_side(of_inequalities(optimum.point)),
        (where_limited(below), where_limited(above)),
        *_of_matrix(transcription, optimum),
    )


def by_side(multipliers: PerLimit) -> tuple[PerLimit, PerLimit]:
    """Of the lower and of the upper limits, none negative."""
    lower = jax.tree.map(lambda own: jnp.maximum(-own, 0.0), multipliers)
    upper = jax.tree.map(lambda own: jnp.maximum(own, 0.0), multipliers)
    return lower, upper


def fixed_limits(transcription: Transcription) -> PerLimit:
    """1 for limits that are equalities, else 0."""
    problem, none = transcription.problem, transcription.no_multipliers
    shape = (transcription.control_nodes, problem.control_size)
    integrals = [integral.bounds.fixed[0] for integral in problem.integrals.values()]
    variables = Variables(
        jnp.asarray(transcription.fixed_states, float),
        jnp.broadcast_to(jnp.asarray(problem.control.is_fixed, float), shape),
        jnp.asarray(problem.final_time.is_fixed, float),
    )
    return PerLimit(variables, none.path, none.between, jnp.array(integrals, float))


def _of_matrix(transcription: Transcription, optimum: Optimum) -> tuple[Scalar, Scalar]:
    """Convexity, and the ratio of K's eigenvalues.

    Two power methods at once: the ratio is at most the true one.
    """
    flat, unravel = ravel_pytree(optimum.point)

    def multiplied(vector: KKTPoint) -> KKTPoint:
        def at(point: KKTPoint) -> KKTPoint:
            return conditions(transcription, optimum, point)

        return jax.jvp(at, (optimum.point,), (vector,))[1]

    def again(_, state):
        (large, small), _, _ = state
        grown = multiplied(unravel(large))
        answer = kkt_solve(transcription, optimum, unravel(small))
        vectors = jnp.stack([ravel_pytree(v)[0] for v in (grown, answer.point)])
        growth = jnp.linalg.norm(vectors, axis=1)
        return vectors / growth[:, None], jnp.prod(growth), answer.convexity

    start = jax.random.normal(jax.random.key(0), flat.shape)
    start /= jnp.linalg.norm(start)
    begun = jnp.stack([start, start]), jnp.ones(()), jnp.zeros(())
    _, condition, convexity = jax.lax.fori_loop(0, _POWERS, again, begun)
    return convexity, condition
