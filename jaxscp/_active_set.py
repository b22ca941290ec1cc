"""A subproblem near its solution: which constraints are active is nearly known.

With the active ones as equalities a subproblem is a linear system, which the recursion of
`_riccati` solves in the time of a few interior-point iterations. Whether the guess was
right shows in the solution: multipliers keep their signs and no other constraint is
broken. Where it was wrong it is mended and tried again: the primal-dual active set
method. Hintermueller, Ito, Kunisch, SIAM Journal on Optimization 13 (2002).
"""

import equinox as eqx
import jax
import jax.numpy as jnp

from ._damping import Damping
from ._model import Model, linear_prediction
from ._per_constraint import PerConstraint
from ._riccati import Factors, Forced, arranged, factorize, solve
from ._subproblem import Effort, SubproblemSolution
from ._subproblem_data import Limits
from ._transcription import Residuals, Variables, held
from ._types import Array, Float

# Weight of the squares that pull states and constraints to their limits, and how often
# what they lack is added: each time leaves about a thousandth of the gap.
_FIRM = 1e4
_PASSES = 3
_ATTEMPTS = 4
# Violations and wrong signs below it are rounding errors.
_TIGHT = 1e-11
# A gradient this large that ought to vanish means that the recursion broke down.
_SOUND = 1e-9


class PerLimit(eqx.Module):
    """One number for each limit of the step and each inequality.

    As multipliers: upper ones positive, lower ones negative.
    """

    variables: Variables
    path: Float[Array, "N p"]
    between: Float[Array, "I b"]
    integral: Float[Array, " q"]

    @classmethod
    def multipliers(cls, solution: SubproblemSolution) -> "PerLimit":
        own = solution.multipliers
        return cls(
            Variables(solution.state, solution.control, solution.final_time),
            own.path,
            own.between,
            own.integral,
        )


def active_set_step(
    model: Model,
    damping: Damping,
    limits: Limits,
    last: SubproblemSolution,
) -> SubproblemSolution:
    """The step of a subproblem, from the active constraints of the one before.

    **Returns:** with `solved` false in its effort where no set of active constraints was
    found, or where the damped model is not convex along them.
    """

    def sides(solution: SubproblemSolution, step: Variables) -> PerLimit:
        multipliers = PerLimit.multipliers(solution)
        return jax.tree.map(_side, multipliers, *_rooms(model, limits, step))

    def wrong(attempt):
        _, solution, count = attempt
        return ~solution.effort.solved & (count < _ATTEMPTS)

    def again(attempt):
        tried, _, count = attempt
        solution, sound = _with_active(model, damping, limits, tried, last)
        found = sides(solution, solution.step)
        same = jax.tree.map(lambda a, b: jnp.all(a == b), found, tried)
        right = sound & jnp.all(jnp.stack(jax.tree.leaves(same)))
        solution = eqx.tree_at(lambda s: s.effort.solved, solution, right)
        # Where it is not convex, further attempts are as hopeless.
        return found, solution, jnp.where(sound, count + 1, _ATTEMPTS)

    still = jax.tree.map(jnp.zeros_like, last.step)
    nothing = eqx.tree_at(lambda s: s.effort.solved, last, jnp.array(False))
    begun = (sides(last, still), nothing, jnp.zeros((), int))
    return jax.lax.while_loop(wrong, again, begun)[1]


def _side(multiplier: Array, below: Array, above: Array) -> Array:
    """The limit a constraint rests on: 1 the upper, -1 the lower, 0 neither."""
    upper = multiplier - above > _TIGHT
    lower = -multiplier - below > _TIGHT
    # Between limits that coincide it rests on both.
    fixed = below + above <= 0.0
    return jnp.where(upper | fixed, 1.0, jnp.where(lower, -1.0, 0.0))


def _rooms(model: Model, limits: Limits, step: Variables) -> tuple[PerLimit, PerLimit]:
    """The way to every lower and to every upper limit."""
    after = _after(model, step)
    low, high = _ends(limits)
    lowest, highest = limits.integral
    return (
        PerLimit(
            jax.tree.map(jnp.subtract, step, low),
            jnp.full_like(after.path, jnp.inf),
            jnp.full_like(after.between, jnp.inf),
            after.totals - lowest,
        ),
        PerLimit(
            jax.tree.map(jnp.subtract, high, step),
            -after.path,
            -after.between,
            highest - after.totals,
        ),
    )


def _after(model: Model, step: Variables) -> Residuals:
    controls = held(step.controls, step.states.shape[0])
    return linear_prediction(model.residuals, model.derivatives, step, controls)


def _ends(limits: Limits) -> tuple[Variables, Variables]:
    """The lower and the upper limits of the step."""
    low, high = (
        Variables(limits.state[side], limits.control[side], limits.time[side][0])
        for side in (0, 1)
    )
    return low, high


def _resting(side: Array, low: Array, high: Array) -> Array:
    """The limit a variable rests on; zero where it rests on none."""
    return jnp.where(side > 0.0, high, jnp.where(side < 0.0, low, 0.0))


