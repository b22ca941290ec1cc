"""The linear system of a step that rests on some of its limits.

Variables at the first node, controls and the flight time are forced to their limits; the
other constraints are pulled to theirs by squares of great weight and, as those alone
leave a gap, by multipliers that grow with it: the augmented Lagrangian. The recursion of
`_riccati` solves the system in the time of a few interior-point iterations; its factors
serve for all the passes that refine the step.
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp

from ._compiler import traced_once
from ._damping import Damping
from ._max_norm import max_norm
from ._model import Model
from ._per_constraint import PerConstraint
from ._per_limit import PerLimit
from ._refinement import Refinement
from ._riccati import Factors, Forced, factorize, solve
from ._stages import Chain, Matrices, Vectors
from ._subproblem import Effort, SubproblemSolution
from ._transcription import Residuals, Variables
from ._types import Array, Float, Scalar

# Weight of the squares that pull.
_FIRM = 3e4
# Gaps below this share of the precision asked for are closed.
_CLOSED = 0.1


class Solved(eqx.Module):
    """What [`ActiveSystem`][] found.

    - `convexity`: least curvature along the dynamics; a minimum has a positive one.
    - `gap`: how far the step is from the limits that it ought to rest on: more than
        nothing where those contradict each other.
    - `left`: of the gradient that ought to vanish: much where the recursion broke down.
    """

    solution: SubproblemSolution
    convexity: Scalar
    gap: Scalar
    left: Scalar


class ActiveSystem(eqx.Module):
    """The model's first-order conditions with some constraints active.

    - `sides`: where a constraint rests: 1 on its upper limit, -1 on its lower one. In
        between, with the share a, it is soft: its multiplier is a / (1 - a) of what is
        missing.
    - `told`: 1 for variables that are forced to their limits.
    - `pull`: the squares that draw everything else.
    - `slope`: first derivatives of the cost beside the model's.
    """

    model: Model
    damping: Damping
    sides: PerLimit
    told: Variables
    pull: Damping
    slope: Variables

    @classmethod
    def of(
        cls,
        model: Model,
        damping: Damping,
        sides: PerLimit,
        targets: Variables,
        totals: Float[Array, " q"],
        slope: Variables | None = None,
    ) -> "ActiveSystem":
        """With the limits that the variables and the integrals rest on."""
        if slope is None:
            slope = jax.tree.map(jnp.zeros_like, targets)
        weight = jax.tree.map(lambda side: _FIRM * _firmness(side), sides)
        told = jax.tree.map(lambda side: jnp.floor(jnp.abs(side)), sides.variables)
        told = eqx.tree_at(lambda v: v.states, told, told.states.at[1:].set(0.0))
        pulled = jax.tree.map(lambda w, told: w * (1.0 - told), weight.variables, told)
        blank = Damping.of(model.residuals, pulled)
        pull = dataclasses.replace(
            blank,
            path=weight.path,
            between=weight.between,
            integral=weight.integral,
            centre=targets,
            target=totals,
        )
        return cls(model, damping, sides, told, pull, slope)

    @property
    def weight(self) -> PerLimit:
        """Of the squares that pull."""
        pull = self.pull
        return PerLimit(pull.step, pull.path, pull.between, pull.integral)

    @traced_once
    def solved(self, pushes: PerLimit, precision: Scalar) -> "Solved":
        """The step, and how good it is.

        **Arguments:**

        - `pushes`: what pulled may start from. `precision`: a gap that does not matter.
        """
        still = jax.tree.map(jnp.zeros_like, self.told)
        pushes = jax.tree.map(
            lambda weight, push: jnp.where(weight > 0.0, push, 0.0), self.weight, pushes
        )
        costates = jnp.zeros_like(self.model.residuals.defects)
        begun = Refinement.begun(still, costates, pushes)
        chain = self._chain
        matrices = chain.matrices(self._per_total)
        factors = factorize(matrices, self._forced(begun))
        done = jax.lax.while_loop(
            lambda at: at.unfinished(_CLOSED * precision),
            lambda at: self._refined(at, chain, matrices, factors),
            begun,
        )
        solution, left = self._solution(done)
        return Solved(solution, factors.convexity, done.gap, left)

    @property
    def _chain(self) -> Chain:
        squares = self.damping.curvature(self.model).plus(self.pull.curvature(self.model))
        free = self.told.controls.shape[0]
        curvature = self.model.curvature.plus(squares)
        return Chain(self.model.derivatives, curvature, free)

    def _left_at(self, done: Refinement, chain: Chain) -> Vectors:
        """What is left of every condition."""
        # Of what is soft the squares give back a part of the multiplier themselves.
        pushes = jax.tree.map(jnp.multiply, self._firmnesses, done.pushes)

        def total(step):
            tug = self.pull.cost(self.model, step)
            return tug + self._lagrangian(step, done.costates, pushes)

        # The recursion's totals are those of the change: what the step gains already
        # is part of the slope. Told again in every pass it would be rounded again.
        after = self.model.linear(done.step)
        still = jnp.zeros_like(after.increments)
        return chain.vectors(
            dataclasses.replace(after, increments=still),
            jax.grad(total)(done.step),
            jnp.zeros_like(self._per_total),
        )

    def _forced(self, done: Refinement) -> Forced:
        """What the recursion does not choose: which variables, and what they are."""
        told, totals = self.told, done.pushes.integral.size
        to_go = jax.tree.map(jnp.subtract, self.pull.centre, done.step)
        own = int(told.controls.shape[0] == told.states.shape[0])

        def first(values: Variables, sums: Array) -> Array:
            held = values.controls[:own].ravel()
            time = values.final_time[None]
            return jnp.concatenate([values.states[0], held, sums, time])

        return Forced(
            (first(told, jnp.ones(totals)), first(to_go, jnp.zeros(totals))),
            (told.controls[own:], to_go.controls[own:]),
        )

    @property
    def _per_total(self) -> Float[Array, " q"]:
        """Second derivatives by the integrals' totals."""
        return self.damping.integral + self.pull.integral

    def _refined(
        self, done: Refinement, chain: Chain, matrices: Matrices, factors: Factors
    ) -> Refinement:
        """One pass more: it starts from what the one before has left."""
        vectors, forced = self._left_at(done, chain), self._forced(done)
        y, decisions, costates = solve(matrices, vectors, forced, factors)
        n, q = done.step.states.shape[1], done.pushes.integral.size
        m = done.step.controls.shape[1]
        if done.step.controls.shape[0] > decisions.shape[0]:
            decisions = jnp.concatenate([y[:1, n : n + m], decisions])
        change = Variables(y[:, :n], decisions, y[0, -1])
        # A defect is the next node minus the flow: raising it lowers the node.
        more = -costates[:, :n]
        growth = self.model.derivatives.intervals.increments
        if growth.right_state is not None:
            price = self._per_total * y[-1, -1 - q : -1]
            more -= jnp.einsum("kqn,q->kn", growth.right_state[:, :q], price)
        step = jax.tree.map(jnp.add, done.step, change)
        weight, missing = self.weight, self._gap(step)
        pushes = jax.tree.map(
            lambda firm, p, w, missing: firm * p + w * missing,
            *(self._firmnesses, done.pushes, weight, missing),
        )
        gap = max_norm(jax.tree.map(_unexplained, self.sides, weight, pushes, missing))
        costates, falls = done.costates + more, gap < done.gap
        return Refinement(step, costates, pushes, gap, falls, done.count + 1)

    def _solution(self, done: Refinement) -> tuple[SubproblemSolution, Scalar]:
        """With the multipliers of what is forced, and what is left of the gradient."""
        pushes, told = done.pushes, self.told
        slope = jax.grad(self._lagrangian)(done.step, done.costates, pushes)
        # What is forced has whatever multiplier makes the gradient vanish.
        left = jax.tree.map(lambda slope, told: slope * (1.0 - told), slope, told)
        of_limits = jax.tree.map(
            lambda push, slope, told: push - slope * told, pushes.variables, slope, told
        )
        solution = SubproblemSolution(
            done.step,
            PerConstraint(done.costates, pushes.path, pushes.between, pushes.integral),
            of_limits.states,
            of_limits.controls,
            of_limits.final_time,
            Effort.of_linear_system(),
        )
        return solution, max_norm(left)

    def _gap(self, step: Variables) -> PerLimit:
        """How far each constraint is from its limit."""
        after = self.model.linear(step)
        return PerLimit(
            jax.tree.map(jnp.subtract, step, self.pull.centre),
            after.path,
            self._peaks(after),
            after.totals - self.pull.target,
        )

    def _lagrangian(
        self, step: Variables, costates: Float[Array, "I n"], pushes: PerLimit
    ) -> Scalar:
        after = self.model.predict(step)
        total = after.objective + self.damping.cost(self.model, step)
        total += jnp.vdot(costates, after.defects)
        total += jnp.vdot(pushes.path, after.path)
        total += jnp.vdot(pushes.between, self._peaks(after))
        total += jnp.vdot(pushes.integral, after.totals)
        beside = jax.tree.map(jnp.vdot, self.slope, step)
        total += sum(jax.tree.leaves(beside))
        of_limits = jax.tree.map(jnp.vdot, pushes.variables, step)
        return total + sum(jax.tree.leaves(of_limits))

    def _peaks(self, after: Residuals) -> Array:
        # Peaks of what has no limit are infinitely low.
        return jnp.where(self.sides.between > 0.0, after.between, 0.0)

    @property
    def _firmnesses(self) -> PerLimit:
        return jax.tree.map(_firmness, self.sides)


def _firmness(side: Array) -> Array:
    """Share of a push that stays: 1 where a constraint holds, 0 where there is none."""
    share = jnp.abs(side)
    return share / (share + _FIRM * (1.0 - share))


def _unexplained(side: Array, weight: Array, push: Array, missing: Array) -> Array:
    """What is missing beside that which softness allows."""
    share = jnp.abs(side)
    allowed = push * (1.0 - share) / jnp.where(share > 0.0, share, 1.0)
    return jnp.where(weight > 0.0, missing - allowed, 0.0)
