"""`ProximalSCP`: the default method."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp

from ._iteration import advance, is_finite, linearized, start, tree_where
from ._layout import Structure
from ._model import (
    Model,
    convex_model,
    integral_limits,
    second_order_model,
    worst_violation,
)
from ._optimality import Optimality, optimality
from ._penalty_weights import following
from ._qp import PIQP
from ._scp import AbstractSCP
from ._search import Search, search
from ._state import Judgement, SCPState
from ._subproblem import SubproblemSolution, solve_subproblem, step_limits
from ._subproblem_data import Prices
from ._transcription import Transcription, Variables
from ._types import Array, Scalar


class ProximalSCP(AbstractSCP):
    """SCP with a soft 2-norm trust region and second-order information.

    Each subproblem adds half the squared scaled step, times a weight, to a convex model
    of the Lagrangian: the Lagrangian of the paper's norm ball. The ratio of actual to
    predicted reduction of an exact penalty steers the weight, and a second-order
    correction takes back what the linearization missed. Penalty weights follow the
    multipliers. The dynamics are exact equalities of the subproblem, and virtual control
    enters only where those cannot be met.

    The model has all of the Lagrangian's curvature where controls are held and integrals
    follow the flow; elsewhere that of costs, path constraints and integrals. Near a
    solution the first is Newton's method with the weight of Levenberg and Marquardt: the
    iterate is polished to a point that satisfies the optimality conditions.

    **Arguments:**

    - `tolerance`: of the scaled residual of the optimality conditions.
    - `max_iterations`: subproblems allowed before polishing, corrections not counted.
    - `max_polish`: subproblems allowed for polishing.
    - `min_reduction`: stop where steps promise less, relative to the cost's scale.
    - `feasibility_tolerance`: defects and violations allowed where the residual cannot
        be brought below its tolerance, relative to the scales.
    - `initial_weight`: of the proximal term in the first subproblem.
    - `curvature`: of the model: "all", "nodes" (without the dynamics') or "cost".
    - `correction`: whether poor steps, and all that polish, get a second-order
        correction. On fine grids it costs as much as it saves; coarse ones need it.
    - `qp`: the solver of the subproblems.
    """

    tolerance: float = eqx.field(static=True, default=1e-6)
    max_iterations: int = eqx.field(static=True, default=100)
    max_polish: int = eqx.field(static=True, default=60)
    min_reduction: float = eqx.field(static=True, default=1e-7)
    feasibility_tolerance: float = eqx.field(static=True, default=1e-5)
    initial_weight: float = eqx.field(static=True, default=10.0)
    curvature: str = eqx.field(static=True, default="all")
    correction: bool = eqx.field(static=True, default=True)
    qp: PIQP = PIQP()
    # Ratios that accept a step, raise the weight, lower it, and call for a correction.
    accept_ratio: float = eqx.field(static=True, default=0.01)
    poor_ratio: float = eqx.field(static=True, default=0.25)
    good_ratio: float = eqx.field(static=True, default=0.7)
    correction_ratio: float = eqx.field(static=True, default=0.5)
    weight_factor: float = eqx.field(static=True, default=3.0)
    # Promised reduction below which remaining violations are there to stay.
    min_progress: float = eqx.field(static=True, default=1e-4)
    # Residual below which Newton's method needs no merit function.
    near: float = eqx.field(static=True, default=1e-4)
    min_radius: float = eqx.field(static=True, default=1e-12)
    max_radius: float = eqx.field(static=True, default=1e6)
    max_failures: int = eqx.field(static=True, default=5)
    # Price of virtual variables: above any likely multiplier, raised if it is not.
    initial_ceiling: float = eqx.field(static=True, default=1e2)
    max_ceiling: float = eqx.field(static=True, default=1e6)

    def __check_init__(self):
        if self.curvature not in ("all", "nodes", "cost"):
            raise ValueError(
                f"curvature={self.curvature!r}: choose 'all', 'nodes' or 'cost'."
            )

    def init(self, transcription: Transcription, guess: Variables) -> SCPState:
        return start(
            transcription,
            guess,
            SubproblemSolution.none(Structure.of(transcription)),
            radius=1.0 / self.initial_weight,
            ceiling=self.initial_ceiling,
            records=self.max_iterations + self.max_polish,
        )

    def step(self, transcription: Transcription, state: SCPState) -> SCPState:
        # Where the step before was refused, derivatives are still fresh.
        refused = state.iterate.fresh
        iterate = linearized(transcription, state.scaling, state.iterate)
        gap = optimality(transcription, state.scaling, iterate, state.solution)
        begun = state.records > 0
        near = begun & self._is_near(transcription, gap)
        # Levenberg and Marquardt: a weight that vanishes with the residual converges
        # fast, and does not stray along directions the cost hardly sees. Three holds
        # such steps, as of a quadrotor's yaw, to a third of the range.
        polishing = 1.0 / (3.0 * transcription.nodes * gap.residual)
        polishing = jnp.minimum(polishing, self.max_radius)
        radius = jnp.where(near & ~refused, polishing, state.radius)
        state = dataclasses.replace(
            state,
            iterate=iterate,
            finite=is_finite(iterate),
            optimality=jnp.where(begun, gap.residual, jnp.inf),
            radius=radius,
        )
        return jax.lax.cond(
            state.optimality <= self.tolerance,
            lambda state: state,
            lambda state: self._iterate(transcription, state, near),
            state,
        )

    def _is_near(self, transcription: Transcription, gap: Optimality) -> Array:
        """Whether Newton's method may be trusted without a merit function."""
        if not self._is_second_order(transcription):
            return jnp.array(False)
        return (gap.stationarity <= self.near) & (gap.feasibility <= 10.0 * self.near)

    def _is_second_order(self, transcription: Transcription) -> bool:
        return self.curvature == "all" and transcription.has_exact_hessian

    def _iterate(
        self, transcription: Transcription, state: SCPState, near: Array
    ) -> SCPState:
        model = self._model(transcription, state)
        # No ratio is below minus infinity, all are below plus infinity.
        poor = jnp.where(near, jnp.inf, self.correction_ratio)
        found, judgement = search(
            transcription,
            state,
            model,
            solve=lambda around: self._solve(transcription, state, around),
            follow=lambda to: following(state.weights, to, state.ceiling),
            accept_ratio=self.accept_ratio,
            correction_ratio=poor if self.correction else jnp.asarray(-jnp.inf),
        )
        # The exact penalty hides progress that is second order in the step.
        harmless = judgement.actual >= -self.near * (1.0 + jnp.abs(judgement.reference))
        trusted = near & found.best.solution.effort.solved & harmless
        accepted = judgement.accepted | trusted
        judgement = dataclasses.replace(judgement, accepted=accepted)
        return self._advance(transcription, state, found, judgement, near)

    def _uses_exact(self, transcription: Transcription, state: SCPState) -> Array:
        """Whether the next model has all of the curvature.

        Not after virtual control was needed: along dynamics that are not met, what one
        interval takes from another does not cancel.
        """
        exact = self._is_second_order(transcription)
        return jnp.array(exact) & ~state.solution.effort.relaxed

    def _model(self, transcription: Transcription, state: SCPState) -> Model:
        iterate, multipliers = state.iterate, state.solution.multipliers
        point = (transcription, state.scaling, iterate.variables)
        known = (iterate.residuals, iterate.derivatives)
        share = 0.0 if self.curvature == "cost" else 1.0
        weighed = jax.tree.map(lambda leaf: share * leaf, multipliers)
        if not self._is_second_order(transcription):
            return convex_model(*point, *known, weighed)
        return jax.lax.cond(
            self._uses_exact(transcription, state),
            lambda: second_order_model(
                *point,
                # Half the steps tell the curvature well enough to converge fast.
                (iterate.substeps + 1) // 2,
                *known,
                multipliers,
                *self._damping(transcription, state),
            ),
            lambda: convex_model(*point, *known, weighed),
        )

    def _damping(
        self, transcription: Transcription, state: SCPState
    ) -> tuple[Variables, Array]:
        """The proximal term, and the hold of active limits and path constraints.

        The Lagrangian need only be convex along the active limits: holding the step to
        them costs nothing once it is right which ones are active.
        """
        last, each = state.solution, 1.0 / state.radius / transcription.nodes

        def hold(multiplier: Array) -> Array:
            size = jnp.abs(multiplier)
            # PIQP leaves traces on limits that are not active.
            return jnp.minimum(100.0 * jnp.where(size > 1e-7, size, 0.0), 1e3)

        free = jnp.where(transcription.fixed_states, 0.0, last.state)
        damping = Variables(
            hold(free) + each, hold(last.control) + each, 1.0 / state.radius
        )
        return damping, hold(last.multipliers.path)

    def _solve(
        self, transcription: Transcription, state: SCPState, model: Model
    ) -> SubproblemSolution:
        scaling, reference = state.scaling, state.iterate.variables
        residuals, ceiling = model.residuals, state.ceiling
        prices = Prices(
            # Exact models have it in them already.
            proximal=jnp.where(
                self._uses_exact(transcription, state), 0.0, 1.0 / state.radius
            ),
            virtual_control=jnp.full_like(residuals.defects, ceiling),
            path=jnp.full_like(residuals.path, ceiling),
            integral=jnp.full_like(residuals.totals, ceiling),
            radius=jnp.zeros(()),
            # As exact as the way still to go deserves.
            precision=jnp.clip(1e-5 * state.optimality, 1e-10, 1e-7),
        )
        limits = step_limits(transcription, scaling, reference)
        structure = Structure.of(transcription)
        solution = solve_subproblem(structure, self.qp, model, prices, limits)
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
        limits = integral_limits(transcription, state.scaling)
        here = tree_where(judgement.accepted, trial.residuals, state.iterate.residuals)
        infeasible = worst_violation(here, limits) > self.feasibility_tolerance
        # Where even the model leaves a violation, virtual variables may be too cheap.
        bought = worst_violation(found.expected, limits) > self.feasibility_tolerance
        # A heavy proximal term makes every prediction small: take it out again.
        promised = judgement.predicted * jnp.maximum(1.0, 1.0 / state.radius)
        least = jnp.where(bought, self.min_progress, self.min_reduction)
        # Where violations outweigh the cost: within what a QP solver resolves.
        noise = 1e-9 * jnp.abs(judgement.reference)
        stationary = (promised <= least) | (judgement.predicted <= noise)
        stationary = jnp.where(near, state.polish + 1 >= self.max_polish, stationary)
        stationary &= trial.solution.effort.solved
        cheap = stationary & bought & (state.ceiling < self.max_ceiling)
        ceiling = jnp.where(cheap, 10.0 * state.ceiling, state.ceiling)
        return advance(
            transcription,
            state,
            trial,
            judgement,
            weights=found.weights,
            ceiling=ceiling,
            radius=jnp.minimum(
                self._next_radius(state, judgement, near), self.max_radius
            ),
            stationary=stationary & (~infeasible | bought) & ~cheap,
            iterations=state.iterations + ~near,
            polish=state.polish + near,
        )

    def _next_radius(self, state: SCPState, judgement: Judgement, near: Array) -> Scalar:
        ratio, factor = judgement.ratio, self.weight_factor
        change = jnp.where(ratio < self.poor_ratio, 1.0 / factor, 1.0)
        change = jnp.where(ratio > self.good_ratio, factor, change)
        # A model that is right so far is right farther out.
        change = jnp.where(jnp.abs(ratio - 1.0) < 0.15, 2.0 * factor, change)
        polishing = jnp.where(judgement.accepted, 1.0, 1.0 / factor**2)
        return state.radius * jnp.where(near, polishing, change)
