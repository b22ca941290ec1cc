"""How well and how fast the paper's missions are solved: python -m benchmarks.missions

Each mission is solved once with compilation, then repeatedly with other numbers in its
guess's place: the same. Accuracy stands beside time.
"""

import argparse
from pathlib import Path

import jax

import jaxscp
from jaxscp import missions

from .report import facts_of, write_report
from .timing import timed_solve

# Objective [N^2 s] that IPOPT (tolerance 1e-8) reached on the same discrete problem:
# 100 nodes, zero-order hold, integrals along the flow, limits at the nodes.
BEST_KNOWN = {
    "free-flight": 24380.67,
    "urban-flight": 24824.93,
    "free-space-30MB-60dB": 43607.78,
    "urban-30MB-60dB": 47262.50,
}


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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--missions", nargs="*", default=list(BEST_KNOWN))
    parser.add_argument("--nodes", type=int, default=100)
    parser.add_argument("--repeats", type=int, default=9)
    parser.add_argument("--json", type=Path, help="where to write the numbers")
    arguments = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    rows = []
    for name in arguments.missions:
        row = measure(name, arguments.nodes, arguments.repeats)
        rows.append(row)
        print(
            f"{name:22} {row['objective']:12.2f} N^2 s  {row['iterations']:3d} iterations"
            f" + {row['polish_iterations']:2d} to {row['optimality']:.0e}"
            f"  {row['warm_seconds']:.3f} s warm ({row['piqp_seconds']:.3f} s in PIQP)"
            f"  {row['cold_seconds']:.1f} s cold  verified: {row['verified']}",
            flush=True,
        )
    if arguments.json:
        write_report(arguments.json, missions=rows)


if __name__ == "__main__":
    main()
