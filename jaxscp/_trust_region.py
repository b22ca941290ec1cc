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
from ._constraints import integral_limits
from ._curvature import Curvature, magnitude
from ._damping import Damping
from ._state import Judgement, SCPState
from ._transcription import Transcription, Variables
from ._types import Array, Scalar


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


def hold_active(transcription: Transcription, state: SCPState) -> Damping:
    """What draws a polishing step to the constraints that were active.

    The Lagrangian need only be convex along them.
    """
    last, near = state.solution, state.near

    def firm(multiplier: Array) -> Array:
        size = jnp.abs(multiplier)
        # PIQP leaves traces on limits that are not active.
        return jnp.minimum(jnp.where(near & (size > 1e-7), 100.0 * size, 0.0), 1e3)

    states = jnp.where(transcription.fixed_states, 0.0, last.state)
    step = Variables(firm(states), firm(last.control), jnp.zeros_like(last.final_time))
    lower, upper = integral_limits(transcription, state.scaling)
    active = jnp.where(last.multipliers.integral > 0.0, upper, lower)
    return dataclasses.replace(
        Damping.of(state.iterate.residuals, step),
        path=firm(last.multipliers.path),
        between=firm(last.multipliers.between),
        integral=firm(last.multipliers.integral),
        target=jnp.where(jnp.isfinite(active), active, 0.0),
    )


def next_radius(
    state: SCPState,
    judgement: Judgement,
    newton: NewtonStep,
    *,
    poor_ratio: float,
    good_ratio: float,
    factor: float,
) -> Scalar:
    """The inverse of the weight that the next step starts from."""
    ratio = judgement.ratio
    change = jnp.where(ratio < poor_ratio, 1.0 / factor, 1.0)
    change = jnp.where(ratio > good_ratio, factor, change)
    # A model that is right so far is right farther out.
    change = jnp.where(_is_right(ratio), 2.0 * factor, change)
    # What was too far a moment ago still is.
    refused = state.last_accepted == 0.0
    change = jnp.where(refused, jnp.minimum(change, 1.0), change)
    used = jnp.where(newton.found, 1.0 / newton.weight, state.radius)
    polishing = jnp.where(judgement.accepted, factor, 1.0 / factor**2) * state.radius
    polishing = jnp.minimum(polishing, jnp.where(newton.found, factor * used, jnp.inf))
    return jnp.where(state.near, polishing, change * used)


def next_length(
    state: SCPState,
    judgement: Judgement,
    newton: NewtonStep,
    *,
    poor_ratio: float,
    good_ratio: float,
) -> Scalar:
    """How long Newton's next step may be: unlimited until there was a first."""
    ratio, near, length = judgement.ratio, state.near, newton.length
    change = jnp.where(ratio > good_ratio, 2.0, 1.0)
    change = jnp.where(_is_right(ratio) | near, 3.0, change)
    known = jnp.where(jnp.isinf(state.longest), 0.0, state.longest)
    longer = jnp.maximum(known, change * length)
    good = judgement.accepted & ((ratio >= poor_ratio) | near)
    return jnp.where(newton.found, jnp.where(good, longer, 0.3 * length), state.longest)


def _is_right(ratio: Scalar) -> Array:
    return jnp.abs(ratio - 1.0) < 0.15
