"""What further steps promise: is a reference stationary, or next to a solution?"""

import equinox as eqx
import jax.numpy as jnp

from ._constraints import integral_limits, worst_violation
from ._search import Search
from ._state import Judgement, SCPState
from ._transcription import Transcription
from ._tree import tree_where
from ._types import Array

# How many times the reduction worth a step is still little.
_LITTLE = 100.0


class Prospects(eqx.Module):
    """What a step just tried tells of those to come.

    - `stationary`: no step within the model improves the merit.
    - `cheap`: one might if virtual variables cost more.
    - `near`: Newton's method may go on without a merit function.
    """

    stationary: Array
    cheap: Array
    near: Array


def prospects(
    transcription: Transcription,
    state: SCPState,
    found: Search,
    judgement: Judgement,
    *,
    may_polish: Array,
    close: float,
    poor_ratio: float,
    min_reduction: float,
    min_progress: float,
    feasibility_tolerance: float,
    max_ceiling: float,
) -> Prospects:
    """Prospects after a step; the settings are those of `ProximalSCP`."""
    trial, newton = found.best, found.newton
    limits = integral_limits(transcription, state.scaling)
    here = tree_where(judgement.accepted, trial.residuals, state.iterate.residuals)
    infeasible = worst_violation(here, limits) > feasibility_tolerance
    # Where even the model leaves a violation, virtual variables may be too cheap.
    bought = worst_violation(found.expected, limits) > feasibility_tolerance
    # A heavy proximal term makes every prediction small: take it out again.
    weight = jnp.where(newton.found, newton.weight, 1.0 / state.radius)
    promised = judgement.predicted * jnp.maximum(1.0, weight)
    unpromising = promised <= jnp.where(bought, min_progress, min_reduction)
    # Where violations outweigh the cost: within what a QP solver resolves.
    noise = 1e-9 * jnp.abs(judgement.reference)
    stationary = unpromising | (judgement.predicted <= noise)
    # Next to a solution a step along what the cost hardly sees promises nothing, yet
    # leads to it. Before the first step nobody knows how near one is.
    close_by = (state.optimality <= close) | (state.records == 0)
    hopeful = (state.near | (~infeasible & close_by)) & may_polish
    stationary &= ~hopeful & ~newton.found & trial.solution.effort.solved
    cheap = stationary & bought & (state.ceiling < max_ceiling)
    # Of steps that promise little the penalized cost sees the side effects first.
    blind = newton.found & (judgement.ratio < poor_ratio)
    blind &= promised <= _LITTLE * min_reduction
    return Prospects(
        stationary & (~infeasible | bought) & ~cheap,
        cheap,
        state.near | (hopeful & (unpromising | blind)),
    )
