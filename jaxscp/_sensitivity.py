"""How the optimum moves with the parameters: the derivative rules of a solve.

At a solution w(p) of the optimality conditions F(w; p) = 0 (`_kkt`), where no constraint
is weakly active, the implicit function theorem gives

    K dw = -F_p dp,  K = F_w symmetric,

and as F is the gradient of the Lagrangian L, whose value is the objective J,

    dJ = L_w dw + L_p dp = L_p dp:

the envelope theorem: no system is solved. Both rules take the solution they are about
from `optimal_point`, so that differentiating them again is right, too. What needs K or
F_p is kept inside the solver of a linear system, what L_p dp needs inside a checkpoint:
neither is evaluated for the sake of a field nobody differentiates.

Fiacco, "Introduction to Sensitivity and Stability Analysis in Nonlinear Programming",
1983, Theorem 3.2.1.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree

from ._kkt import KKTPoint, Optimum, conditions, lagrangian, potential, totals
from ._kkt_system import kkt_solve
from ._transcription import Transcription
from ._tree import constant
from ._types import Array, Float, PyTree, Scalar

# More than this left of the linear system, relative to its right-hand side, makes the
# answer worthless.
_WORTHLESS = 1e-5


@eqx.filter_custom_jvp
def optimal_point(transcription: Transcription, optimum: Optimum) -> KKTPoint:
    """The solution; its derivatives are those of the implicit function theorem."""
    del transcription
    return optimum.point


@optimal_point.def_jvp
def _optimal_point_jvp(primals, tangents):
    (transcription, optimum), (tangent, _) = primals, tangents
    point = optimal_point(transcription, optimum)
    arrays, others = _moving(transcription, tangent)
    parameters, unravel_parameters = ravel_pytree(tangent)
    unknowns, unravel = ravel_pytree(point)
    live = _Conditions(arrays, others, optimum, point)
    fixed = constant(live)

    def split(both: Array) -> tuple[Array, Array]:
        return both[: unknowns.size], both[unknowns.size :]

    def driven(conditions: _Conditions, both: Array) -> Array:
        change, shift = split(both)
        found = conditions.along(unravel_parameters(shift), unravel(change))
        return ravel_pytree(found)[0]

    def solved(right: Array) -> Array:
        return ravel_pytree(fixed.solved(unravel(right)))[0]

    # The parameters' shift is an unknown, too: K's system and what drives it are solved,
    # and transposed, as one.
    def matrix(both: Array) -> Array:
        return jnp.concatenate([driven(live, both), split(both)[1]])

    def forward(_, right: Array) -> Array:
        left, shift = split(right)
        alone = jnp.concatenate([jnp.zeros_like(left), shift])
        return jnp.concatenate([solved(left - driven(fixed, alone)), shift])

    def backward(_, right: Array) -> Array:
        left, shift = split(right)
        answer = solved(left)
        pulled = ravel_pytree(fixed.pulled(unravel(answer)))[0]
        return jnp.concatenate([answer, shift - pulled])

    right = jnp.concatenate([jnp.zeros_like(unknowns), parameters])
    both = jax.lax.custom_linear_solve(matrix, right, forward, backward)
    change = jax.tree.map(jnp.multiply, optimum.roots, unravel(split(both)[0]))
    return point, _or_nan(optimum, change)


class _Conditions(eqx.Module):
    """The conditions at a point, and their derivatives there.

    Its methods are jitted to be traced once, though used for both directions.

    - `arrays`, `others`: the discrete problem: the parameters, and the rest.
    """

    arrays: PyTree
    others: PyTree
    optimum: Optimum
    point: KKTPoint

    @eqx.filter_jit
    def along(self, shift: PyTree, change: KKTPoint) -> KKTPoint:
        """F_p times a shift of the parameters, plus K times a change of the unknowns."""

        def at(arrays, point):
            return conditions(eqx.combine(arrays, self.others), self.optimum, point)

        return jax.jvp(at, (self.arrays, self.point), (shift, change))[1]

    @eqx.filter_jit
    def pulled(self, change: KKTPoint) -> PyTree:
        """The transpose of F_p times a change.

        As the gradient of one directional derivative: JAX's own transpose of `along`
        takes seven times as long.
        """

        def along(arrays):
            def at(point):
                return potential(eqx.combine(arrays, self.others), self.optimum, point)

            return jax.jvp(at, (self.point,), (change,))[1]

        return jax.grad(along)(self.arrays)

    @eqx.filter_jit
    def solved(self, right: KKTPoint) -> KKTPoint:
        """By K; NaN where that is singular."""
        transcription = eqx.combine(self.arrays, self.others)
        answer = kkt_solve(transcription, self.optimum, right)
        factor = jnp.where(answer.left > _WORTHLESS, jnp.nan, 1.0)
        return jax.tree.map(lambda leaf: factor * leaf, answer.point)


@eqx.filter_custom_jvp
def optimal_objective(transcription: Transcription, optimum: Optimum) -> Scalar:
    """The objective; its derivatives are those of the envelope theorem."""
    del transcription
    return optimum.objective


@optimal_objective.def_jvp
def _optimal_objective_jvp(primals, tangents):
    (transcription, optimum), (tangent, _) = primals, tangents
    point = optimal_point(transcription, optimum)
    arrays, others = _moving(transcription, tangent)

    # Nothing of it is kept for the sake of fields that nobody differentiates.
    @jax.checkpoint
    def of_arrays(arrays):
        return lagrangian(eqx.combine(arrays, others), optimum, point)

    _, change = jax.jvp(of_arrays, (arrays,), (tangent,))
    change = optimum.scaling.objective * change
    return optimal_objective(*primals), _or_nan(optimum, change)


def optimal_totals(
    transcription: Transcription, optimum: Optimum, point: KKTPoint
) -> Float[Array, " q"]:
    """The integrals over the whole flight, at `optimal_point`."""
    return eqx.filter_checkpoint(totals)(transcription, optimum, point.step)


def _moving(transcription: Transcription, tangent: PyTree) -> tuple[PyTree, PyTree]:
    """What changes along a direction, and the rest, for which it has `None`."""
    moves = jax.tree.map(lambda t: t is not None, tangent, is_leaf=_is_none)
    return eqx.partition(transcription, moves)


def _is_none(leaf) -> bool:
    return leaf is None


def _or_nan(optimum: Optimum, tangent):
    """A point that does not meet the conditions has no derivatives."""
    # A factor, not a choice: that would be zero on the way back.
    factor = jnp.where(optimum.polished, 1.0, jnp.nan)
    return jax.tree.map(lambda leaf: factor * leaf, tangent)
