"""How a solve grows with the number of nodes: python -m benchmarks.growth

Each mission is solved from its own guess with 50 to 2,000 nodes, default settings and
limits at the nodes. Time per iteration is that of a whole warm solve, divided by all
its iterations, those that polish included: processor time, which other programs on the
machine hardly change.
"""

import time
from pathlib import Path

import jax
import matplotlib.pyplot as plt
import numpy as np

import jaxscp
from jaxscp import missions

from .over_nodes import exponent, finish, in_order, measured
from .records import HEADINGS, cells, facts_of, table
from .timing import timed_solve

NODES = (50, 100, 200, 400, 800, 1200, 2000)
COLUMNS = (
    f"mission | N | {HEADINGS} | s | CPU s | CPU ms an iteration | converged | verified"
)


def measure(name: str, nodes: int, repeats: int) -> dict:
    """One mission with so many nodes; seconds are wall-clock, but for `cpu_seconds`."""
    mission = missions.get(name)
    problem, guess = mission.problem(), mission.guess(nodes)
    _, cold, warm = timed_solve(problem, guess, repeats)
    begun = time.process_time()
    solution = jax.block_until_ready(jaxscp.solve(problem, guess, throw=False))
    cpu = time.process_time() - begun
    statistic, facts = solution.statistics, facts_of(solution)
    return {
        "mission": name,
        "nodes": nodes,
        **facts,
        "verified": jaxscp.verify(problem, solution).verified,
        "qp_iterations": int(statistic.qp_iterations),
        "substeps": int(statistic.substeps),
        "cold_seconds": cold,
        "warm_seconds": warm,
        "cpu_seconds": cpu,
        "piqp_seconds": float(statistic.qp_seconds),
        "seconds_per_iteration": cpu / (facts["iterations"] + facts["polish_iterations"]),
    }


def figure(report: dict, path: Path) -> None:
    """Time per iteration and number of iterations over the number of nodes."""
    by_mission = report["missions"]
    drawing, (times, counts) = plt.subplots(1, 2, figsize=(9, 3.6), layout="constrained")
    for name, rows in by_mission.items():
        nodes = [row["nodes"] for row in rows]
        seconds = [row["seconds_per_iteration"] for row in rows]
        power = exponent(rows, "seconds_per_iteration")
        times.loglog(nodes, seconds, "o-", label=f"{name}: N^{power:.2f}")
        first = [row["iterations"] for row in rows]
        total = [row["iterations"] + row["polish_iterations"] for row in rows]
        (drawn,) = counts.semilogx(nodes, first, "o-", label=f"{name}, before polishing")
        counts.semilogx(nodes, total, "o:", color=drawn.get_color(), label="... in all")
    every = [row["nodes"] for rows in by_mission.values() for row in rows]
    ends = np.array([min(every), max(every)])
    times.loglog(ends, seconds[0] * ends / ends[0], "k--", lw=0.8, label="N")
    times.set(xlabel="nodes N", ylabel="processor time per iteration [s]")
    counts.set(xlabel="nodes N", ylabel="iterations", ylim=(0, None))
    finish(drawing, path, legend=8)


def line(row: dict) -> str:
    """A row of the table, in Markdown."""
    return (
        f"| {row['mission']} | {row['nodes']} | {cells(row)}"
        f" | {row['warm_seconds']:.2f}"
        f" | {row['cpu_seconds']:.2f}"
        f" | {1e3 * row['seconds_per_iteration']:.1f}"
        f" | {'yes' if row['polished'] else 'roughly' if row['converged'] else 'no'}"
        f" | {'yes' if row['verified'] else 'no'} |"
    )


def tables(report: dict) -> str:
    """What was measured, in Markdown."""
    return table(COLUMNS, map(line, in_order(report)))


def main() -> None:
    report, path = measured("growth", __doc__, NODES, COLUMNS, measure, line)
    for name, rows in report["missions"].items():
        power = exponent(rows, "seconds_per_iteration")
        print(f"{name}: time per iteration grows as N^{power:.2f}")
    figure(report, path)


if __name__ == "__main__":
    main()