def _with_active(
    model: Model,
    damping: Damping,
    limits: Limits,
    sides: PerLimit,
    last: SubproblemSolution,
) -> tuple[SubproblemSolution, Array]:
    """The step with these constraints active, and whether it is a sound minimum.

    Variables at the first node, controls and the flight time are forced to their limits;
    the other constraints are pulled to theirs by squares of great weight and, as those
    alone leave a gap, by multipliers: those of the step before, which grow with the gap.
    Each pass starts from what the one before has left of every condition.
    """
    targets = jax.tree.map(_resting, sides.variables, *_ends(limits))
    totals = _resting(sides.integral, *limits.integral)
    weight = jax.tree.map(lambda side: _FIRM * jnp.abs(side), sides)
    told = jax.tree.map(jnp.abs, sides.variables)
    told = eqx.tree_at(lambda v: v.states, told, told.states.at[1:].set(0.0))
    step = jax.tree.map(jnp.zeros_like, targets)
    weight = eqx.tree_at(
        lambda w: w.variables,
        weight,
        eqx.tree_at(lambda v: v.states, step, weight.variables.states.at[0].set(0.0)),
    )
    pull = Damping(
        weight.variables, weight.path, weight.between, weight.integral, targets, totals
    )
    squares = damping.curvature(model).plus(pull.curvature(model))
    second, first = (
        a + b for a, b in zip(damping.of_totals, pull.of_totals, strict=True)
    )
    costates = jnp.zeros_like(last.multipliers.dynamics)
    # What pulls, pulls as hard as last time.
    pushes = jax.tree.map(
        lambda weight, push: jnp.where(weight > 0.0, push, 0.0),
        weight,
        PerLimit.multipliers(last),
    )
    lagrangian = _Lagrangian(model, damping, sides)
    factors: Factors | None = None
    for _ in range(_PASSES):
        slope = jax.grad(lagrangian.of_variables)(step, costates, pushes)
        tug = jax.grad(lambda step: pull.value(model, step))(step)
        program = arranged(
            _after(model, step),
            model.derivatives,
            model.curvature.plus(squares),
            jax.tree.map(jnp.add, slope, tug),
            (second, first + pushes.integral),
        )
        to_go = jax.tree.map(jnp.subtract, targets, step)
        forced = _forced(told, to_go, totals.size)
        factors = factorize(program, forced) if factors is None else factors
        change, more = _stepped(solve(program, forced, factors), step)
        step = jax.tree.map(jnp.add, step, change)
        costates += more
        gap = lagrangian.gap(step, targets, totals)
        pushes = jax.tree.map(lambda p, w, g: p + w * g, pushes, weight, gap)
    assert factors is not None
    slope = jax.grad(lagrangian.whole)(step, costates, pushes)
    # What is forced has whatever multiplier makes the gradient vanish.
    left = jax.tree.map(lambda slope, told: slope * (1.0 - told), slope, told)
    of_limits = jax.tree.map(
        lambda push, slope, told: push - slope * told, pushes.variables, slope, told
    )
    worst = jnp.max(jnp.stack([jnp.max(jnp.abs(x)) for x in jax.tree.leaves(left)]))
    solution = SubproblemSolution(
        step,
        PerConstraint(costates, pushes.path, pushes.between, pushes.integral),
        of_limits.states,
        of_limits.controls,
        of_limits.final_time,
        Effort.of_linear_system(),
    )
    return solution, (factors.convexity > 0.0) & (worst <= _SOUND)


class _Lagrangian(eqx.Module):
    """Of the damped model with some constraints active."""

    model: Model
    damping: Damping
    sides: PerLimit

    def of_variables(
        self, step: Variables, costates: Float[Array, "I n"], pushes: PerLimit
    ) -> Array:
        """Without what the totals of the integrals add."""
        after = self.model.predict(step)
        total = after.objective + self.damping.value(self.model, step)
        total += jnp.vdot(costates, after.defects)
        total += jnp.vdot(pushes.path, after.path)
        total += jnp.vdot(pushes.between, self._peaks(after))
        return total + jnp.vdot(pushes.variables.states, step.states)

    def whole(
        self, step: Variables, costates: Float[Array, "I n"], pushes: PerLimit
    ) -> Array:
        totals, damping = _after(self.model, step).totals, self.damping
        squares = damping.integral * (totals - damping.target) ** 2
        of_totals = 0.5 * jnp.sum(squares) + jnp.vdot(pushes.integral, totals)
        return self.of_variables(step, costates, pushes) + of_totals

    def gap(
        self, step: Variables, targets: Variables, totals: Float[Array, " q"]
    ) -> PerLimit:
        """How far each constraint is from its limit."""
        after = _after(self.model, step)
        return PerLimit(
            jax.tree.map(jnp.subtract, step, targets),
            after.path,
            self._peaks(after),
            after.totals - totals,
        )

    def _peaks(self, after: Residuals) -> Array:
        # Peaks of what has no limit are infinitely low.
        return jnp.where(self.sides.between > 0.0, after.between, 0.0)


def _forced(told: Variables, to_go: Variables, totals: int) -> Forced:
    """What the recursion does not choose: which variables, and what they are."""
    own = int(told.controls.shape[0] == told.states.shape[0])

    def first(values: Variables, sums: Array) -> Array:
        held = values.controls[:own].ravel()
        return jnp.concatenate([values.states[0], held, sums, values.final_time[None]])

    return Forced(
        (first(told, jnp.ones(totals)), first(to_go, jnp.zeros(totals))),
        (told.controls[own:], to_go.controls[own:]),
    )


def _stepped(
    solved: tuple[Array, Array, Array], like: Variables
) -> tuple[Variables, Float[Array, "I n"]]:
    """The step, and the multipliers of the dynamics."""
    y, decisions, costates = solved
    n, m = like.states.shape[1], like.controls.shape[1]
    if like.controls.shape[0] > decisions.shape[0]:
        decisions = jnp.concatenate([y[:1, n : n + m], decisions])
    # A defect is the next node minus the flow: raising it lowers the node.
    return Variables(y[:, :n], decisions, y[0, -1]), -costates[:, :n]
