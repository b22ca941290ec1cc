"""`continuation`: problems in a line, each solved from the solution before."""

from collections.abc import Iterable, Sequence
from typing import Any

from ._problem import OptimalControlProblem
from ._proximal import ProximalSCP
from ._scp import AbstractSCP
from ._solution import Solution
from ._solve import solve
from ._trajectory import Trajectory
from ._types import is_concrete


def continuation(
    problems: Iterable[OptimalControlProblem],
    guess: Trajectory | Sequence[Trajectory] | None = None,
    method: AbstractSCP = ProximalSCP(),  # noqa: B008  (immutable)
    *,
    throw: bool = True,
    **settings: Any,
) -> tuple[Solution, ...]:
    """Solve problems in a line, each from the solution of the one before.

    A requirement that rises in steps is met where one that is there at once is not; and
    a front, such as least energy over data to send, is drawn in a fraction of the time.

    **Arguments:**

    - `problems`: that differ in numbers only, so that one compilation serves them all.
    - `guess`: where the first starts, as in [`jaxscp.solve`][]. Each other starts from
        the latest solution that converged or, if none did, from the last iterate.
    - `throw`: raise if the last problem's solve does not converge. That the earlier ones
        did is told by their statuses alone.
    - `method`, and as `settings` `nodes`, `discretization` and `progress`: as in
        [`jaxscp.solve`][].

    **Returns:** a solution for each problem, in their order.

    **Raises:** what [`jaxscp.solve`][] raises; `ValueError` without any problem.
    """
    line = tuple(problems)
    if not line:
        raise ValueError("problems=(): give at least one.")
    solutions: list[Solution] = []
    start, reached = guess, False
    for index, problem in enumerate(line, 1):
        last = throw and index == len(line)
        solution = solve(problem, start, method, throw=last, **settings)
        solutions.append(solution)
        known = is_concrete(solution.status)
        converged = not known or bool(solution.converged)
        if converged or not reached:
            start = solution.trajectory
        reached |= converged
    return tuple(solutions)
