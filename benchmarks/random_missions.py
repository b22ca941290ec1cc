"""How many random missions are solved: python -m benchmarks.random_missions

Each of `cities.random_mission` is solved with default settings from its own guess, and
judged by `jaxscp.verify`. All can be flown. Where that fails, `missions.solve` is asked,
which has further guesses: it is told apart. Those of one structure (number of buildings,
with data or without) share a compiled program, of which the times are without. They are
processor time, which other programs on the machine hardly change.
"""

import argparse
import time

import jax
import numpy as np

import jaxscp
from jaxscp import missions

from .cities import random_mission
from .records import add_json_option, facts_of, table, write_report

COLUMNS = (
    "data | buildings | missions | converged and verified | iterations | polish | CPU s"
)


def solve(mission: missions.Mission, arguments: argparse.Namespace):
    """The solution, and seconds of the processor."""
    begun = time.process_time()
    # The shortest way alone: `missions.solve` would try those past the buildings, too.
    solution = jaxscp.solve(
        mission.problem(),
        mission.guess(arguments.nodes),
        discretization=jaxscp.Discretization(
            between=missions.ENFORCED[arguments.enforce]
        ),
        throw=False,
    )
    jax.block_until_ready(solution)
    return solution, time.process_time() - begun


def check(
    mission: missions.Mission, solution: jaxscp.Solution, arguments: argparse.Namespace
) -> jaxscp.Verification:
    """The solution flown again, and its limits checked where they were enforced."""
    between = arguments.enforce == "between"
    return jaxscp.verify(mission.problem(), solution, between=between)


def with_further_guesses(
    mission: missions.Mission, arguments: argparse.Namespace
) -> bool:
    """Whether `missions.solve` finds a solution that holds."""
    options = {"enforce": arguments.enforce, "nodes": arguments.nodes}
    solution = missions.solve(mission, throw=False, **options)
    return bool(solution.converged) and check(mission, solution, arguments).verified


def measure(index: int, compiled: set, arguments: argparse.Namespace) -> dict:
    """Solve one mission, once more if its structure was new, and verify it."""
    mission = random_mission(arguments.seed, index)
    solution, seconds = solve(mission, arguments)
    structure = (mission.obstacles.count, mission.data_required is not None)
    if structure not in compiled:
        compiled.add(structure)
        solution, seconds = solve(mission, arguments)
    patient = (
        None if bool(solution.converged) else with_further_guesses(mission, arguments)
    )
    verification, facts = check(mission, solution, arguments), facts_of(solution)
    if facts["polished"]:
        # Two hundred rows stay small so.
        facts["status"] = None
    return {
        "index": index,
        "buildings": mission.obstacles.count,
        "megabytes": None
        if mission.data_required is None
        else float(mission.data_required) / missions.BITS_PER_MEGABYTE,
        **facts,
        "verified": verification.verified,
        "verification": None if verification.verified else str(verification),
        "final_time": float(solution.trajectory.final_time),
        "cpu_seconds": seconds,
        "with_further_guesses": patient,
    }


def successes(rows: list[dict]) -> list[dict]:
    """Those that are converged and verified."""
    return [row for row in rows if row["converged"] and row["verified"]]


def summary(rows: list[dict]) -> dict:
    """Counts, and the middle, the slowest tenth and the worst of what it took."""
    solved = successes(rows)
    spread = {
        what: dict(
            zip(
                ("median", "90 %", "max"),
                np.quantile([row[what] for row in rows], (0.5, 0.9, 1.0)).tolist(),
                strict=True,
            )
        )
        for what in ("iterations", "polish_iterations", "subproblems", "cpu_seconds")
    }
    return {
        "missions": len(rows),
        "converged_and_verified": len(solved),
        "of_those_polished": sum(row["polished"] for row in solved),
        "converged_not_verified": sum(
            row["converged"] and not row["verified"] for row in rows
        ),
        "of_the_others_with_further_guesses": sum(
            bool(row["with_further_guesses"]) for row in rows
        ),
        "not_converged": [row["index"] for row in rows if not row["converged"]],
        **spread,
    }


def line(row: dict) -> str:
    """A row for the eye; what went wrong with it in full."""
    data = "no data" if row["megabytes"] is None else f"{row['megabytes']:.0f} MB"
    text = (
        f"{row['index']:4d}  {row['buildings']} buildings, {data:8}"
        f"{row['objective']:11.1f} N^2 s  {row['iterations']:3d}"
        f" + {row['polish_iterations']:3d} to {row['optimality']:.0e}"
        f"  {row['cpu_seconds']:6.2f} s  converged: {row['converged']}"
        f"  verified: {row['verified']}"
    )
    wrong = [] if row["polished"] else [row["status"]]
    if row["converged"] and not row["verified"]:
        wrong.append(row["verification"])
    return "\n".join([text, *wrong])


def group_line(data: bool, buildings: int, rows: list[dict]) -> str:
    """A row of the table, in Markdown: median and largest of those solved."""
    solved = successes(rows)

    def spread(what: str, form: str) -> str:
        values = [row[what] for row in solved]
        if not values:
            return ""
        return f"{np.median(values):{form}}, {np.max(values):{form}}"

    return (
        f"| {'yes' if data else 'no'} | {buildings} | {len(rows)} | {len(solved)}"
        f" | {spread('iterations', '.0f')} | {spread('polish_iterations', '.0f')}"
        f" | {spread('cpu_seconds', '.1f')} |"
    )


def tables(report: dict) -> str:
    """What was measured, in Markdown, by structure."""
    groups: dict[tuple[bool, int], list[dict]] = {}
    for row in report["missions"]:
        structure = (row["megabytes"] is not None, row["buildings"])
        groups.setdefault(structure, []).append(row)
    return table(COLUMNS, [group_line(*key, groups[key]) for key in sorted(groups)])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--count", type=int, default=200)
    parser.add_argument("--only", type=int, nargs="*", help="numbers of single missions")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--enforce", choices=("nodes", "between"), default="nodes")
    parser.add_argument("--nodes", type=int, default=100)
    add_json_option(parser, "random_missions")
    arguments = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    rows, compiled = [], set()
    for index in arguments.only or range(arguments.count):
        rows.append(measure(index, compiled, arguments))
        print(line(rows[-1]), flush=True)
        # As it goes: a run takes a quarter of an hour.
        settings = {"seed": arguments.seed, "enforce": arguments.enforce}
        write_report(arguments.json, **settings, summary=summary(rows), missions=rows)
    for what, value in summary(rows).items():
        print(f"{what}: {value}")
    print(tables({"missions": rows}))


if __name__ == "__main__":
    main()
