"""`audit_gradient`: derivatives of a solve beside finite differences of whole solves."""

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ._bounds import Bounds
from ._discretization import Discretization
from ._kkt import objective
from ._problem import OptimalControlProblem
from ._proximal import ProximalSCP
from ._scp import AbstractSCP
from ._sensitivity import optimal_point
from ._solution import Solution
from ._solve import solve
from ._trajectory import Trajectory
from ._types import Array, PyTree

# What polishing leaves of a solution's numbers, relative to them.
_NOISE = 1e-8

OF: dict[str, Callable[[Solution], Any]] = {
    "objective": lambda solution: solution.objective,
    "final_time": lambda solution: solution.trajectory.final_time,
}


class Audited(eqx.Module):
    """One parameter, all its entries moved together along a direction.

    - `name`: where it is in the tree. `implicit`: derivative by the implicit function
        theorem. `envelope`: by the envelope theorem, NaN for all but the objective.
    - `difference`: central difference of whole solves, with the step of the sweep that
        changes it least. `step`: that step, in shares of the parameter's size.
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
        heads = ("implicit", "envelope", "difference")
        heading = f"{'parameter':40}" + "".join(f"{head:>16}" for head in heads)
        heading += f"{'step':>9}{'noise':>9}"
        return "\n".join([heading, *map(str, self.rows)])


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

    **Raises:** `ValueError` for a name that no parameter has, and where [`solve`][] does.
    """
    function = OF[of] if isinstance(of, str) else of

    def solved(parameters, guess=guess) -> Solution:
        problem = build(parameters)
        return solve(problem, guess, method, nodes=nodes, discretization=discretization)

    directions = list(_directions(parameters, wrt))
    if not directions:
        raise ValueError(
            f"wrt={wrt}: no parameter's name begins so; the names are "
            f"{', '.join(name for name, _ in _directions(parameters, None))}."
        )

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
    for name, way in directions:

        def moved(step: float, way=way) -> float:
            return float(at(eqx.apply_updates(parameters, _times(step, way))))

        sweep = [(moved(step) - moved(-step)) / (2.0 * step) for step in steps]
        best = _steadiest(sweep)
        found = (
            _along(implicit, way),
            np.nan if envelope is None else _along(envelope, way),
        )
        uncertain = noise / steps[best]
        passed = _agree(found, sweep[best], tolerance, uncertain)
        rows.append(Audited(name, *found, sweep[best], steps[best], uncertain, passed))
    return Audit(tuple(rows))


def _along(gradient: PyTree, way: PyTree) -> float:
    """The derivative along a direction."""
    return float(sum(jax.tree.leaves(jax.tree.map(jnp.vdot, gradient, way))))


def _agree(
    found: tuple[float, float], difference: float, tolerance: float, noise: float
) -> bool:
    """Whether a difference confirms derivatives, those that are known."""
    apart = np.nanmax(np.abs(np.array(found) - difference))
    size = max(abs(found[0]), abs(difference))
    return bool(apart <= tolerance * size + noise)


def _directions(
    parameters: PyTree, wrt: Sequence[str] | None
) -> Iterator[tuple[str, PyTree]]:
    """Each parameter's name, and the tree in which it alone moves, by its own size."""
    numbers = eqx.filter(parameters, eqx.is_inexact_array)
    groups, structure = jax.tree_util.tree_flatten_with_path(numbers, is_leaf=_is_bounds)
    still = [jax.tree.map(jnp.zeros_like, group) for _, group in groups]
    for place, (path, group) in enumerate(groups):
        name = jax.tree_util.keystr(path, simple=True, separator=".")
        for limit, way in _ways(group):
            if wrt is None or any((name + limit).startswith(begin) for begin in wrt):
                trees = [*still[:place], way, *still[place + 1 :]]
                yield name + limit, jax.tree.unflatten(structure, trees)


def _ways(group: Any) -> Iterator[tuple[str, Any]]:
    """What of a parameter moves by itself: of bounds each limit, where equal both."""
    if not isinstance(group, Bounds):
        if group.size:
            yield "", _way(group, np.ones(group.shape, bool))
        return
    still, fixed = jax.tree.map(jnp.zeros_like, group), group.is_fixed
    none = jnp.zeros(group.shape)
    below, above = np.isfinite(group.lower), np.isfinite(group.upper)
    target = _way(group.target, fixed)
    for limit, moves, ends in (
        (".value", fixed, (target, target)),
        (".lower", below & ~fixed, (_way(group.lower, below & ~fixed), none)),
        (".upper", above & ~fixed, (none, _way(group.upper, above & ~fixed))),
    ):
        if moves.any():
            yield limit, eqx.tree_at(lambda b: (b.lower, b.upper), still, ends)


def _way(values: Array, moves: Any) -> Array:
    """A direction with signs of chance, as large as the largest number that moves."""
    sizes = np.abs(np.where(moves, values, 0.0))
    size = float(np.max(sizes, initial=0.0)) or 1.0
    signs = np.random.default_rng(0).choice([-1.0, 1.0], values.shape)
    return jnp.asarray(np.where(moves, size * signs, 0.0))


def _is_bounds(node: Any) -> bool:
    return isinstance(node, Bounds)


def _times(factor: float, tree: PyTree) -> PyTree:
    return jax.tree.map(lambda leaf: factor * leaf, tree)


def _steadiest(sweep: list[float]) -> int:
    """The entry that differs least from the one before or behind it."""
    if len(sweep) == 1:
        return 0
    changes = np.abs(np.diff(sweep))
    return int(np.argmin(changes)) + 1
