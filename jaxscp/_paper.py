"""`PaperSCP`: Algorithm 1 of the paper, to the letter."""

import dataclasses
import math

import equinox as eqx
import jax
import jax.numpy as jnp

from ._constraints import integral_limits
from ._damping import Damping
from ._iteration import advance, is_finite, judge, linearized, start, try_step
from ._lagrangian import node_shares
from ._layout import Structure
from ._merit import ExactPenalty
from ._model import Model, nodewise_curvature
from ._per_constraint import PerConstraint
from ._qp import PIQP
from ._scp import AbstractSCP
from ._state import SCPState
from ._subproblem import SubproblemSolution, solve_subproblem, step_limits
from ._subproblem_data import Prices
from ._transcription import Transcription, Variables
from ._types import Array


class PaperSCP(AbstractSCP):
    r"""The paper's loop: virtual control, fixed L1 penalty, norm trust region.

    Every subproblem has virtual control on the dynamics and virtual buffers on nonconvex
    constraints, both at a fixed price, and a hard trust region at each node (eq. 19),

    $$\|\delta x_k\| + \|\delta u_k\| + |\delta T| \le \Upsilon.$$

    The norms are infinity norms, which a QP can hold and the paper's theorems allow.
    What the paper leaves open is set so: variables and cost are divided by their scales,
    so that the radius 1 has a meaning; the cost T u'u, which is not convex in (T, u)
    together, enters quadratic in u and linear in T; rho and alpha are those of Mao et
    al., "Successive Convexification", 2017, with rho_0 slightly above zero.

    **Arguments:**

    - `max_iterations`: steps taken at most. As in the paper, rejected ones do not count.
    - `tolerance`: epsilon of the stopping criterion J^r - L^s <= epsilon (eq. 22),
        relative to the cost's scale.
    - `initial_radius`: first radius of the trust region, relative to the scales.
    - `penalty`: lambda, within the range the paper recommends, 1e2 to 1e5. As in
        eqs. 14 to 20 the penalty stands under the trapezoidal sum over normalized time.
    - `rho_0`, `rho_1`, `rho_2`, `alpha`: parameters of the ratio test.
    - `feasibility_tolerance`: defects and violations, relative to the scales, beyond
        which virtual variables count as remaining.
    - `min_radius`: below it the trust region has collapsed.
    - `max_failures`: the algorithm has no answer to a subproblem without solution.
    - `qp`: the solver of the subproblems.
    """

    max_iterations: int = eqx.field(static=True, default=50)
    tolerance: float = eqx.field(static=True, default=1e-4)
    initial_radius: float = eqx.field(static=True, default=1.0)
    penalty: float = eqx.field(static=True, default=1e3)
    rho_0: float = eqx.field(static=True, default=0.01)
    rho_1: float = eqx.field(static=True, default=0.25)
    rho_2: float = eqx.field(static=True, default=0.7)
    alpha: float = eqx.field(static=True, default=2.0)
    feasibility_tolerance: float = eqx.field(static=True, default=1e-4)
    min_radius: float = eqx.field(static=True, default=1e-10)
    max_failures: int = eqx.field(static=True, default=1)
    qp: PIQP = PIQP()

    def __check_init__(self):
        ordered = 0 < self.rho_0 < self.rho_1 < self.rho_2 < 1
        if not ordered:
            raise ValueError(
                f"rho_0={self.rho_0}, rho_1={self.rho_1}, rho_2={self.rho_2}: "
                "need 0 < rho_0 < rho_1 < rho_2 < 1."
            )
        if not 1.0 < self.alpha < math.inf:
            raise ValueError(f"alpha={self.alpha}: need alpha > 1.")
        if not self.min_radius <= self.initial_radius < math.inf:
            raise ValueError(
                f"initial_radius={self.initial_radius}: need a number from "
                f"min_radius={self.min_radius:g}."
            )

    def init(
        self, transcription: Transcription, guess: Variables, again: bool | Array = False
    ) -> SCPState:
        return start(
            transcription,
            guess,
            SubproblemSolution.none(self._structure(transcription)),
            again,
            radius=self.initial_radius,
            ceiling=self.penalty,
            records=self._most_steps,
        )

    def step(self, transcription: Transcription, state: SCPState) -> SCPState:
        iterate = linearized(transcription, state.scaling, state.iterate)
        state = dataclasses.replace(state, iterate=iterate, finite=is_finite(iterate))
        limits = integral_limits(transcription, state.scaling)
        merit = ExactPenalty(self._weights(transcription, state))
        # The paper's model has the cost's own curvature and nobody else's.
        curvature = nodewise_curvature(
            transcription,
            state.scaling,
            iterate.variables,
            transcription.no_multipliers,
        )
        model = Model(iterate.residuals, iterate.derivatives, curvature)
        solution = self._solve(transcription, state, model, merit.weights)
        reference = merit.cost(iterate.residuals, limits)
        expected = merit.cost(model.predict(solution.step), limits)
        predicted = reference - expected
        trial = try_step(transcription, state.scaling, iterate, solution, merit)
        judgement = judge(reference, predicted, trial, self.rho_0)
        ratio, radius = judgement.ratio, state.radius
        radius = jnp.where(ratio < self.rho_1, radius / self.alpha, radius)
        radius = jnp.where(ratio >= self.rho_2, radius * self.alpha, radius)
        return advance(
            transcription,
            state,
            trial,
            judgement,
            merit=merit,
            ceiling=state.ceiling,
            radius=radius,
            stationary=predicted <= self.tolerance,
            iterations=state.iterations + judgement.accepted,
            polish=state.polish,
            near=state.near,
            reach=state.reach,
            own=judgement.accepted,
        )

    @property
    def _most_steps(self) -> int:
        """Those taken and those rejected: each divides the radius by alpha, from where a
        step taken has left it, multiplied at most once by that.
        """
        shrinking = math.log(self.initial_radius / self.min_radius, self.alpha)
        return 2 * self.max_iterations + math.ceil(shrinking) + 1

    def _weights(self, transcription: Transcription, state: SCPState) -> PerConstraint:
        """The penalty under the trapezoidal sum; an integral counts once."""
        (_, widths), (share, _) = transcription.grid, node_shares(transcription)
        residuals = state.iterate.residuals
        ones = jnp.ones_like(residuals.totals)
        return PerConstraint(
            dynamics=self.penalty * widths[:, None] * jnp.ones_like(residuals.defects),
            path=self.penalty * share[:, None] * jnp.ones_like(residuals.path),
            between=self.penalty * widths[:, None] * jnp.ones_like(residuals.between),
            integral=self.penalty * ones,
        )

    def _solve(
        self,
        transcription: Transcription,
        state: SCPState,
        model: Model,
        weights: PerConstraint,
    ) -> SubproblemSolution:
        structure = self._structure(transcription)
        prices = Prices(
            virtual_control=weights.dynamics,
            path=weights.path,
            limit=weights.between[:, : structure.limits],
            integral=weights.integral,
            radius=state.radius,
            # A tenth of what the stopping criterion sees: asked for more, PIQP does not
            # get there on the missions, and the algorithm has no answer to that.
            precision=jnp.asarray(0.1 * self.tolerance),
            relax=jnp.ones(()),
        )
        reference = state.iterate.variables
        limits = step_limits(transcription, state.scaling, reference)
        none = jax.tree.map(jnp.zeros_like, reference)
        none = Damping.of(model.residuals, none)
        return solve_subproblem(structure, self.qp, model, none, prices, limits)

    def _structure(self, transcription: Transcription) -> Structure:
        return Structure.of(transcription, relaxed=True, ball=True)
