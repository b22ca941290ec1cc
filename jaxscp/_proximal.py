"""`ProximalSCP`: the default method."""

import dataclasses
import math

import equinox as eqx
import jax
import jax.numpy as jnp

from ._active_set import NewtonStep, active_set_step
from ._curvature import Curvature
from ._damping import Damping
from ._iteration import advance, is_finite, linearized, start
from ._layout import Structure
from ._model import Model, model_curvatures
from ._newton_scp import AbstractNewtonSCP
from ._optimality import optimality
from ._prospects import prospects
from ._qp import PIQP
from ._search import Search, search
from ._state import Judgement, SCPState
from ._subproblem import SubproblemSolution, solve_subproblem, step_limits
from ._subproblem_data import Limits, Prices
from ._transcription import Residuals, Transcription, Variables
from ._tree import tree_where
from ._trust_region import blind_reach, metric, next_radius, next_reach
from ._types import Array

# Corrections of a polishing step, which may go far along what the cost hardly sees: each
# costs a third of an iteration.
_POLISHING = 2
# A scaled cost this small hardly counts.
_VANISHING = 1e-3


class ProximalSCP(AbstractNewtonSCP):
    """SCP with a soft 2-norm trust region and second-order information.

    Each subproblem adds half the squared scaled step, times a weight, to a convex model
    of the Lagrangian: the Lagrangian of the paper's norm ball. The ratio of actual to
    predicted reduction of an exact penalty steers the weight, and a second-order
    correction takes back what the linearization missed. Penalty weights follow the
    multipliers. The dynamics are exact equalities of the subproblem, and virtual control
    enters only where those cannot be met.

    Far from a solution the model has the curvature of costs, path constraints and
    integrals, made convex at each node, and the trust region is narrow where the dynamics
    curve: its measure adds the size of their curvature in the Lagrangian. Nearer to one
    the steps are Newton's, with all of that curvature, convex or not, along the
    constraints that were active, and as long as earlier ones proved right. Close to it
    no merit function judges them, and their least weight is that of Levenberg and
    Marquardt: the iterate is polished to a point that meets the optimality conditions.

    **Arguments:**

    - `tolerance`: of the scaled residual of the optimality conditions.
    - `max_iterations`: convex subproblems allowed, corrections not counted.
    - `max_polish`: steps of Newton's method allowed.
    - `min_reduction`: stop where steps promise less, relative to the cost's scale.
    - `feasibility_tolerance`: defects and violations allowed where the residual cannot
        be brought below its tolerance, relative to the scales.
    - `initial_weight`: of the proximal term in the first subproblem.
    - `curvature`: of the model: "all", "nodes" (without the dynamics') or "cost".
    - `correction`: whether poor steps, and those of polishing that leave the constraints,
        get a second-order correction.
    - `qp`: the solver of the subproblems.
    """

    tolerance: float = eqx.field(static=True, default=1e-8)
    max_iterations: int = eqx.field(static=True, default=300)
    max_polish: int = eqx.field(static=True, default=400)
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
    # Residuals below which the multipliers are good enough for all of the curvature,
    # below which Newton's method needs no merit function, and from which it finds back.
    close: float = eqx.field(static=True, default=10.0)
    near: float = eqx.field(static=True, default=1e-6)
    far: float = eqx.field(static=True, default=1e-3)
    # Newton's longest step: of about the variables' scales, on the mean over the nodes.
    longest: float = eqx.field(static=True, default=1.0)
    min_radius: float = eqx.field(static=True, default=1e-12)
    max_radius: float = eqx.field(static=True, default=1e9)
    max_failures: int = eqx.field(static=True, default=5)
    # Price of virtual variables: above any likely multiplier, raised if it is not.
    initial_ceiling: float = eqx.field(static=True, default=1e2)
    max_ceiling: float = eqx.field(static=True, default=1e6)

    def __check_init__(self):
        if not 0.0 < self.initial_weight < math.inf:
            raise ValueError(
                f"initial_weight={self.initial_weight!r}: give a positive number."
            )

    def init(
        self, transcription: Transcription, guess: Variables, again: bool | Array = False
    ) -> SCPState:
        return start(
            transcription,
            guess,
            SubproblemSolution.none(Structure.of(transcription)),
            again,
            radius=1.0 / self.initial_weight,
            ceiling=self.initial_ceiling,
            records=self.max_iterations + self.max_polish,
        )

    def step(self, transcription: Transcription, state: SCPState) -> SCPState:
        iterate = linearized(transcription, state.scaling, state.iterate)
        gap = optimality(transcription, state.scaling, iterate, state.solution)
        begun = state.records > 0
        after = dataclasses.replace(
            state,
            iterate=iterate,
            finite=is_finite(iterate),
            optimality=jnp.where(begun, gap.residual, jnp.inf),
        )
        near = begun & self.is_near(after, gap)
        blind = blind_reach(transcription, state, after, self.tolerance)
        reach = tree_where(near, blind, state.reach)
        after = dataclasses.replace(after, near=near, reach=reach)
        return jax.lax.cond(
            after.optimality <= self.tolerance,
            lambda state: state,
            lambda state: self._iterate(transcription, state),
            after,
        )

    def is_misled(self, state: SCPState) -> Array:
        """A cost next to nothing beside its scale meets every tolerance."""
        cost = jnp.abs(state.iterate.residuals.objective)
        return (cost < _VANISHING) & (cost > 0.0)

    def _iterate(self, transcription: Transcription, state: SCPState) -> SCPState:
        sound = self.is_sound(state)
        iterate, multipliers = state.iterate, state.solution.multipliers
        at = (transcription, state.scaling, iterate.variables, iterate.substeps)
        curvatures = model_curvatures(*at, multipliers, sound, self.curvature)
        parts = curvatures, metric(transcription, state, curvatures, sound)
        poor = jnp.asarray(self.correction_ratio if self.correction else -jnp.inf)
        found, judgement = search(
            transcription,
            state,
            solve=lambda around, start: self._solve(
                transcription, state, around, start, *parts
            ),
            newton=NewtonStep.begun(state.solution, state.reach.weight),
            accept_ratio=self.accept_ratio,
            # Of a polishing step what counts is whether it stays feasible.
            correction_ratio=jnp.where(state.near, -jnp.inf, poor),
            feasibility=jnp.where(
                state.near & self.correction, 0.01 * state.optimality, jnp.inf
            ),
            corrections=jnp.where(state.near, _POLISHING, 1),
        )
        # The exact penalty hides progress that is second order in the step.
        harmless = judgement.actual >= -self.far * (1.0 + jnp.abs(judgement.reference))
        trusted = state.near & found.best.solution.effort.solved & harmless
        accepted = judgement.accepted | trusted
        judgement = dataclasses.replace(judgement, accepted=accepted)
        return self._advance(transcription, state, found, judgement)

    def _solve(
        self,
        transcription: Transcription,
        state: SCPState,
        around: Residuals,
        start: NewtonStep,
        curvatures: tuple[Curvature, Curvature],
        measure: Damping,
    ) -> tuple[SubproblemSolution, Model, NewtonStep]:
        """Newton's step, along the constraints that were active, where there is one; that
        of the convex model elsewhere."""
        derivatives = state.iterate.derivatives
        convex, exact = (Model(around, derivatives, each) for each in curvatures)
        limits = step_limits(transcription, state.scaling, state.iterate.variables)
        weight = 1.0 / state.radius
        newton = NewtonStep.none(start.solution, weight)
        if self.curvature == "all":
            newton = jax.lax.cond(
                # Where there is no step there is none to correct.
                self.trusts_newton(state) & start.found,
                lambda: active_set_step(
                    exact,
                    measure,
                    limits,
                    transcription.watch,
                    start,
                    jnp.maximum(1e-3 * state.optimality, 1e-11),
                    longest=self.longest_step(state),
                    # A convex subproblem's step is better than a short one.
                    heaviest=jnp.where(state.near, jnp.inf, weight),
                    slack=self.tolerance,
                ),
                lambda: newton,
            )
        solution = jax.lax.cond(
            newton.found,
            lambda: newton.solution,
            lambda: self._by_qp(transcription, state, convex, measure, limits),
        )
        return solution, tree_where(newton.found, exact, convex), newton

    def _by_qp(
        self,
        transcription: Transcription,
        state: SCPState,
        model: Model,
        measure: Damping,
        limits: Limits,
    ) -> SubproblemSolution:
        structure, damping = (
            Structure.of(transcription),
            measure.times(1.0 / state.radius),
        )
        prices = self._prices(structure, state)
        return solve_subproblem(structure, self.qp, model, damping, prices, limits)

    def _prices(self, structure: Structure, state: SCPState) -> Prices:
        residuals, ceiling = state.iterate.residuals, state.ceiling
        return Prices(
            virtual_control=jnp.full_like(residuals.defects, ceiling),
            path=jnp.full_like(residuals.path, ceiling),
            limit=jnp.full((structure.nodes - 1, structure.limits), ceiling),
            integral=jnp.full_like(residuals.totals, ceiling),
            radius=jnp.zeros(()),
            # As exact as the way still to go deserves.
            precision=jnp.clip(1e-5 * state.optimality, 1e-10, 1e-7),
            relax=jnp.where(state.near, 0.0, 1.0),
        )

    def _advance(
        self,
        transcription: Transcription,
        state: SCPState,
        found: Search,
        judgement: Judgement,
    ) -> SCPState:
        trial, near, newton = found.best, state.near, found.newton
        # A step too long leads to no better multipliers than those that led to it.
        kept = dataclasses.replace(state.solution, effort=trial.solution.effort)
        kept = tree_where(
            (near | newton.found) & ~judgement.accepted, kept, trial.solution
        )
        trial = dataclasses.replace(trial, solution=kept)
        ahead = prospects(
            transcription,
            state,
            found,
            judgement,
            may_polish=self.may_polish(state),
            close=self.close,
            poor_ratio=self.poor_ratio,
            min_reduction=self.min_reduction,
            min_progress=self.min_progress,
            feasibility_tolerance=self.feasibility_tolerance,
            max_ceiling=self.max_ceiling,
        )
        ceiling = jnp.where(ahead.cheap, 10.0 * state.ceiling, state.ceiling)
        poor, good = self.poor_ratio, self.good_ratio
        ratios = {"poor_ratio": poor, "good_ratio": good, "factor": self.weight_factor}
        longest = self.longest_step(state)
        radius = next_radius(state, judgement, newton, longest=longest, **ratios)
        reach = next_reach(state, judgement, newton, **ratios)
        return advance(
            transcription,
            state,
            trial,
            judgement,
            merit=found.merit,
            ceiling=ceiling,
            radius=jnp.minimum(radius, self.max_radius),
            stationary=ahead.stationary,
            iterations=state.iterations + ~newton.found,
            polish=state.polish + newton.found,
            near=ahead.near,
            reach=reach,
            own=judgement.accepted | newton.found,
        )
