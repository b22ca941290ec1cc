"""What is wrong with a solve that did not converge, by name, place and amount."""

from collections.abc import Callable, Iterator

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ._paced_problem import PACE_STATES
from ._problem import OptimalControlProblem, entry_name
from ._status import Status, has_converged, sentence_of
from ._trajectory import Trajectory
from ._types import Array, Float


class Violations(eqx.Module):
    """How far each constraint of the discrete problem is broken, in its own unit.

    - `dynamics`: virtual control: next node minus the flow's end, with its sign. Where
        intervals are free those of the grid, time and pace, come behind the states'.
    - `path_constraints`: positive part of each, at each node.
    - `integrals`: what each is short of its lower limit, or beyond its upper one.
    - `state_between`, `path_between`: how far state limits and path constraints are
        exceeded within each interval; zero where they are not enforced there.
    - `scales`: of the states, the path constraints and the integrals.
    """

    dynamics: Float[Array, "I n"]
    path_constraints: dict[str, Float[Array, "N _"]]
    integrals: dict[str, Float[Array, ""]]
    state_between: Float[Array, "I n"]
    path_between: dict[str, Float[Array, "I _"]]
    scales: tuple[
        Float[Array, " n"],
        dict[str, Float[Array, " _"]],
        dict[str, Float[Array, ""]],
    ]


def explain(
    problem: OptimalControlProblem,
    trajectory: Trajectory,
    violations: Violations,
    status: Status,
) -> str:
    """The status' sentence and, unless it is a success, what is wrong where."""
    sentence = sentence_of(status)
    if bool(has_converged(status) | (status == Status.stalled)):
        return sentence
    if bool(status == Status.non_finite):
        return f"{sentence} {_first_non_finite(problem, trajectory)}"
    relative, detail = max(
        _violated(problem, trajectory, violations), key=lambda found: found[0]
    )
    return f"{sentence} Worst: {detail}." if relative > 0 else sentence


def _violated(
    problem: OptimalControlProblem, trajectory: Trajectory, violations: Violations
) -> Iterator[tuple[float, str]]:
    """The worst violation of each kind, relative to its scale, with a description."""
    times = np.asarray(trajectory.times)
    state_scale, path_scales, integral_scales = violations.scales

    def between(row: int) -> str:
        start, end = times[row : row + 2]
        return f"between nodes {row} and {row + 1} ({start:.4g} s to {end:.4g} s)"

    def at(row: int) -> str:
        return f"at node {row} ({times[row]:.4g} s)"

    for broken, verb, where in (
        (violations.dynamics, "virtual control moves {} by", between),
        (violations.state_between, "{} exceeds its limit by", between),
    ):
        relative, row, entry, value = _worst(broken, state_scale)
        name = (*problem.state_names, *PACE_STATES)[entry]
        amount = _amount(problem, name, value)
        yield relative, f"{verb.format(name)} {amount} {where(row)}"
    for by_name, where in (
        (violations.path_constraints, at),
        (violations.path_between, between),
    ):
        for name, broken in by_name.items():
            if broken.size:
                relative, row, entry, value = _worst(broken, path_scales[name])
                which = entry_name(name, entry, broken.shape[1])
                amount = _amount(problem, name, value)
                yield relative, f"{which} is broken by {amount} {where(row)}"
    for name, missing in violations.integrals.items():
        yield (
            float(missing / integral_scales[name]),
            f"the integral {name} misses its limit by"
            f" {_amount(problem, name, float(missing))}",
        )


def _worst(broken: Array, scales: Array) -> tuple[float, int, int, float]:
    """The largest entry relative to its scale: how large, its place, its amount."""
    amounts = np.abs(np.asarray(broken))
    relative = amounts / np.asarray(scales)
    row, entry = np.unravel_index(np.argmax(relative), relative.shape)
    return float(relative[row, entry]), int(row), int(entry), float(amounts[row, entry])


def _amount(problem: OptimalControlProblem, name: str, value: float) -> str:
    return f"{value:.4g} {problem.unit(name)}".rstrip()


def _first_non_finite(problem: OptimalControlProblem, trajectory: Trajectory) -> str:
    """Which function, at which node: values first, then derivatives."""
    points = (trajectory.times, trajectory.states, trajectory.controls)
    for what, transform in (("value", lambda f: f), ("derivative", _derivative)):
        for name, function in _functions(problem):
            values = jax.vmap(transform(function))(*points)
            broken = ~np.isfinite(np.asarray(values).reshape(trajectory.nodes, -1))
            if name == "terminal_cost":
                broken[:-1] = False
            bad = np.flatnonzero(broken.any(axis=1))
            if bad.size:
                node = int(bad[0])
                x = np.asarray(trajectory.states[node])
                moment = float(points[0][node])
                return (
                    f"First: the {what} of {name} at node {node} ({moment:.4g} s), "
                    f"state {np.array2string(x, precision=4, max_line_width=10_000)}."
                )
    return "All functions are finite at the nodes: it happens within an interval."


def _derivative(function: Callable) -> Callable:
    return lambda t, x, u: jnp.concatenate(
        [
            jnp.ravel(part)
            for part in jax.jacfwd(
                lambda t, x, u: jnp.ravel(function(t, x, u)), argnums=(0, 1, 2)
            )(t, x, u)
        ]
    )


def _functions(problem: OptimalControlProblem) -> Iterator[tuple[str, Callable]]:
    yield "dynamics", problem.dynamics
    yield "running_cost", problem.running_cost
    yield "terminal_cost", lambda t, x, u: problem.terminal_cost(t, x)
    for name, constraint in problem.path_constraints.items():
        yield f"path_constraints[{name!r}]", constraint
    for name, integral in problem.integrals.items():
        yield f"integrals[{name!r}].integrand", integral.integrand
