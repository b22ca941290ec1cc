"""A limit begins to hold: if it depends on those that do, another one lets go.

At a point where active limits depend on each other multipliers are not unique, and those
that hold to one side are not those of the other. A limit that enters takes over the
multiplier of one that leaves: the step of the dual active set method. Goldfarb, Idnani,
Mathematical Programming 27 (1983).
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree

from ._compiler import compiled
from ._kkt import KKTPoint, Optimum, of_inequalities, slacks
from ._kkt_system import kkt_solve
from ._max_norm import max_norm
from ._per_constraint import PerConstraint
from ._per_limit import PerLimit
from ._regularity import fixed_limits
from ._transcription import Transcription, Variables
from ._types import Array, Scalar

# A limit that pulls the variables by less than this, for its own size, depends on others.
_DEPENDENT = 1e-7


@compiled
def exchanged(
    transcription: Transcription, optimum: Optimum, entering: PerLimit
) -> Optimum:
    """The same optimum with a further limit active, and multipliers that allow it.

    **Arguments:**

    - `entering`: 1 for an upper limit, -1 for a lower one, 0 elsewhere.
    """

    def excess(step: Variables) -> Scalar:
        below, above = slacks(transcription, optimum, step)
        ways = jax.tree.map(
            lambda enters, low, high: jnp.sum(
                jnp.where(enters > 0.0, high, jnp.where(enters < 0.0, low, 0.0))
            ),
            *(entering, below, above),
        )
        return -sum(jax.tree.leaves(ways), jnp.zeros(()))

    slope = jax.grad(excess)(optimum.point.step)
    still = jax.tree.map(jnp.zeros_like, optimum.point)
    push = KKTPoint(jax.tree.map(jnp.negative, slope), still.multipliers, still.limits)
    pushed = kkt_solve(transcription, optimum, push).point
    depends = max_norm(pushed.step) <= _DEPENDENT * max_norm(slope)
    gives = jax.tree.map(
        _share,
        fixed_limits(transcription),
        optimum.sides,
        of_inequalities(optimum.point),
        of_inequalities(pushed),
    )
    first = jnp.min(ravel_pytree(gives)[0])
    leaves = jax.tree.map(lambda share: depends & (share <= first), gives)
    sides = jax.tree.map(
        lambda side, enters, gone: jnp.where(gone, 0.0, side) + enters,
        *(optimum.sides, entering, leaves),
    )
    # Nothing lets go: there is no solution to that side.
    taken = jnp.where(depends, jnp.where(first < jnp.inf, first, jnp.nan), 0.0)
    point = _after(optimum.point, pushed, entering, taken)
    return eqx.tree_at(lambda o: (o.sides, o.point), optimum, (sides, point))


def _share(fixed: Array, side: Array, multiplier: Array, change: Array) -> Array:
    """How much of the pushing each active limit bears before it lets go."""
    own, gained = side * multiplier, side * change
    shrinks = (fixed == 0.0) & (side != 0.0) & (gained < 0.0)
    return jnp.where(shrinks, own / jnp.where(shrinks, -gained, 1.0), jnp.inf)


def _after(
    point: KKTPoint, pushed: KKTPoint, entering: PerLimit, taken: Scalar
) -> KKTPoint:
    """With the multipliers of so much pushing; the variables do not move."""
    inequalities = jax.tree.map(
        lambda own, change, enters: own + taken * (change + enters),
        *(of_inequalities(point), of_inequalities(pushed), entering),
    )
    costates = point.multipliers.dynamics + taken * pushed.multipliers.dynamics
    multipliers = PerConstraint(
        costates, inequalities.path, inequalities.between, inequalities.integral
    )
    return KKTPoint(point.step, multipliers, inequalities.variables)
