"""What is wrong with a solve that did not converge, by name, place and amount."""

from collections.abc import Callable, Iterator

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ._problem import OptimalControlProblem
from ._status import Status, sentence_of
from ._trajectory import Trajectory
from ._types import Array, Float


class Violations(eqx.Module):
    """How far each constraint of the discrete problem is broken, in its own unit.

    - `dynamics`: virtual control: next node minus the flow's end, with its sign.
    - `path_constraints`: positive part of each, at each node.
    - `integrals`: what each is short of its lower limit, or beyond its upper one.
    - `scales`: of the states, the path constraints and the integrals.
    """

    dynamics: Float[Array, "I n"]
    path_constraints: dict[str, Float[Array, "N _"]]
    integrals: dict[str, Float[Array, ""]]
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
    if bool(status == Status.converged) or bool(status == Status.converged_roughly):
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
    defects = np.abs(np.asarray(violations.dynamics))
    relative = defects / np.asarray(state_scale)
    node, entry = np.unravel_index(np.argmax(relative), relative.shape)
    name = problem.state_names[entry]
    yield (
        float(relative[node, entry]),
        f"virtual control moves {name} by {_amount(problem, name, defects[node, entry])}"
        f" between nodes {node} and {node + 1} ({times[node]:.4g} s to"
        f" {times[node + 1]:.4g} s)",
    )
    for name, broken in violations.path_constraints.items():
        amounts = np.asarray(broken)
        if amounts.size:
            relative = amounts / np.asarray(path_scales[name])
            node, entry = np.unravel_index(np.argmax(relative), relative.shape)
            which = f"{name}[{entry}]" if amounts.shape[1] > 1 else name
            yield (
                float(relative[node, entry]),
                f"{which} is broken by {_amount(problem, name, amounts[node, entry])}"
                f" at node {node} ({times[node]:.4g} s)",
            )
    for name, broken in violations.integrals.items():
        yield (
            float(broken / integral_scales[name]),
            f"the integral {name} misses its limit by"
            f" {_amount(problem, name, float(broken))}",
        )


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
