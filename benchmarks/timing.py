"""How every benchmark times a solve."""

import statistics
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax

import jaxscp


class Timed(NamedTuple):
    """The last result, with wall-clock seconds: of the first call, which may compile,
    and the median of the others.
    """

    result: Any
    cold: float
    warm: float


def timed(call: Callable[[], Any], repeats: int) -> Timed:
    """Call once, then `repeats` times."""
    seconds = []
    for _ in range(repeats + 1):
        begun = time.perf_counter()
        result = jax.block_until_ready(call())
        seconds.append(time.perf_counter() - begun)
    return Timed(result, seconds[0], statistics.median(seconds[1:]))


def timed_solve(
    problem: jaxscp.OptimalControlProblem,
    guess: jaxscp.Trajectory,
    repeats: int,
    method: jaxscp.AbstractSCP = jaxscp.ProximalSCP(),  # noqa: B008  (immutable)
    **settings,
) -> Timed:
    """The solution, and its times.

    **Arguments:**

    - `settings`: others of `jaxscp.solve`.
    """
    return timed(
        lambda: jaxscp.solve(problem, guess, method, throw=False, **settings), repeats
    )
