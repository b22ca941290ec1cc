"""What derivatives cost: python -m benchmarks.gradients

Missions are solved from their own guesses, with limits between the nodes. Then two
derivatives by every number of the problem are timed: that of the objective (envelope
theorem) and that of a random sum of all states, controls and the flight time (implicit
function theorem, in reverse). Memory is what XLA sets aside for their programs. Central
differences take two solves for each number of the problem; one is timed from the
solution, with one number changed by a thousandth.
"""

import functools
from collections.abc import Callable
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import jaxscp
from jaxscp import Discretization, missions
from jaxscp._outcome import differentiable

from .over_nodes import exponent, finish, in_order, measured
from .records import table
from .timing import timed, timed_solve

NODES = (25, 50, 100, 200, 400)
COLUMNS = (
    "mission | N | solve, s | objective, ms | MiB | trajectory, ms | MiB"
    " | differences, s | polished"
)
BETWEEN = Discretization(between=missions.ENFORCED["between"])


def reverse(of: Callable[[jaxscp.Solution], jax.Array], solution: jaxscp.Solution):
    """The gradient of a function of the solution by the problem, compiled."""

    def gradient(problem, solution):
        def value(problem):
            transcription = solution.transcription
            moved = eqx.tree_at(lambda t: t.problem, transcription, problem)
            return of(differentiable(moved, solution))

        return eqx.filter_grad(value)(problem)

    return eqx.filter_jit(gradient).lower(solution.problem, solution).compile()


def spread(solution: jaxscp.Solution) -> jax.Array:
    """A random sum of the whole trajectory."""
    flight, draw = solution.trajectory, np.random.default_rng(0)
    parts = (flight.states, flight.controls, flight.final_time)
    return sum(jnp.vdot(draw.normal(size=part.shape), part) for part in parts)


def measure(name: str, nodes: int, repeats: int) -> dict:
    """One mission with so many nodes."""
    jax.clear_caches()
    mission = missions.get(name)
    problem, guess = mission.problem(), mission.guess(nodes)
    solution, _, solve = timed_solve(problem, guess, repeats, discretization=BETWEEN)
    row = {"mission": name, "nodes": nodes, "polished": bool(solution.polished)}
    row["solve_seconds"] = solve
    for what, of in (("objective", lambda s: s.objective), ("trajectory", spread)):
        program = reverse(of, solution)
        call = functools.partial(program, solution.problem, solution)
        row[f"{what}_seconds"] = timed(call, 3 * repeats).warm
        row[f"{what}_bytes"] = program.compiled.memory_analysis().temp_size_in_bytes
    heavier = eqx.tree_at(
        lambda p: p.dynamics.mass, problem, 1.001 * mission.vehicle.mass
    )
    _, _, again = timed_solve(
        heavier, solution.trajectory, repeats, discretization=BETWEEN
    )
    leaves = jax.tree.leaves(eqx.filter(mission, eqx.is_inexact_array))
    row["numbers"] = sum(leaf.size for leaf in leaves)
    row["differences_seconds"] = 2 * row["numbers"] * again
    return row


def line(row: dict) -> str:
    """A row of the table, in Markdown."""
    cells = [row["mission"], row["nodes"], f"{row['solve_seconds']:.2f}"]
    for what in ("objective", "trajectory"):
        spent = row[f"{what}_seconds"]
        cells.append(f"{1e3 * spent:.1f} ({100 * spent / row['solve_seconds']:.1f} %)")
        cells.append(f"{row[f'{what}_bytes'] / 2**20:.1f}")
    cells.append(f"{row['differences_seconds']:.0f}")
    cells.append("yes" if row["polished"] else "no")
    return f"| {' | '.join(map(str, cells))} |"


def figure(report: dict, path: Path) -> None:
    """Time and memory over the number of nodes."""
    by_mission = report["missions"]
    drawing, (times, memory) = plt.subplots(1, 2, figsize=(9, 3.8), layout="constrained")
    for (name, rows), style in zip(by_mission.items(), ("o-", "s--"), strict=False):
        nodes = [row["nodes"] for row in rows]
        for color, what in enumerate(("differences", "solve", "trajectory", "objective")):
            values = [row[f"{what}_seconds"] for row in rows]
            times.loglog(nodes, values, style, color=f"C{color}", label=f"{what}, {name}")
            if f"{what}_bytes" in rows[0]:
                size = [row[f"{what}_bytes"] / 2**20 for row in rows]
                power = exponent(rows, f"{what}_bytes")
                label = f"{what}, {name}: N^{power:.2f}"
                memory.loglog(nodes, size, style, color=f"C{color}", label=label)
    times.set(xlabel="nodes N", ylabel="seconds")
    memory.set(xlabel="nodes N", ylabel="memory [MiB]")
    finish(drawing, path, legend=6)


def tables(report: dict) -> str:
    """What was measured, in Markdown."""
    return table(COLUMNS, map(line, in_order(report)))


def main() -> None:
    figure(*measured("gradients", __doc__, NODES, COLUMNS, measure, line))


if __name__ == "__main__":
    main()
