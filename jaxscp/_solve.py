"""`solve`: from a problem and guesses to a solution."""

import time
from collections.abc import Callable, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp

from ._captured import check_captured
from ._choice import best, best_unverified
from ._compiler import compiled
from ._discretization import Discretization
from ._free_intervals import lifted, lowered
from ._outcome import differentiable, outcome
from ._problem import OptimalControlProblem
from ._progress import listener
from ._proximal import ProximalSCP
from ._scp import AbstractSCP, run
from ._smoothing import check_smoothing
from ._solution import Solution, check_polished
from ._trajectory import Trajectory, straight_line
from ._transcription import Transcription
from ._tree import as_array, as_floats, as_parameters, constant, is_differentiated
from ._types import Array, ArrayLike, Scalar, check_kind, is_concrete
from ._validation import check_guesses, check_precision, check_problem


class SolveError(RuntimeError):
    """A solve that did not converge; `solution` holds its last iterate."""

    def __init__(self, solution: Solution):
        super().__init__(solution.message)
        self.solution = solution


def solve(
    problem: OptimalControlProblem,
    guess: Trajectory | Solution | Sequence[Trajectory] | None = None,
    method: AbstractSCP = ProximalSCP(),  # noqa: B008  (immutable)
    *,
    nodes: int | ArrayLike = 50,
    discretization: Discretization = Discretization(),  # noqa: B008  (immutable)
    smoothing: float | Array = 0.0,
    progress: Callable[[dict], None] | None = None,
    throw: bool = True,
) -> Solution:
    """Solve an optimal control problem by sequential convex programming.

    Works under `jax.jit` and `jax.vmap`; a batch is solved one element after another.
    New numbers in the problem or the guess compile nothing, other functions, other
    numbers of nodes and other settings do.

    Can be differentiated, forward and backward, by every inexact leaf of the problem and
    by the time grid: the objective by the envelope theorem, twice if asked; trajectory,
    integrals and multipliers by the implicit function theorem at the solution, with the
    exact Hessian of the Lagrangian. Neither unrolls the iteration. A solution depends on
    its guess only in which of several it is, and on the scales of `Bounds` only as far
    as tolerances allow, which are relative to them: by neither has it a derivative.
    Where a constraint is weakly active, its multiplier and its slack both zero, there are
    two one-sided derivatives, and one of them is returned: [`sensitivity_report`][] has
    both. With `smoothing` a mean of both is.

    **Main arguments:**

    - `problem`: what to solve.
    - `guess`: where to start, with the time grid to use: a trajectory, or a solution's;
        a straight line by default. Of several, on one time grid, the best is returned:
        the cheapest of those that converge and that [`verify`][] confirms, else the
        cheapest that converges, else the one that misses its constraints least.
        `Solution.attempts` holds them all.
        Inside a transformation, where nothing can be verified, convergence decides.
    - `method`: [`ProximalSCP`][], or the paper's [`PaperSCP`][].
    - `nodes`: number of nodes, or their fractions of the flight time; only without a
        guess, which has its own.

    **Other arguments:**

    - `discretization`: hold, quadrature, free intervals and integration tolerance.
    - `smoothing`: above zero, derivatives of trajectory, integrals and multipliers change
        gradually where limits begin or cease to hold, instead of jumping. It is the
        product of multiplier and slack, both scaled, that counts as none: limits with
        multipliers or slacks below its root hold in part. Derivatives are biased by
        about it where a limit is clear: what the limit holds gives way a little, and
        follows a little before it holds; they depend on the scales of `Bounds`. The
        solution is the same, and so are the objective's first derivatives, which are
        continuous without.
    - `progress`: called after every iteration with a dictionary of its numbers: the
        fields of [`History`][], `iteration`, and `attempt`: which of the guesses it
        started from, counted from 0.
    - `throw`: raise if no guess leads to convergence. With `throw=False` the solution
        says so in its status and holds the last iterate.

    **Raises:** `RuntimeError` if JAX is not in 64-bit mode, `ValueError` for a problem
    or guess that makes no sense, [`SolveError`][] without convergence; inside `jax.jit`
    that is Equinox's runtime error with the status' sentence. `ValueError` if derivatives
    are taken of a solution that is not polished, or by a number that a function of the
    problem captured; inside `jax.jit` derivatives of a solution not polished are NaN.
    """
    begun = time.perf_counter()
    check_precision()
    check_kind("problem", problem, OptimalControlProblem, "an OptimalControlProblem")
    check_kind("method", method, AbstractSCP, "ProximalSCP() or PaperSCP()")
    check_kind("discretization", discretization, Discretization, "a Discretization")
    if progress is not None:
        check_kind("progress", progress, Callable, "a function of a dictionary")
    problem = as_parameters(problem)
    check_captured(problem)
    numbers = constant(problem)
    check_problem(numbers)
    if guess is None:
        guess = straight_line(numbers, nodes)
    elif isinstance(guess, Solution):
        guess = guess.trajectory
    check_smoothing(smoothing)
    guesses = (guess,) if isinstance(guess, Trajectory) else tuple(guess)
    for each in guesses:
        check_kind("guess", each, Trajectory, "a Trajectory")
    guesses = as_parameters(guesses)
    check_guesses(numbers, guesses)
    transcription = Transcription(problem, discretization, guesses[0].fractions)
    none = is_concrete(smoothing) and not smoothing
    # Decided here: an array made while others are traced has no value to ask for.
    tau = None if none else jnp.asarray(smoothing, float)
    solution = _best(method, transcription, constant(guesses), tau, listener(progress))
    if is_concrete(solution.optimality):
        jax.block_until_ready(solution.optimality)
        elapsed = as_floats(time.perf_counter() - begun)
        solution = eqx.tree_at(lambda s: s.statistics.seconds, solution, elapsed)
        if throw and not bool(solution.converged):
            raise SolveError(constant(solution))
        if is_differentiated(transcription):
            check_polished(constant(solution))
        return solution
    if throw:
        return solution.status.error_if(solution, ~solution.converged)
    return solution


