"""How far the steps of `ProximalSCP` go: their measure, its weight, and their length.

Subproblems have a soft trust region: half the square of the step's length, times a
weight, the inverse of the radius. Newton's steps may need any weight, as all of the
Lagrangian's curvature need not be convex: what is known of them from one to the next is
how long they may be. More and Sorensen, SIAM Journal on Scientific and Statistical
Computing 4 (1983).
"""

import dataclasses

import jax
import jax.numpy as jnp

from ._active_set import NewtonStep
from ._curvature import Curvature, magnitude
from ._damping import Damping
from ._state import Judgement, Reach, SCPState
from ._transcription import Transcription, Variables
from ._tree import tree_where
from ._types import Array, Scalar

# A step this short, as a share of the length allowed, was not held back by that.
_SHORT = 0.5


def metric(
    transcription: Transcription,
    state: SCPState,
    curvatures: tuple[Curvature, Curvature],
    sound: Array,
) -> Damping:
    """The square of a step's length, of which a subproblem is charged a half.

    Where the Lagrangian curves along the dynamics no convex model is right, but how
    strongly it does tells how far one can be trusted: that much curvature, of whatever
    sign, is part of the measure.

    **Arguments:**

    - `curvatures`: of the convex model, and all of the Lagrangian's. `sound`: whether
        that is known; the convex one stands for it where not.
    """
    convex, exact = curvatures
    share = 1.0 / transcription.nodes
    like = state.solution.step
    # The flight time moves every node: it counts once for each of them.
    weights = Variables(
        jnp.full_like(like.states, share),
        jnp.full_like(like.controls, share),
        jnp.ones_like(like.final_time),
    )
    plain = Damping.of(state.iterate.residuals, weights)
    doubt = jax.lax.cond(
        sound,
        lambda: magnitude(exact.blocks - convex.blocks),
        lambda: plain.measure,
    )
    return dataclasses.replace(plain, measure=doubt)


def next_radius(
    state: SCPState,
    judgement: Judgement,
    newton: NewtonStep,
    *,
    longest: Scalar,
    poor_ratio: float,
    good_ratio: float,
    factor: float,
) -> Scalar:
    """The inverse of the next subproblem's weight.

    Newton's steps leave it as it is, but for those far shorter than they might be, with a
    weight that makes all of the curvature convex: a subproblem's may go farther then, and
    as long as such steps prove good it is given the chance.

    **Arguments:**

    - `longest`: how long Newton's step might have been.
    """
    ratio = judgement.ratio
    change = jnp.where(ratio < poor_ratio, 1.0 / factor, 1.0)
    change = jnp.where(ratio > good_ratio, factor, change)
    # A model that is right so far is right farther out.
    change = jnp.where(_is_right(ratio), 2.0 * factor, change)
    # What was too far a moment ago still is.
    refused = state.last_accepted == 0.0
    change = jnp.where(refused, jnp.minimum(change, 1.0), change)
    # Where no penalized cost is asked, only what leads astray is refused.
    blind = jnp.where(judgement.accepted, factor, 1.0 / factor**2)
    change = jnp.where(state.near, blind, change)
    held = (newton.weight > state.reach.weight) & (newton.length < _SHORT * longest)
    kept = newton.found & (state.near | ~held)
    return jnp.where(kept, 1.0, change) * state.radius


def next_reach(
    state: SCPState,
    judgement: Judgement,
    newton: NewtonStep,
    *,
    poor_ratio: float,
    good_ratio: float,
    factor: float,
) -> Reach:
    """How far Newton's next step may go.

    The length of the one before tells, if there was one; the weight is only as heavy as
    that asks.
    """
    ratio, near, length = judgement.ratio, state.near, newton.length
    change = jnp.where(ratio > good_ratio, 2.0, 1.0)
    change = jnp.where(_is_right(ratio) | near, factor, change)
    before = state.reach.length
    longer = jnp.maximum(jnp.where(jnp.isinf(before), 0.0, before), change * length)
    good = judgement.accepted & ((ratio >= poor_ratio) | near)
    length = jnp.where(good, longer, length / factor)
    after = Reach(length, newton.weight / factor**2)
    return tree_where(newton.found, after, state.reach)


def blind_reach(
    transcription: Transcription, before: SCPState, after: SCPState, tolerance: float
) -> Reach:
    """How far Newton's steps may go where no penalized cost is asked.

    Their weight is that of Levenberg and Marquardt, which vanishes with the residual. It
    is light, for long steps along directions that the cost hardly sees, as of a
    quadrotor's yaw, where the residual fell; where such a step has raised it, heavy, to
    take the side effects back first, and where it is all but within the tolerance, to
    get there without any.
    """
    residual, earlier = after.optimality, before.optimality
    closing = (residual <= 10.0 * tolerance) & (residual <= 0.3 * earlier)
    factor = jnp.where((residual <= earlier) & ~closing, 1e-4, 0.3)
    # A step squares the residual: what is above its root takes several to take back.
    worse = residual > jnp.maximum(3.0 * earlier, 0.3 * jnp.sqrt(earlier))
    worse &= before.near & ~before.iterate.fresh
    length = jnp.where(worse, 0.1, 1.0) * before.reach.length
    return Reach(length, factor * residual * transcription.nodes)


def _is_right(ratio: Scalar) -> Array:
    return jnp.abs(ratio - 1.0) < 0.15
