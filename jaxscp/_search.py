"""The step of one iteration: a subproblem's, or a second-order correction of it."""

import dataclasses
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp

from ._active_set import NewtonStep
from ._constraints import integral_limits, worst_violation
from ._iteration import judge, try_step
from ._merit import AbstractMerit
from ._model import Model
from ._state import Judgement, SCPState, Trial
from ._subproblem import SubproblemSolution
from ._transcription import Residuals, Transcription
from ._tree import tree_where
from ._types import Array


class Search(eqx.Module):
    """Passes for a step, one after the other.

    - `around`: the residuals the next subproblem is built on.
    - `merit`: which judges the step.
    - `expected`: residuals the model predicts for the uncorrected step.
    - `best`: the best trial so far. `newton`: of the first pass, once that is done.
    - `improved`: whether the last pass is the best.
    """

    passes: Array
    improved: Array
    around: Residuals
    merit: AbstractMerit
    expected: Residuals
    best: Trial
    newton: NewtonStep


def search(
    transcription: Transcription,
    state: SCPState,
    solve: Callable[
        [Residuals, NewtonStep], tuple[SubproblemSolution, Model, NewtonStep]
    ],
    newton: NewtonStep,
    *,
    accept_ratio: float,
    correction_ratio: Array,
    feasibility: Array,
    corrections: Array,
) -> tuple[Search, Judgement]:
    """The subproblem's step or, if that is poor, its second-order correction.

    The correction solves the same subproblem with what the linearization missed at the
    first trial added to every constraint: c(z + d) - J d instead of c(z). Fletcher,
    "Practical Methods of Optimization", Section 14.4. All passes are one loop, so that
    a subproblem is compiled once.

    **Arguments:**

    - `solve`: the subproblem around some residuals, the model it took with those of the
        reference, and Newton's step, from another one. `newton`: where that starts; the
        correction's starts from the step that it corrects.
    - `accept_ratio`: as in the ratio test. `correction_ratio`: below it a step is poor.
    - `feasibility`: a step that violates a constraint by more is poor, too.
    - `corrections`: how often a step may be corrected, each time by what was missed
        since, as long as that makes it better.
    """
    limits = integral_limits(transcription, state.scaling)
    here = state.iterate.residuals

    def judged(found: Search) -> Judgement:
        reference = found.merit.cost(here, limits)
        expected = found.merit.cost(found.expected, limits)
        return judge(reference, reference - expected, found.best, accept_ratio)

    def again(found: Search) -> Array:
        solved = found.best.solution.effort.solved
        poor = judged(found).ratio < correction_ratio
        poor |= worst_violation(found.best.residuals, limits) > feasibility
        left = (found.passes <= corrections) & found.improved
        return (found.passes == 0) | (left & solved & poor)

    def attempt(found: Search) -> Search:
        first, best = found.passes == 0, found.best
        solution, model, newton = solve(found.around, found.newton)
        solution = _or_stay(solution, state.solution)
        following = state.merit.following(solution.multipliers, state.ceiling)
        merit = tree_where(first, following, found.merit)
        predicted = model.predict(solution.step)
        expected = tree_where(first, predicted, found.expected)
        trial = try_step(transcription, state.scaling, state.iterate, solution, merit)
        better = first | (solution.effort.solved & (trial.cost < best.cost))
        chosen = dataclasses.replace(
            tree_where(better, trial, best),
            solution=_combined(first, better, solution, best.solution),
        )
        around = _corrected(found.around, trial.residuals, predicted)
        newton = tree_where(first, newton, found.newton)
        passes = found.passes + 1
        return Search(passes, better, around, merit, expected, chosen, newton)

    zero = jnp.zeros(())
    nowhere = Trial(state.solution, state.iterate.variables, here, zero + jnp.inf, zero)
    passes = jnp.zeros((), int)
    improved = jnp.array(True)
    found = Search(passes, improved, here, state.merit, here, nowhere, newton)
    found = jax.lax.while_loop(again, attempt, found)
    return found, judged(found)


def _or_stay(
    solution: SubproblemSolution, earlier: SubproblemSolution
) -> SubproblemSolution:
    """An unsolved subproblem says nothing: no step, and the multipliers before."""
    still = jax.tree.map(jnp.zeros_like, earlier.step)
    stay = dataclasses.replace(earlier, step=still, effort=solution.effort)
    return tree_where(solution.effort.solved, solution, stay)


def _combined(
    first: Array, better: Array, latest: SubproblemSolution, before: SubproblemSolution
) -> SubproblemSolution:
    """The better step with its own multipliers; efforts add up."""
    kept = tree_where(better, latest, before)
    total = latest.effort.after(before.effort)
    effort = tree_where(first, latest.effort, total)
    return dataclasses.replace(
        kept,
        effort=dataclasses.replace(effort, solved=kept.effort.solved),
    )


def _corrected(around: Residuals, seen: Residuals, expected: Residuals) -> Residuals:
    """What a subproblem was built on, plus what its linearization missed at a trial."""
    missed = seen.increments - expected.increments
    # Where there is no limit, its peak is infinitely low.
    limited = jnp.isfinite(around.between)
    between = jnp.where(limited, seen.between - expected.between, 0.0)
    return Residuals(
        objective=around.objective,
        defects=around.defects + seen.defects - expected.defects,
        path=around.path + seen.path - expected.path,
        between=around.between + between,
        # But for the cost, whose curvature the model has already.
        increments=around.increments + missed.at[:, -1].set(0.0),
    )
