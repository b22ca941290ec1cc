"""OpenSCvx's examples solved by jaxscp, and by OpenSCvx: python -m benchmarks.showpieces

Brachistochrone, a drone past obstacles, powered landing with three and with six degrees
of freedom: the states, limits, numbers of nodes and guesses of the examples of OpenSCvx
0.5.2. jaxscp has no second-order cones; limits on norms are smooth path constraints. Its
intervals are all alike; OpenSCvx's have durations of their own, but for the
brachistochrone's. `jaxscp.verify` judges jaxscp's trajectory, between the nodes too;
OpenSCvx flies its own again: "flown" is what that ends with.

OpenSCvx runs its own files, in a Python that has it, and is left out without:

    --openscvx-python PATH --openscvx-examples FOLDER   (of its source distribution)
"""

import argparse
import os
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np

import jaxscp

from . import peer
from .records import add_json_option, facts_of, table, table_head, write_report
from .showpiece_landings import landing_3dof, landing_6dof
from .showpiece_problems import Showpiece, brachistochrone, drone
from .timing import timed_solve

HEADINGS = (
    "problem | solver | objective | flown | from the cycloid | iterations"
    " | converged | verified | first, s | warm, s"
)


# OpenSCvx's first-order hold is its own, which `verify` does not know.
VERDICTS = {True: "yes", False: "no", None: ""}


class Case(NamedTuple):
    """A showpiece and the example it is.

    - `states`: OpenSCvx's names.
    - `goal`: the last value of which state counts, and its sign.
    - `ways`: options of the peer by name.
    """

    make: Callable[[], Showpiece]
    example: str
    states: tuple[str, ...]
    goal: tuple[str, float]
    ways: dict[str, tuple[str, ...]] = {"OpenSCvx": ()}  # noqa: RUF012  (immutable)


MOTION, BODY = ("position", "velocity"), ("attitude", "angular_velocity")
SOONEST, HEAVIEST = ("time", 1.0), ("mass", -1.0)
CASES = {
    "brachistochrone": Case(
        brachistochrone, "abstract/brachistochrone.py", MOTION, SOONEST
    ),
    "drone": Case(
        drone,
        "drone/obstacle_avoidance.py",
        (*MOTION, *BODY),
        SOONEST,
    ),
    "landing-3dof": Case(
        landing_3dof,
        "rocket/3DoF_pdg.py",
        (*MOTION, "mass"),
        HEAVIEST,
        ways={"OpenSCvx": (), "OpenSCvx, 64 bits": ("--double",)},
    ),
    "landing-6dof": Case(
        landing_6dof,
        "rocket/6DoF_pdg.py",
        ("mass", *MOTION, *BODY),
        HEAVIEST,
        ways={"OpenSCvx, interpreted": ("--interpreted",)},
    ),
}


def ours(case: Case, repeats: int) -> dict:
    """How jaxscp ends, and whether limits hold between the nodes, too."""
    showpiece = case.make()
    problem, guess, discretization, _ = showpiece
    found = timed_solve(problem, guess, repeats, discretization=discretization)
    checked = jaxscp.verify(problem, found.result, between=True)
    facts = facts_of(found.result)
    return {
        **facts,
        "flown": checked.objective,
        "error": _error(facts["objective"], showpiece),
        "verified": checked.verified,
        "verification": str(checked),
        "cold_seconds": found.cold,
        "warm_seconds": found.warm,
        "final_time": float(found.result.trajectory.final_time),
        "load": os.getloadavg()[0],
    }


def theirs(case: Case, python: str, examples: Path, *options: str) -> dict:
    """How OpenSCvx ends, or the last line of why it did not."""
    with tempfile.TemporaryDirectory() as folder:
        files = examples / case.example, Path(folder) / "result.json"
        try:
            found = peer.run("showpieces_peer", *files, *options, python=python)
        except ChildProcessError as failure:
            return {"failed": str(failure)}
    (name, sign), showpiece, nodes = case.goal, case.make(), found.pop("nodes")
    objective = sign * nodes[name][-1][0]
    ends = {at: np.ravel(nodes[at][-1]) for at in case.states}
    return {
        **found,
        "objective": objective,
        "flown": sign * found["flown"][name][0],
        "error": _error(objective, showpiece),
        "misses": {at: _farthest(found["flown"][at] - end) for at, end in ends.items()},
    }


def _farthest(difference: np.ndarray) -> float:
    return float(np.max(np.abs(difference)))


def _error(objective: float, showpiece: Showpiece) -> float | None:
    return None if showpiece.known is None else objective / showpiece.known - 1


def line(name: str, solver: str, facts: dict) -> str:
    """A row of the table, in Markdown."""
    if "failed" in facts:
        return f"| {name} | {solver} | {facts['failed']} |" + " |" * 7
    error, steps = facts["error"], str(facts["iterations"])
    ended = "yes" if facts["converged"] else "no"
    if "polish_iterations" in facts:
        steps += f" + {facts['polish_iterations']}"
        ended += ", polished" if facts["polished"] else ""
    first = facts.get("cold_seconds", facts.get("initialize_seconds"))
    return (
        f"| {name} | {solver} | {facts['objective']:.6g} | {facts['flown']:.6g}"
        f" | {'' if error is None else f'{error:+.1e}'} | {steps} | {ended}"
        f" | {VERDICTS[facts.get('verified')]}"
        f" | {first:.1f} | {facts['warm_seconds']:.3f} |"
    )


def tables(report: dict) -> str:
    """What was measured, in Markdown."""
    lines = [
        line(row["problem"], solver, facts)
        for row in report["showpieces"]
        for solver, facts in row.items()
        if solver != "problem"
    ]
    return table(HEADINGS, lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--problems", nargs="*", default=list(CASES), choices=CASES)
    parser.add_argument("--repeats", type=int, default=5, help="warm solves of each")
    parser.add_argument("--openscvx-python", help="a Python with OpenSCvx")
    parser.add_argument("--openscvx-examples", type=Path, help="its folder `examples`")
    add_json_option(parser, "showpieces")
    arguments = parser.parse_args()
    python, examples = arguments.openscvx_python, arguments.openscvx_examples
    if (python is None) != (examples is None):
        parser.error("give --openscvx-python and --openscvx-examples, or neither.")
    jax.config.update("jax_enable_x64", True)
    print(table_head(HEADINGS))
    rows = []
    for name in arguments.problems:
        case = CASES[name]
        row = {"problem": name, "jaxscp": ours(case, arguments.repeats)}
        print(line(name, "jaxscp", row["jaxscp"]), flush=True)
        for way, options in case.ways.items() if python else ():
            row[way] = theirs(case, python, examples, *options)
            print(line(name, way, row[way]), flush=True)
        rows.append(row)
        write_report(arguments.json, showpieces=rows)


if __name__ == "__main__":
    main()
