"""A subproblem near its solution: which constraints are active is nearly known.

With the active ones as equalities a subproblem is a linear system (`_active_system`).
Whether the guess was right shows in the solution: multipliers keep their signs and no
other constraint is broken. Where it was wrong it is mended and tried again: the
primal-dual active set method. Hintermueller, Ito, Kunisch, SIAM Journal on Optimization
13 (2002).
"""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp

from ._active_system import ActiveSystem, PerLimit
from ._damping import Damping
from ._model import Model
from ._subproblem import SubproblemSolution
from ._subproblem_data import Limits
from ._transcription import Variables
from ._types import Array, Scalar

_ATTEMPTS = 6


def active_set_step(
    model: Model,
    damping: Damping,
    limits: Limits,
    last: SubproblemSolution,
    precision: Scalar,
) -> SubproblemSolution:
    """The step of a subproblem, from the active constraints of the one before.

    **Arguments:**

    - `precision`: violations and multipliers of the wrong sign that do not matter: which
        of several limits that say nearly the same are active is then left open.

    **Returns:** with `solved` false in its effort where no set of active constraints was
    found, or where the damped model is not convex along them.
    """

    def sides(solution: SubproblemSolution, step: Variables) -> PerLimit:
        multipliers = PerLimit.multipliers(solution)
        below, above = _rooms(model, limits, step)
        side = functools.partial(_side, precision=precision)
        return jax.tree.map(side, multipliers, below, above)

    def wrong(attempt):
        _, solution, count = attempt
        return ~solution.effort.solved & (count < _ATTEMPTS)

    def again(attempt):
        tried, _, count = attempt
        system = _with_active(model, damping, limits, tried)
        solution, convex, gap = system.solved(PerLimit.multipliers(last), precision)
        found = sides(solution, solution.step)
        same = jax.tree.map(lambda a, b: jnp.all(a == b), found, tried)
        right = convex & (gap <= precision) & jnp.all(jnp.stack(jax.tree.leaves(same)))
        solution = eqx.tree_at(lambda s: s.effort.solved, solution, right)
        # Where it is not convex, further attempts are as hopeless.
        return found, solution, jnp.where(convex, count + 1, _ATTEMPTS)

    still = jax.tree.map(jnp.zeros_like, last.step)
    nothing = eqx.tree_at(lambda s: s.effort.solved, last, jnp.array(False))
    begun = (sides(last, still), nothing, jnp.zeros((), int))
    return jax.lax.while_loop(wrong, again, begun)[1]


def _side(multiplier: Array, below: Array, above: Array, precision: Scalar) -> Array:
    """The limit a constraint rests on: 1 the upper, -1 the lower, 0 neither."""
    upper = multiplier - above > precision
    lower = -multiplier - below > precision
    # Between limits that coincide it rests on both.
    fixed = below + above <= 0.0
    return jnp.where(upper | fixed, 1.0, jnp.where(lower, -1.0, 0.0))


def _rooms(model: Model, limits: Limits, step: Variables) -> tuple[PerLimit, PerLimit]:
    """The way to every lower and to every upper limit."""
    after = model.linear(step)
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
    model: Model, damping: Damping, limits: Limits, sides: PerLimit
) -> ActiveSystem:
    """The conditions of a step with these constraints active."""
    targets = jax.tree.map(_resting, sides.variables, *_ends(limits))
    totals = _resting(sides.integral, *limits.integral)
    return ActiveSystem.of(model, damping, sides, targets, totals)
