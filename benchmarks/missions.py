"""How well and how fast the paper's missions are solved: python -m benchmarks.missions

Each mission is solved once with compilation, then repeatedly with other numbers in its
guess's place: the same. Accuracy stands beside time.
"""

import argparse

import jax

import jaxscp
from jaxscp import missions

from .records import (
    HEADINGS,
    add_json_option,
    cells,
    facts_of,
    table,
    table_head,
    write_report,
)
from .timing import timed_solve

# Objective [N^2 s] that IPOPT (tolerance 1e-8) reached on the same discrete problem:
# 100 nodes, zero-order hold, integrals along the flow, limits at the nodes.
BEST_KNOWN = {
    "free-flight": 24380.67,
    "urban-flight": 24824.93,
    "free-space-30MB-60dB": 43607.78,
    "urban-30MB-60dB": 47262.50,
}
COLUMNS = (
    f"mission | {HEADINGS} | above best known | verified | warm, s | of it in PIQP, s"
    " | cold, s"
)


def measure(name: str, nodes: int, repeats: int) -> dict:
    """Solve one mission cold and warm; seconds are wall-clock."""
    mission = missions.get(name)
    problem, guess = mission.problem(), mission.guess(nodes)
    solution, cold, warm = timed_solve(problem, guess, repeats)
    facts, best = facts_of(solution), BEST_KNOWN.get(name)
    return {
        "mission": name,
        **facts,
        "verified": jaxscp.verify(problem, solution).verified,
        "above_best_known": None if best is None else facts["objective"] / best - 1,
        "final_time": float(solution.trajectory.final_time),
        "cold_seconds": cold,
        "warm_seconds": warm,
        "piqp_seconds": float(solution.statistics.qp_seconds),
    }


def line(row: dict) -> str:
    """A row of the table, in Markdown."""
    above = row["above_best_known"]
    return (
        f"| {row['mission']} | {cells(row)} | {'' if above is None else f'{above:+.1e}'}"
        f" | {'yes' if row['verified'] else 'no'} | {row['warm_seconds']:.3f}"
        f" | {row['piqp_seconds']:.3f} | {row['cold_seconds']:.1f} |"
    )


def tables(report: dict) -> str:
    """What was measured, in Markdown."""
    return table(COLUMNS, map(line, report["missions"]))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--missions", nargs="*", default=list(BEST_KNOWN))
    parser.add_argument("--nodes", type=int, default=100)
    parser.add_argument("--repeats", type=int, default=9)
    add_json_option(parser, "missions")
    arguments = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    print(table_head(COLUMNS))
    rows = []
    for name in arguments.missions:
        rows.append(measure(name, arguments.nodes, arguments.repeats))
        print(line(rows[-1]), flush=True)
        write_report(arguments.json, missions=rows)


if __name__ == "__main__":
    main()
