"""`ProximalSCP`: the default method."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp

from ._assembly import Prices
from ._iteration import (
    Judgement,
    SCPState,
    Trial,
    advance,
    is_finite,
    judge,
    linearized,
    start,
    tree_where,
    try_step,
)
from ._layout import Structure
from ._model import (
    Model,
    PerConstraint,
    convex_model,
    integral_limits,
    penalized_cost,
    worst_violation,
)
from ._qp import PIQP
from ._scp import AbstractSCP
from ._subproblem import SubproblemSolution, solve_subproblem, step_limits
from ._transcription import Residuals, Transcription, Variables
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
    - `qp`: the solver of the subproblems.
    """

    max_iterations: int = eqx.field(static=True, default=100)
    tolerance: float = eqx.field(static=True, default=1e-4)
    feasibility_tolerance: float = eqx.field(static=True, default=1e-5)
    initial_weight: float = eqx.field(static=True, default=10.0)
    curvature: bool = eqx.field(static=True, default=True)
    correction: bool = eqx.field(static=True, default=True)
    qp: PIQP = PIQP()
    # Ratios that accept a step, raise the weight, lower it, and call for a correction.
    accept_ratio: float = eqx.field(static=True, default=0.01)
    poor_ratio: float = eqx.field(static=True, default=0.25)
    good_ratio: float = eqx.field(static=True, default=0.7)
    correction_ratio: float = eqx.field(static=True, default=0.5)
    weight_factor: float = eqx.field(static=True, default=3.0)
    min_radius: float = eqx.field(static=True, default=1e-12)
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
        search, judgement = self._search(transcription, state, model)
        return self._advance(transcription, state, search, judgement)

    def _search(
        self, transcription: Transcription, state: SCPState, model: Model
    ) -> tuple["_Search", Judgement]:
        """The subproblem's step or, if that is poor, its second-order correction.

        The correction solves the same subproblem with what the linearization missed at
        the first trial added to every constraint: c(z + d) - J d instead of c(z).
        Fletcher, "Practical Methods of Optimization", Section 14.4. Both passes are one
        loop, so that a subproblem is compiled once.
        """
        scaling, here = state.scaling, model.residuals
        limits = integral_limits(transcription, scaling)

        def judged(search: _Search) -> Judgement:
            reference = penalized_cost(here, limits, search.weights)
            expected = penalized_cost(search.expected, limits, search.weights)
            predicted = reference - expected
            return judge(reference, predicted, search.best, self.accept_ratio)

        def again(search: _Search) -> Array:
            solved = search.best.solution.effort.solved
            poor = judged(search).ratio < self.correction_ratio
            correct = self.correction & (search.passes == 1) & solved & poor
            return (search.passes == 0) | correct

        def attempt(search: _Search) -> _Search:
            first, best = search.passes == 0, search.best
            around = Model(search.around, model.derivatives, model.hessian)
            solution = self._solve(transcription, state, around)
            followed = _following(state.weights, solution.multipliers, state.ceiling)
            weights = tree_where(first, followed, search.weights)
            expected = tree_where(first, model.predict(solution.step), search.expected)
            trial = try_step(transcription, scaling, state.iterate, solution, weights)
            better = first | (solution.effort.solved & (trial.cost < best.cost))
            # Multipliers stay those of the uncorrected subproblem: penalty weights and
            # the convergence test speak of that one.
            kept = tree_where(first, solution, best.solution)
            total = solution.effort.after(best.solution.effort)
            taken = dataclasses.replace(
                kept,
                step=tree_where(better, solution.step, kept.step),
                effort=dataclasses.replace(
                    tree_where(first, solution.effort, total), solved=kept.effort.solved
                ),
            )
            seen = trial.residuals
            missed = (seen.increments - expected.increments).at[:, -1].set(0.0)
            return _Search(
                passes=search.passes + 1,
                around=Residuals(
                    objective=here.objective,
                    defects=here.defects + seen.defects - expected.defects,
                    path=here.path + seen.path - expected.path,
                    # But for the cost, whose curvature the model has already.
                    increments=here.increments + missed,
                ),
                weights=weights,
                expected=expected,
                best=dataclasses.replace(tree_where(better, trial, best), solution=taken),
            )

        zero = jnp.zeros(())
        nowhere = Trial(
            state.solution, state.iterate.variables, here, zero + jnp.inf, zero
        )
        search = _Search(jnp.zeros((), int), here, state.weights, here, nowhere)
        search = jax.lax.while_loop(again, attempt, search)
        return search, judged(search)

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
        return solve_subproblem(structure, self.qp, model, prices, limits)

    def _advance(
        self,
        transcription: Transcription,
        state: SCPState,
        search: "_Search",
        judgement: Judgement,
    ) -> SCPState:
        trial = search.best
        ratio, factor = judgement.ratio, self.weight_factor
        radius = jnp.where(ratio < self.poor_ratio, state.radius / factor, state.radius)
        radius = jnp.where(ratio > self.good_ratio, radius * factor, radius)
        # A heavy proximal term makes every prediction small: take it out again.
        held_back = jnp.maximum(1.0, 1.0 / state.radius)
        stationary = judgement.predicted * held_back <= self.tolerance
        limits = integral_limits(transcription, state.scaling)
        here = tree_where(judgement.accepted, trial.residuals, state.iterate.residuals)
        infeasible = worst_violation(here, limits) > self.feasibility_tolerance
        # Where even the model leaves a violation, virtual variables may be too cheap.
        bought = worst_violation(search.expected, limits) > self.feasibility_tolerance
        cheap = stationary & bought & (state.ceiling < self.max_ceiling)
        ceiling = jnp.where(cheap, 10.0 * state.ceiling, state.ceiling)
        return advance(
            transcription,
            state,
            trial,
            judgement,
            weights=search.weights,
            ceiling=ceiling,
            radius=jnp.minimum(radius, self.max_radius),
            stationary=stationary & (~infeasible | bought) & ~cheap,
            iterations=state.iterations + 1,
        )


class _Search(eqx.Module):
    """One or two passes for a step.

    - `around`: the residuals the next subproblem is built on.
    - `expected`: those the model predicts for the uncorrected step.
    """

    passes: Array
    around: Residuals
    weights: PerConstraint
    expected: Residuals
    best: Trial


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
