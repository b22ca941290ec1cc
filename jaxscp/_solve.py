"""`solve`: from a problem and a guess to a solution."""

import time
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ._discretization import Discretization
from ._free_intervals import lifted, lowered
from ._outcome import outcome
from ._problem import OptimalControlProblem
from ._proximal import ProximalSCP
from ._scp import AbstractSCP, run
from ._solution import Solution
from ._trajectory import Trajectory, straight_line
from ._transcription import Transcription
from ._types import ArrayLike, is_concrete
from ._validation import check_guess, check_precision, check_problem


class SolveError(RuntimeError):
    """A solve that did not converge; `solution` holds its last iterate."""

    def __init__(self, solution: Solution):
        super().__init__(solution.message)
        self.solution = solution


def solve(
    problem: OptimalControlProblem,
    guess: Trajectory | None = None,
    method: AbstractSCP = ProximalSCP(),  # noqa: B008  (immutable)
    *,
    nodes: int | ArrayLike = 50,
    discretization: Discretization = Discretization(),  # noqa: B008  (immutable)
    progress: Callable[[dict], None] | None = None,
    throw: bool = True,
) -> Solution:
    """Solve an optimal control problem by sequential convex programming.

    Works under `jax.jit` and `jax.vmap`; a batch is solved one element after another.
    New numbers in the problem or the guess compile nothing, other functions, other
    numbers of nodes and other settings do.

    **Main arguments:**

    - `problem`: what to solve.
    - `guess`: where to start, with the time grid to use; a straight line by default.
    - `method`: [`ProximalSCP`][], or the paper's [`PaperSCP`][].
    - `nodes`: number of nodes, or their fractions of the flight time; only without a
        guess, which has its own.

    **Other arguments:**

    - `discretization`: hold, quadrature, free intervals and integration tolerance.
    - `progress`: called after every iteration with a dictionary of its numbers: the
        fields of [`History`][] and `iteration`. Pass the same function each time: a new
        one compiles anew.
    - `throw`: raise if the solve does not converge. With `throw=False` the solution
        says so in its status and holds the last iterate.

    **Raises:** `RuntimeError` if JAX is not in 64-bit mode, `ValueError` for a problem
    or guess that makes no sense, [`SolveError`][] without convergence; inside `jax.jit`
    that is Equinox's runtime error with the status' sentence.
    """
    begun = time.perf_counter()
    check_precision()
    problem = jax.tree.map(_as_parameter, problem)
    check_problem(problem)
    if guess is None:
        guess = straight_line(problem, nodes)
    check_guess(problem, guess)
    transcription = Transcription(problem, discretization, guess.fractions)
    if discretization.interval_ratio is None:
        solution = _run(method, transcription, guess, progress)
    else:
        paced = lifted(transcription, guess)
        solution = lowered(_run(method, *paced, progress), problem)
    if is_concrete(solution.objective):
        jax.block_until_ready(solution.objective)
        elapsed = jnp.asarray(time.perf_counter() - begun)
        solution = eqx.tree_at(lambda s: s.statistics.seconds, solution, elapsed)
        if throw and not bool(solution.converged):
            raise SolveError(solution)
        return solution
    if throw:
        return solution.status.error_if(solution, ~solution.converged)
    return solution


def _as_parameter(leaf: Any) -> Any:
    """NumPy arrays are parameters too."""
    return jnp.asarray(leaf) if isinstance(leaf, (np.ndarray, np.generic)) else leaf


@eqx.filter_jit
def _run(
    method: AbstractSCP,
    transcription: Transcription,
    guess: Trajectory,
    progress: Callable[[dict], None] | None,
) -> Solution:
    arrays, rest = eqx.partition((transcription, guess), eqx.is_array)

    # A batch shares nothing but its pattern: one after another, each element iterates
    # as often as it needs and none waits for, or spoils, another.
    @jax.custom_batching.sequential_vmap
    def one(arrays):
        transcription, guess = eqx.combine(arrays, rest)
        return run(method, transcription, transcription.variables(guess), progress)

    return outcome(transcription, *one(arrays))
