"""A subproblem near its solution: which constraints are active is nearly known.

With the active ones as equalities a subproblem is a linear system (`_active_system`).
Whether the guess was right shows in the solution: multipliers keep their signs and no
other constraint is broken. Where it was wrong it is mended (`_pivoting`) and tried again:
the primal-dual active set method. Hintermueller, Ito, Kunisch, SIAM Journal on
Optimization 13 (2002).
"""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp

from ._active_system import ActiveSystem
from ._damping import Damping
from ._model import Model
from ._peaks import Watch
from ._per_limit import PerLimit
from ._pivoting import pivoted
from ._subproblem import SubproblemSolution
from ._subproblem_data import Limits
from ._transcription import Residuals, Variables
from ._tree import tree_where
from ._types import Array, Scalar

# Active sets tried in all, and with one weight of the metric.
_ATTEMPTS = 24
_TRIES = 10
# The next weight where one was too light, and how close to such a one the best may be, if
# its step is not long enough: the share of the length allowed that is.
_HEAVIER = 4.0
_CLOSE = 1.6
_ENOUGH = 0.7
# A gradient this large that ought to vanish: the recursion broke down.
_SOUND = 1e-9
# Of the length allowed.
_OVERLONG = 1.2


class NewtonStep(eqx.Module):
    """What `active_set_step` found, if its solution says that it is solved, or what it
    starts from.

    - `weight`: of the metric, at least that asked for. `length`: of the step.
    """

    solution: SubproblemSolution
    weight: Scalar
    length: Scalar

    @classmethod
    def none(cls, like: SubproblemSolution, weight: Scalar) -> "NewtonStep":
        """Not found."""
        unsolved = jnp.zeros_like(like.effort.solved)
        nothing = eqx.tree_at(lambda s: s.effort.solved, like, unsolved)
        return cls(nothing, weight, jnp.zeros(()))

    @classmethod
    def begun(cls, last: SubproblemSolution, weight: Scalar) -> "NewtonStep":
        """Where the search for a step starts: the multipliers of the one before."""
        still = jax.tree.map(jnp.zeros_like, last.step)
        solved = jnp.ones_like(last.effort.solved)
        start = eqx.tree_at(lambda s: (s.step, s.effort.solved), last, (still, solved))
        return cls(start, weight, jnp.zeros(()))

    @property
    def found(self) -> Array:
        return self.solution.effort.solved


class _Attempt(eqx.Module):
    """How far the search for a weight and for the active constraints has come.

    - `sides`: where each constraint rests. `too_light`: the largest weight refused.
    - `count`: of all attempts. `tries`: of those at this weight.
    """

    sides: PerLimit
    weight: Scalar
    too_light: Scalar
    best: NewtonStep
    count: Array
    tries: Array


def active_set_step(
    model: Model,
    metric: Damping,
    limits: Limits,
    watch: Watch,
    start: NewtonStep,
    precision: Scalar,
    *,
    longest: Scalar,
    heaviest: Scalar,
    slack: float,
) -> NewtonStep:
    """The step of a subproblem, from the active constraints of the one before.

    **Arguments:**

    - `metric`: of the trust region. `watch`: what is enforced between the nodes.
    - `start`: a step near the one sought, with its multipliers, and the weight of the
        metric: heavier ones are tried where the model is not convex along the active
        constraints, or where the step is longer than `longest`.
    - `precision`: violations and multipliers of the wrong sign that do not matter: which
        of several limits that say nearly the same are active is then left open.
    - `heaviest`: weight that is worth trying where the model is not convex along the
        active constraints, or where these are not found: for short enough steps they are
        those of the one before.
    - `slack`: gap that may remain: limits that say nearly the same, as those at and next
        to a node, contradict each other a little.
    """
    last = start.solution
    there = model.linear(last.step)
    first = active_sides(there, limits, last, last.step, precision)

    def unfinished(at: _Attempt) -> Array:
        rough = (at.too_light > 0.0) & (at.best.weight > _CLOSE * at.too_light)
        rough &= at.best.length < _ENOUGH * longest
        return (at.count < _ATTEMPTS) & (~at.best.found | rough)

    def again(at: _Attempt) -> _Attempt:
        system = _with_active(model, metric.times(at.weight), limits, at.sides)
        found = system.solved(PerLimit.multipliers(last), precision)
        solution, sound = found.solution, found.left <= jnp.maximum(_SOUND, precision)
        convex = (found.convexity > 0.0) & sound
        length = metric.length(solution.step)
        light = ~convex | (length > _OVERLONG * longest)
        after = model.linear(solution.step)
        wanted = active_sides(
            after, limits, solution, solution.step, precision, held=at.sides
        )
        same = jax.tree.map(lambda a, b: jnp.all(a == b), wanted, at.sides)
        same = jnp.all(jnp.stack(jax.tree.leaves(same)))
        wrongs = _wrongs(at.sides, wanted, after, limits, solution)
        sides = pivoted(at.sides, wanted, wrongs, watch)
        right = ~light & (found.gap <= jnp.maximum(precision, slack)) & same
        solution = eqx.tree_at(lambda s: s.effort.solved, solution, right)
        this = NewtonStep(solution, at.weight, length)
        lost = ~light & ~right & (at.tries + 1 >= _TRIES)
        vain = (lost | (~convex & ~at.best.found)) & (_HEAVIER * at.weight > heaviest)
        light |= lost & ~vain
        best = tree_where(right, this, at.best)
        too_light = jnp.where(light, at.weight, at.too_light)
        between = jnp.sqrt(too_light * best.weight)
        weight = jnp.where(best.found, between, _HEAVIER * at.weight)
        another = light | right
        return _Attempt(
            tree_where(light, first, sides),
            jnp.where(another, weight, at.weight),
            too_light,
            best,
            jnp.where(vain, _ATTEMPTS, at.count + 1),
            jnp.where(another, 0, at.tries + 1),
        )

    none = jnp.zeros((), int)
    nothing = NewtonStep.none(last, start.weight)
    begun = _Attempt(first, start.weight, jnp.zeros(()), nothing, none, none)
    return jax.lax.while_loop(unfinished, again, begun).best


