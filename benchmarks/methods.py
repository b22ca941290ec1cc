"""What each ingredient of the default method is worth: python -m benchmarks.methods

Every variant solves the same missions from the same guesses at the same nodes; one run,
so that the times may be compared.
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
from .variants import HardBall, SmoothMerit

VARIANTS = {
    "default": jaxscp.ProximalSCP(),
    "polished to 1e-6": jaxscp.ProximalSCP(tolerance=1e-6),
    "no second-order correction": jaxscp.ProximalSCP(correction=False),
    "curvature without the dynamics'": jaxscp.ProximalSCP(curvature="nodes"),
    "curvature of the cost only": jaxscp.ProximalSCP(curvature="cost"),
    "hard norm ball": HardBall(),
    "merit: augmented Lagrangian (SCvx*)": SmoothMerit(),
    "the paper's Algorithm 1": jaxscp.PaperSCP(),
}
MISSIONS = ("free-flight", "urban-flight", "free-space-30MB-60dB", "urban-30MB-60dB")
COLUMNS = f"mission | method | {HEADINGS} | s | converged"


def measure(mission: str, name: str, nodes: int, repeats: int) -> dict:
    """A mission by one of the methods; seconds are wall-clock, of a warm solve."""
    chosen = missions.get(mission)
    problem, guess = chosen.problem(), chosen.guess(nodes)
    solution, _, warm = timed_solve(problem, guess, repeats, VARIANTS[name])
    return {
        "mission": mission,
        "method": name,
        **facts_of(solution),
        "warm_seconds": warm,
    }


def line(row: dict) -> str:
    """A row of the table, in Markdown."""
    return (
        f"| {row['mission']} | {row['method']} | {cells(row)}"
        f" | {row['warm_seconds']:.2f} | {'yes' if row['converged'] else 'no'} |"
    )


def tables(report: dict) -> str:
    """What was measured, in Markdown."""
    return table(COLUMNS, map(line, report["methods"]))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--missions", nargs="*", default=list(MISSIONS))
    parser.add_argument("--nodes", type=int, default=100)
    parser.add_argument("--repeats", type=int, default=3)
    add_json_option(parser, "methods")
    arguments = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    print(table_head(COLUMNS))
    rows = []
    for mission in arguments.missions:
        for name in VARIANTS:
            rows.append(measure(mission, name, arguments.nodes, arguments.repeats))
            print(line(rows[-1]), flush=True)
            write_report(arguments.json, methods=rows)


if __name__ == "__main__":
    main()
