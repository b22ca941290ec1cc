"""`ProximalSCP`: the default method."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp

from ._assembly import Prices
from ._iteration import advance, is_finite, linearized, start, tree_where
from ._layout import Structure
from ._model import (
    Model,
    PerConstraint,
    convex_model,
    integral_limits,
    worst_violation,
)
from ._qp import PIQP
from ._scp import AbstractSCP
from ._search import Search, search
from ._state import Judgement, SCPState
from ._subproblem import SubproblemSolution, solve_subproblem, step_limits
from ._transcription import Transcription, Variables
from ._types import Array, Scalar


class ProximalSCP(AbstractSCP):
    """SCP with a soft 2-norm trust region and second-order information.

    Each subproblem adds half the squared scaled step, times a weight, to a convex model
    of the Lagrangian: the Lagrangian of the paper's norm ball. The ratio of actual to
    predicted reduction of an exact penalty steers the weight. Penalty weights follow the
    multipliers; the model has the curvature of costs, path constraints and integrals; a
    second-order correction takes back what the linearization missed. The dynamics are
    exact equalities of the subproblem, and virtual control enters only where those
    cannot be met.

    **Arguments:**

    - `max_iterations`: subproblems allowed, corrections not counted.
    - `tolerance`: stop once the predicted reduction falls below it, relative to the
        cost's scale.
    - `feasibility_tolerance`: allowed defects and violations, relative to the scales.
    - `initial_weight`: of the proximal term in the first subproblem.
    - `curvature`: whether path constraints and integrals contribute theirs.
    - `correction`: whether poor steps get a second-order correction.
    - `qp`: the solver of the subproblems; by default as exact as `tolerance` needs.
    """

    max_iterations: int = eqx.field(static=True, default=100)
    tolerance: float = eqx.field(static=True, default=1e-4)
    feasibility_tolerance: float = eqx.field(static=True, default=1e-5)
    initial_weight: float = eqx.field(static=True, default=10.0)
    curvature: bool = eqx.field(static=True, default=True)
    correction: bool = eqx.field(static=True, default=True)
    qp: PIQP | None = None
    # Ratios that accept a step, raise the weight, lower it, and call for a correction.
    accept_ratio: float = eqx.field(static=True, default=0.01)
    poor_ratio: float = eqx.field(static=True, default=0.25)
    good_ratio: float = eqx.field(static=True, default=0.7)
    correction_ratio: float = eqx.field(static=True, default=0.5)
    weight_factor: float = eqx.field(static=True, default=3.0)
    min_radius: float = eqx.field(static=True, default=1e-12)
    max_failures: int = eqx.field(static=True, default=5)
    max_radius: float = eqx.field(static=True, default=1e6)
    # Price of virtual variables: above any likely multiplier, raised if it is not.
    initial_ceiling: float = eqx.field(static=True, default=1e2)
    max_ceiling: float = eqx.field(static=True, default=1e6)

    def init(self, transcription: Transcription, guess: Variables) -> SCPState:
        return start(
            transcription,
            guess,
            SubproblemSolution.none(Structure.of(transcription)),
            radius=1.0 / self.initial_weight,
            ceiling=self.initial_ceiling,
            records=self.max_iterations,
        )

    def step(self, transcription: Transcription, state: SCPState) -> SCPState:
        iterate = linearized(transcription, state.scaling, state.iterate)
        state = dataclasses.replace(state, iterate=iterate, finite=is_finite(iterate))
        share = 1.0 if self.curvature else 0.0
        model = convex_model(
            transcription,
            state.scaling,
            iterate.variables,
            iterate.residuals,
            iterate.derivatives,
            jax.tree.map(lambda leaf: share * leaf, state.solution.multipliers),
        )
        found, judgement = search(
            transcription,
            state,
            model,
            solve=lambda around: self._solve(transcription, state, around),
            follow=lambda to: _following(state.weights, to, state.ceiling),
            accept_ratio=self.accept_ratio,
            # No ratio is below this one: then no step is poor.
            correction_ratio=self.correction_ratio if self.correction else -jnp.inf,
        )
        return self._advance(transcription, state, found, judgement)

    def _solve(
        self, transcription: Transcription, state: SCPState, model: Model
    ) -> SubproblemSolution:
        scaling, reference = state.scaling, state.iterate.variables
        residuals, ceiling = model.residuals, state.ceiling
        prices = Prices(
            proximal=1.0 / state.radius,
            virtual_control=jnp.full_like(residuals.defects, ceiling),
            path=jnp.full_like(residuals.path, ceiling),
            integral=jnp.full_like(residuals.totals, ceiling),
            radius=jnp.zeros(()),
        )
        limits = step_limits(transcription, scaling, reference)
        structure = Structure.of(transcription)
        # A hundredth of the tolerance; below 1e-8 PIQP's residuals are rounding errors.
        exact = PIQP(tolerance=min(max(0.01 * self.tolerance, 1e-8), 1e-6))
        return solve_subproblem(structure, self.qp or exact, model, prices, limits)

    def _advance(
        self,
        transcription: Transcription,
        state: SCPState,
        found: Search,
        judgement: Judgement,
    ) -> SCPState:
        trial = found.best
        ratio, factor = judgement.ratio, self.weight_factor
        radius = jnp.where(ratio < self.poor_ratio, state.radius / factor, state.radius)
        radius = jnp.where(ratio > self.good_ratio, radius * factor, radius)
        # A heavy proximal term makes every prediction small: take it out again.
        held_back = jnp.maximum(1.0, 1.0 / state.radius)
        stationary = judgement.predicted * held_back <= self.tolerance
        # Or where violations outweigh the cost: within what a QP solver resolves.
        stationary |= judgement.predicted <= 1e-9 * jnp.abs(judgement.reference)
        stationary &= trial.solution.effort.solved
        limits = integral_limits(transcription, state.scaling)
        here = tree_where(judgement.accepted, trial.residuals, state.iterate.residuals)
        infeasible = worst_violation(here, limits) > self.feasibility_tolerance
        # Where even the model leaves a violation, virtual variables may be too cheap.
        bought = worst_violation(found.expected, limits) > self.feasibility_tolerance
        cheap = stationary & bought & (state.ceiling < self.max_ceiling)
        ceiling = jnp.where(cheap, 10.0 * state.ceiling, state.ceiling)
        return advance(
            transcription,
            state,
            trial,
            judgement,
            weights=found.weights,
            ceiling=ceiling,
            radius=jnp.minimum(radius, self.max_radius),
            stationary=stationary & (~infeasible | bought) & ~cheap,
            iterations=state.iterations + 1,
        )


def _following(
    weights: PerConstraint, multipliers: PerConstraint, ceiling: Scalar
) -> PerConstraint:
    """Penalty weights just above the multipliers, falling only by halves.

    Powell's rule. Weights far above the multipliers make the merit's valley narrow, and
    the steps short; an entry whose multiplier happens to vanish keeps a share of the
    mean, or its defect would be free.
    """

    def follow(weight: Array, multiplier: Array) -> Array:
        if not weight.size:
            return weight
        wanted = 1.1 * jnp.abs(multiplier)
        least = 0.1 * jnp.mean(jnp.abs(multiplier))
        kept = jnp.maximum(wanted, 0.5 * (weight + wanted))
        return jnp.clip(kept, least, 10.0 * ceiling)

    return jax.tree.map(follow, weights, multipliers)