def _best(
    method: AbstractSCP,
    transcription: Transcription,
    guesses: tuple[Trajectory, ...],
    smoothing: Scalar | None,
    told: Array | None,
) -> Solution:
    """The best of what the guesses lead to, all through one compiled program."""

    def attempt(index, guess):
        index = jnp.asarray(as_array(index), int)
        if transcription.discretization.interval_ratio is None:
            return _from(method, transcription, guess, smoothing, index, told)
        paced = lifted(transcription, guess)
        solution = _from(method, *paced, smoothing, index, told)
        return lowered(solution, transcription.problem)

    if len(guesses) == 1:
        return attempt(0, guesses[0])
    together = jax.tree.map(lambda *each: jnp.stack(each), *guesses)
    if not is_concrete(eqx.filter(constant((transcription, together)), eqx.is_array)):
        return best_unverified(
            eqx.filter_vmap(attempt)(jnp.arange(len(guesses)), together)
        )
    # Each is awaited: they share the host's QP solver.
    return best([jax.block_until_ready(attempt(*each)) for each in enumerate(guesses)])


def _from(
    method: AbstractSCP,
    transcription: Transcription,
    guess: Trajectory,
    smoothing: Scalar | None,
    attempt: Array,
    told: Array | None,
) -> Solution:
    """What one guess leads to, as a function of the problem but not of the guess."""
    numbers, guess = constant((transcription, guess))
    solution = _run(method, numbers, guess, attempt, told)
    if is_concrete(eqx.filter(transcription, eqx.is_array)):
        return solution
    return differentiable(transcription, solution, smoothing)


@compiled
def _run(
    method: AbstractSCP,
    transcription: Transcription,
    guess: Trajectory,
    attempt: Array,
    told: Array | None,
) -> Solution:
    arrays, rest = eqx.partition((transcription, guess, attempt, told), eqx.is_array)

    # A batch shares nothing but its pattern: one after another, each element iterates
    # as often as it needs and none waits for, or spoils, another.
    @jax.custom_batching.sequential_vmap
    def one(arrays):
        transcription, guess, attempt, told = eqx.combine(arrays, rest)
        variables = transcription.variables(guess)
        return run(method, transcription, variables, told, attempt)

    return outcome(transcription, *one(arrays))
