"""Which of several solves is the best, and whether one holds what was asked of it."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Int

from ._attempt import Attempt
from ._problem import OptimalControlProblem
from ._solution import Solution
from ._trajectory import Trajectory
from ._tree import constant
from ._types import Array
from ._verification import Verification
from .verify import HOLDS, verify


def checked(
    problem: OptimalControlProblem,
    flight: Solution | Trajectory,
    between: bool,
    hold: Any = None,
) -> Verification:
    """Verified where limits hold, between the nodes to a hundred-thousandth:
    millimetres.
    """
    tolerance = 1e-5 if between else 1e-4
    return verify(problem, flight, between=between, tolerance=tolerance, hold=hold)


def best(solutions: Sequence[Solution]) -> Solution:
    """The cheapest of those that converge and verify, with all attempts beside it.

    If none verifies, the cheapest that converges; if none does, the one that misses its
    constraints least. What costs more than the one chosen is not verified.
    """
    attempts = [solution.attempts[0] for solution in solutions]
    numbers = constant(list(solutions))
    order = [int(index) for index in _order(_stacked(attempts))]
    verified: dict[int, bool] = {}
    for index in order:
        if not bool(attempts[index].converged) or not _can_verify(solutions[index]):
            break
        solution = numbers[index]
        between = solution.discretization.between > 0
        verified[index] = checked(solution.problem, solution, between).verified
        if verified[index]:
            break
    chosen = next((index for index in order if verified.get(index)), order[0])
    judged = tuple(
        dataclasses.replace(
            attempt, verified=verified.get(index), chosen=jnp.asarray(index == chosen)
        )
        for index, attempt in enumerate(attempts)
    )
    return dataclasses.replace(solutions[chosen], attempts=judged)


def best_unverified(solutions: Solution) -> Solution:
    """The same of traced solutions, stacked, which nothing can verify."""
    (attempts,) = solutions.attempts
    count = attempts.objective.size
    chosen = _order(attempts)[0]
    attempts = eqx.tree_at(lambda a: a.chosen, attempts, jnp.arange(count) == chosen)

    def row(tree, index):
        return jax.tree.map(lambda leaf: leaf[index], tree)

    every = tuple(row(attempts, index) for index in range(count))
    return dataclasses.replace(row(solutions, chosen), attempts=every)


@jax.jit
def _order(attempts: Attempt) -> Int[Array, " k"]:
    """Those that converge by what they cost, then the others by what they miss."""
    converged = attempts.converged
    score = jnp.where(converged, attempts.objective, attempts.violation)
    # NaN comes last.
    return jnp.lexsort((score, ~converged))


def _stacked(attempts: list[Attempt]) -> Attempt:
    return jax.tree.map(lambda *rows: jnp.stack(rows), *attempts)


def _can_verify(solution: Solution) -> bool:
    """Holds of one's own are unknown to `verify`."""
    return type(solution.discretization.hold).__name__ in HOLDS
