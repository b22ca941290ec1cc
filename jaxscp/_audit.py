"""`audit_gradient`: derivatives of a solve beside finite differences of whole solves."""

import math
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ._direction import own_directions
from ._discretization import Discretization
from ._kkt import objective
from ._problem import OptimalControlProblem
from ._proximal import ProximalSCP
from ._scp import AbstractSCP
from ._sensitivity import optimal_point
from ._solution import Solution
from ._solve import SolveError, solve
from ._trajectory import Trajectory
from ._types import PyTree

# What polishing leaves of a solution's numbers, relative to them.
_NOISE = 1e-8

OF: dict[str, Callable[[Solution], Any]] = {
    "objective": lambda solution: solution.objective,
    "final_time": lambda solution: solution.trajectory.final_time,
}


HEADING = f"{'parameter':40}" + "".join(
    f"{head:>{width}}"
    for head, width in (
        ("implicit", 16),
        ("envelope", 16),
        ("difference", 16),
        ("step", 9),
        ("noise", 9),
    )
)


class Audited(eqx.Module):
    """One parameter, all its entries moved together along a direction.

    Derivatives are by shares of the parameter's size: that by a mass of 3 kg is three
    times that by a kilogram.

    - `name`: where it is in the tree. `implicit`: derivative by the implicit function
        theorem. `envelope`: by the envelope theorem, NaN for all but the objective.
    - `difference`: central difference of whole solves, with the step of the sweep that
        changes it least; NaN where these did not converge. `step`: that step, in shares
        of the parameter's size.
    - `noise`: what polishing to a tolerance leaves uncertain in it.
    - `passed`: whether they agree.
    """

    name: str = eqx.field(static=True)
    implicit: float
    envelope: float
    difference: float
    step: float
    noise: float
    passed: bool

    def __str__(self) -> str:
        numbers = (self.implicit, self.envelope, self.difference)
        return (
            f"{self.name:40}"
            + "".join(f"{number:16.8g}" for number in numbers)
            + f"{self.step:9.0e}{self.noise:9.0e}  {'pass' if self.passed else 'FAIL'}"
        )


class Audit(eqx.Module):
    """The table of [`audit_gradient`][]; print it."""

    rows: tuple[Audited, ...]

    @property
    def passed(self) -> bool:
        """Whether every row did."""
        return all(row.passed for row in self.rows)

    def __str__(self) -> str:
        return "\n".join([HEADING, *map(str, self.rows)])


def audit_gradient(
    parameters: PyTree,
    of: str | Callable[[Solution], Any] = "objective",
    wrt: Sequence[str] | None = None,
    *,
    build: Callable[[Any], OptimalControlProblem] = lambda problem: problem,
    guess: Trajectory | None = None,
    method: AbstractSCP = ProximalSCP(),  # noqa: B008  (immutable)
    discretization: Discretization = Discretization(),  # noqa: B008  (immutable)
    nodes: int = 50,
    steps: Sequence[float] = (1e-3, 1e-4, 1e-5),
    tolerance: float = 1e-3,
    progress: Callable[[Audited], None] | None = None,
) -> Audit:
    """Check derivatives of a solve, parameter by parameter.

    **Arguments:**

    - `parameters`: a problem, or whatever `build` makes one of, as a mission with
        `build=Mission.problem`.
    - `of`: "objective", "final_time", or a function of a solution.
    - `wrt`: beginnings of names of parameters, as the table shows them; all by default.
    - `guess`, `method`, `discretization`, `nodes`: as of [`solve`][]. Solves after the
        first start from its solution.
    - `steps`: of the differences, in shares of each parameter's size.
    - `tolerance`: relative difference, beyond the noise, that passes.
    - `progress`: called with each row once it is there.

    **Raises:** `ValueError` for an unknown `of`, a name that no parameter has, and where
    [`solve`][] does.
    """
    if isinstance(of, str) and of not in OF:
        raise ValueError(
            f"of={of!r}: choose {' or '.join(map(repr, OF))}, or give a function of a "
            "solution."
        )
    function = OF[of] if isinstance(of, str) else of

    def solved(parameters, guess=guess) -> Solution:
        problem = build(parameters)
        return solve(problem, guess, method, nodes=nodes, discretization=discretization)

    directions = own_directions(parameters, wrt)
    start = solved(parameters)

    def at(parameters):
        return function(solved(parameters, start.trajectory))

    def without_envelope(parameters):
        solution = solved(parameters, start.trajectory)
        transcription = eqx.tree_at(
            lambda t: t.problem, start.transcription, solution.problem
        )
        point = optimal_point(transcription, solution.optimum)
        return objective(transcription, solution.optimum, point.step)

    implicit = eqx.filter_grad(at)(parameters)
    envelope = None
    if of == "objective" and discretization.interval_ratio is None:
        envelope, implicit = implicit, eqx.filter_grad(without_envelope)(parameters)
    noise = _NOISE * abs(float(function(start)))
    rows = []
    for name, way in directions.items():

        def moved(step: float, way=way) -> float:
            try:
                return float(at(eqx.apply_updates(parameters, _times(step, way))))
            except SolveError:
                return math.nan

        sweep = [(moved(step) - moved(-step)) / (2.0 * step) for step in steps]
        best = _steadiest(sweep)
        found = (
            _along(implicit, way),
            math.nan if envelope is None else _along(envelope, way),
        )
        uncertain = noise / steps[best]
        passed = _agree(found, sweep[best], tolerance, uncertain)
        row = Audited(name, *found, sweep[best], steps[best], uncertain, passed)
        if progress is not None:
            progress(row)
        rows.append(row)
    return Audit(tuple(rows))


def _along(gradient: PyTree, way: PyTree) -> float:
    """The derivative along a direction."""
    return float(sum(jax.tree.leaves(jax.tree.map(jnp.vdot, gradient, way))))


def _agree(
    found: tuple[float, float], difference: float, tolerance: float, noise: float
) -> bool:
    """Whether a difference confirms derivatives, those that are known."""
    if math.isnan(difference):
        return False
    apart = np.nanmax(np.abs(np.array(found) - difference))
    size = max(abs(found[0]), abs(difference))
    return bool(apart <= tolerance * size + noise)


def _times(factor: float, tree: PyTree) -> PyTree:
    return jax.tree.map(lambda leaf: factor * leaf, tree)


def _steadiest(sweep: list[float]) -> int:
    """The entry that differs least from the one before; NaN is no entry."""
    changes = np.abs(np.diff(sweep))
    if np.isfinite(changes).any():
        return int(np.nanargmin(changes)) + 1
    return int(np.argmin(np.isnan(sweep)))
