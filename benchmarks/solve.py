"""Time to a solution of equal quality, beside peers: python -m benchmarks.solve

Equal quality: `jaxscp.verify`, whose integrator is no solver's own, confirms the flight,
and its energy is within 0.5 % of the best that any of them found. The same discrete
problem, guess and scales for all: 100 nodes, held controls, limits at the nodes, energy
and data along the flow. Every solve has a new process with nothing compiled: "cold" is
from its start to its first solution, imports included, "warm" the median of more solves
in it. Needs the `bench` extra, Linux and, for OpenSCvx, an environment of its own.
"""

import argparse
import sys
import tempfile
from pathlib import Path

import jax
import jax.numpy as jnp

import jaxscp
from jaxscp import missions
from jaxscp._transcription import held

from . import peer
from .missions import BEST_KNOWN
from .records import add_json_option, table, write_report

MISSIONS = ("free-flight", "free-space-30MB-60dB", "urban-30MB-60dB")
EQUAL = 0.005
LOOSE = 1e-4
# Name to module and options; {cache} is a folder that starts empty with each mission.
OURS = {
    "jaxscp": ("solve_jaxscp", "--cache", "{cache}"),
    "jaxscp, cache filled": ("solve_jaxscp", "--cache", "{cache}"),
    f"jaxscp to {LOOSE:.0e}": ("solve_jaxscp", "--tolerance", str(LOOSE)),
}
IPOPT = {
    "IPOPT": ("ipopt_peer", "--graph", "expanded"),
    "IPOPT, scaled": ("ipopt_peer", "--graph", "expanded", "--scaled"),
}
OPENSCVX = {
    "OpenSCvx": ("openscvx_peer", "--weights", "default"),
    "OpenSCvx, its scales": ("openscvx_peer", "--scales", "limits"),
    "OpenSCvx, tuned": ("openscvx_peer", "--weights", "tuned"),
}
HEADINGS = (
    "solver | objective | gap, % | defect | limits broken | verified | cold, s | warm, s"
    " | iterations | equal quality | ended"
)


def run(python: str, way: tuple[str, ...], case: Path, options: list[str]) -> dict:
    """What a process of its own found, or the last line of its complaint."""
    module, *rest = way
    result = case.with_suffix(".result")
    try:
        return peer.run(module, case, result, *rest, *options, python=python)
    except ChildProcessError as failure:
        return {"status": str(failure), "found": None}


def judged(problem: jaxscp.OptimalControlProblem, guess, facts: dict) -> dict:
    """The facts with what the independent integrator says of the trajectory."""
    found = facts.pop("found")
    if found is None:
        return facts
    trajectory = jaxscp.Trajectory(
        guess.fractions,
        jnp.asarray(found["states"]),
        # IPOPT has no control for the last node.
        held(jnp.asarray(found["controls"]), guess.nodes),
        jnp.asarray(found["final_time"]),
    )
    checked = jaxscp.verify(problem, trajectory)
    # Of the range that each state covers, which its tolerance is the 1e-4th of.
    defect = 1e-4 * (checked.interval_errors / checked.interval_tolerances).max()
    broken = {name: str(each) for name, each in checked.node_violations.items()}
    return facts | {
        "objective": checked.objective,
        "final_time": found["final_time"],
        "verified": checked.verified,
        "defect": float(defect),
        "broken": broken,
    }


def measure(name: str, arguments: argparse.Namespace) -> list[dict]:
    """Every solver on one mission, jaxscp first: it writes the problem in numbers."""
    mission = missions.get(name)
    problem, guess = mission.problem(), mission.guess(100)
    limit = ["--limit", str(arguments.limit), "--repeats", "2"]
    ours = ["--mission", name, "--repeats", str(arguments.repeats)]
    groups = [(sys.executable, OURS, ours), (sys.executable, IPOPT, limit)]
    if arguments.openscvx_python:
        groups.append((arguments.openscvx_python, OPENSCVX, limit))
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        case, cache = Path(folder) / "case.json", str(Path(folder) / "cache")
        for python, ways, options in groups:
            for solver, way in ways.items():
                if solver not in arguments.solvers:
                    continue
                way = tuple(cache if part == "{cache}" else part for part in way)
                facts = judged(problem, guess, run(python, way, case, options))
                rows.append({"mission": name, "solver": solver, **facts})
                print(solver, facts["status"], file=sys.stderr, flush=True)
    return compared(rows, BEST_KNOWN[name])


def compared(rows: list[dict], best: float) -> list[dict]:
    """The rows with their distance from the best verified objective."""
    good = [row["objective"] for row in rows if row.get("verified")]
    best = min([best, *good])
    for row in rows:
        if "objective" in row:
            row["gap"] = row["objective"] / best - 1
            row["equal"] = row["verified"] and row["gap"] <= EQUAL
    return rows


def line(row: dict) -> str:
    """A row of the table, in Markdown."""
    if "objective" not in row:
        return f"| {row['solver']} |" + " |" * 8 + f" no | {row['status']} |"
    broken = "; ".join(f"{name} {by}" for name, by in row["broken"].items()) or "none"
    return (
        f"| {row['solver']} | {row['objective']:,.2f} | {100 * row['gap']:.3f}"
        f" | {row['defect']:.0e} | {broken} | {'yes' if row['verified'] else 'no'}"
        f" | {row['cold_seconds']:.1f} | {row['warm_seconds']:.2f} | {row['iterations']}"
        f" | {'yes' if row['equal'] else 'no'} | {row['status'].partition(':')[0]} |"
    )


def tables(report: dict) -> str:
    """What was measured, in Markdown, a table for each mission."""
    by_mission: dict[str, list[str]] = {}
    for row in report["rows"]:
        by_mission.setdefault(row["mission"], []).append(line(row))
    return "\n\n".join(
        f"{name}:\n\n{table(HEADINGS, lines)}" for name, lines in by_mission.items()
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--missions", nargs="*", default=list(MISSIONS), choices=MISSIONS)
    parser.add_argument(
        "--openscvx-python", help="an interpreter that has OpenSCvx 0.5.2"
    )
    every = [*OURS, *IPOPT, *OPENSCVX]
    parser.add_argument("--solvers", nargs="*", default=every, choices=every)
    parser.add_argument("--limit", type=float, default=120.0, help="of a peer [s]")
    parser.add_argument("--repeats", type=int, default=7, help="warm solves of jaxscp")
    add_json_option(parser, "solve")
    arguments = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    if not arguments.openscvx_python:
        print("OpenSCvx is left out: no --openscvx-python was given.\n")
    rows = []
    for name in arguments.missions:
        own = measure(name, arguments)
        print(tables({"rows": own}), "", sep="\n", flush=True)
        rows += own
        write_report(arguments.json, rows=rows)


if __name__ == "__main__":
    main()
