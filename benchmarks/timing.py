"""How every benchmark times a solve."""

import statistics
import time
from typing import NamedTuple

import jax

import jaxscp


class Timed(NamedTuple):
    """The last solution, with wall-clock seconds: with compilation, and without."""

    solution: jaxscp.Solution
    cold: float
    warm: float


def timed_solve(
    problem: jaxscp.OptimalControlProblem,
    guess: jaxscp.Trajectory,
    repeats: int,
    method: jaxscp.AbstractSCP = jaxscp.ProximalSCP(),  # noqa: B008  (immutable)
    **settings,
) -> Timed:
    """Solve once with compilation, then `repeats` times; warm is their median.

    **Arguments:**

    - `settings`: others of `jaxscp.solve`.
    """
    seconds = []
    for _ in range(repeats + 1):
        begun = time.perf_counter()
        solution = jaxscp.solve(problem, guess, method, throw=False, **settings)
        jax.block_until_ready(solution)
        seconds.append(time.perf_counter() - begun)
    return Timed(solution, seconds[0], statistics.median(seconds[1:]))