def active_sides(
    after: Residuals,
    limits: Limits,
    solution: SubproblemSolution,
    step: Variables,
    precision: Scalar | float,
    held: PerLimit | None = None,
) -> PerLimit:
    """Where each constraint rests after a step, as its multipliers tell.

    **Arguments:**

    - `held`: where each was made to rest. What is not worth a change stays there: along
        directions that the cost hardly sees, a limit whose multiplier is next to nothing
        may be missed by far without it.
    """
    multipliers = PerLimit.multipliers(solution)
    if held is None:
        held = jax.tree.map(jnp.zeros_like, multipliers)
    side = functools.partial(_side, precision=precision)
    return jax.tree.map(side, multipliers, *rooms(after, limits, step), held)


def _side(
    multiplier: Array, below: Array, above: Array, held: Array, precision: Scalar | float
) -> Array:
    """The limit a constraint rests on: 1 the upper, -1 the lower, 0 neither."""
    upper = multiplier - above > jnp.where(held > 0.0, -precision, precision)
    lower = -multiplier - below > jnp.where(held < 0.0, -precision, precision)
    # Between limits that coincide, but for rounding, it rests on both.
    fixed = below + above <= precision
    return jnp.where(upper | fixed, 1.0, jnp.where(lower, -1.0, 0.0))


def _wrongs(
    sides: PerLimit,
    wanted: PerLimit,
    after: Residuals,
    limits: Limits,
    solution: SubproblemSolution,
) -> PerLimit:
    """How far each constraint is in the wrong after a step: what is violated and ought to
    be active, less what is active and pushes the wrong way.
    """

    def wrong(side, wanted, multiplier, below, above):
        broken = jnp.where(wanted > 0.0, -above, -below)
        changed = jnp.where(wanted == 0.0, -jnp.abs(multiplier), broken)
        return jnp.where(side == wanted, 0.0, changed)

    multipliers = PerLimit.multipliers(solution)
    ways = rooms(after, limits, solution.step)
    return jax.tree.map(wrong, sides, wanted, multipliers, *ways)


def rooms(after: Residuals, limits: Limits, step: Variables) -> tuple[PerLimit, PerLimit]:
    """The way to every lower and to every upper limit."""
    low, high = limits.ends
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


def resting(side: Array, low: Array, high: Array) -> Array:
    """The limit a variable rests on; zero where it rests on none."""
    return jnp.where(side > 0.0, high, jnp.where(side < 0.0, low, 0.0))


def _with_active(
    model: Model, damping: Damping, limits: Limits, sides: PerLimit
) -> ActiveSystem:
    """The conditions of a step with these constraints active."""
    targets = jax.tree.map(resting, sides.variables, *limits.ends)
    totals = resting(sides.integral, *limits.integral)
    return ActiveSystem.of(model, damping, sides, targets, totals)
