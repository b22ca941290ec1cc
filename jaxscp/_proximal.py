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
    second_order_model,
    worst_violation,
)
from ._optimality import Optimality, optimality
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
    tolerance: float = eqx.field(static=True, default=1e-8)
    min_reduction: float = eqx.field(static=True, default=1e-7)
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
    # Near a solution: residuals there, and the least weight of the proximal term.
    near: float = eqx.field(static=True, default=1e-4)
    min_weight: float = eqx.field(static=True, default=1e-6)
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
        # Where the step before was refused, derivatives are still fresh.
        refused = state.iterate.fresh
        iterate = linearized(transcription, state.scaling, state.iterate)
        gap = optimality(transcription, state.scaling, iterate, state.solution)
        state = dataclasses.replace(
            state,
            iterate=iterate,
            finite=is_finite(iterate),
            optimality=jnp.where(state.iterations > 0, gap.residual, jnp.inf),
        )
        near = self._is_near(transcription, gap) & (state.iterations > 0)
        # Levenberg and Marquardt: a weight that vanishes with the residual converges
        # fast, and does not stray along directions the cost hardly sees.
        weight = jnp.maximum(transcription.nodes * gap.stationarity, self.min_weight)
        radius = jnp.where(near & ~refused, 1.0 / weight, state.radius)
        state = dataclasses.replace(state, radius=radius)
        return jax.lax.cond(
            state.optimality <= self.tolerance,
            lambda state: state,
            lambda state: self._iterate(transcription, state, near),
            state,
        )

    def _is_near(self, transcription: Transcription, gap: Optimality) -> Array:
        """Whether Newton's method may be trusted without a merit function."""
        if not self._second_order(transcription):
            return jnp.array(False)
        return (gap.stationarity <= self.near) & (gap.feasibility <= 10.0 * self.near)

    def _second_order(self, transcription: Transcription) -> bool:
        return self.curvature and transcription.has_exact_hessian

    def _iterate(
        self, transcription: Transcription, state: SCPState, near: Array
    ) -> SCPState:
        model = self._model(transcription, state)
        found, judgement = search(
            transcription,
            state,
            model,
            solve=lambda around: self._solve(transcription, state, around),
            follow=lambda to: _following(state.weights, to, state.ceiling),
            accept_ratio=self.accept_ratio,
            # No ratio is below minus infinity, all are below plus infinity.
            correction_ratio=jnp.where(near, jnp.inf, self.correction_ratio)
            if self.correction
            else -jnp.inf,
        )
        # The exact penalty hides progress that is second order in the step.
        harmless = judgement.actual >= -self.near * (1.0 + jnp.abs(judgement.reference))
        trusted = near & found.best.solution.effort.solved & harmless
        judgement = dataclasses.replace(judgement, accepted=judgement.accepted | trusted)
        return self._advance(transcription, state, found, judgement, near)

    def _model(self, transcription: Transcription, state: SCPState) -> Model:
        iterate, multipliers = state.iterate, state.solution.multipliers
        point = (transcription, state.scaling, iterate.variables)
        if not self._second_order(transcription):
            share = 1.0 if self.curvature else 0.0
            return convex_model(
                *point,
                iterate.residuals,
                iterate.derivatives,
                jax.tree.map(lambda leaf: share * leaf, multipliers),
            )
        return second_order_model(
            *point,
            iterate.substeps,
            iterate.residuals,
            iterate.derivatives,
            multipliers,
            self._damping(transcription, state),
        )

    def _damping(self, transcription: Transcription, state: SCPState) -> Variables:
        """The proximal term, and the hold that active limits have on their variables."""
        each = 1.0 / state.radius / transcription.nodes
        held = jnp.where(transcription.fixed_states, 0.0, state.solution.state)
        # As strong as a barrier would be at a hundredth of the range.
        states, controls = (
            jnp.minimum(100.0 * jnp.where(jnp.abs(m) > 1e-7, jnp.abs(m), 0.0), 1e3)
            for m in (held, state.solution.control)
        )
        return Variables(states + each, controls + each, 1.0 / state.radius)

    def _solve(
        self, transcription: Transcription, state: SCPState, model: Model
    ) -> SubproblemSolution:
        scaling, reference = state.scaling, state.iterate.variables
        residuals, ceiling = model.residuals, state.ceiling
        prices = Prices(
            # Exact models have it in them already.
            proximal=1.0 / state.radius if model.damping is None else jnp.zeros(()),
            virtual_control=jnp.full_like(residuals.defects, ceiling),
            path=jnp.full_like(residuals.path, ceiling),
            integral=jnp.full_like(residuals.totals, ceiling),
            radius=jnp.zeros(()),
        )
        limits = step_limits(transcription, scaling, reference)
        structure = Structure.of(transcription)
        # A hundredth of the tolerance; below 1e-8 PIQP's residuals are rounding errors.
        exact = PIQP(tolerance=1e-10)
        solution = solve_subproblem(structure, self.qp or exact, model, prices, limits)
        costates = model.costates(solution.multipliers.dynamics, solution.step)
        return eqx.tree_at(lambda s: s.multipliers.dynamics, solution, costates)

    def _advance(
        self,
        transcription: Transcription,
        state: SCPState,
        found: Search,
        judgement: Judgement,
        near: Array,
    ) -> SCPState:
        trial = found.best
        ratio, factor = judgement.ratio, self.weight_factor
        radius = jnp.where(ratio < self.poor_ratio, state.radius / factor, state.radius)
        radius = jnp.where(ratio > self.good_ratio, radius * factor, radius)
        calm = jnp.where(judgement.accepted, state.radius, state.radius / factor**2)
        radius = jnp.where(near, calm, radius)
        # A heavy proximal term makes every prediction small: take it out again.
        held_back = jnp.maximum(1.0, 1.0 / state.radius)
        stationary = judgement.predicted * held_back <= self.min_reduction
        stationary &= ~near
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
