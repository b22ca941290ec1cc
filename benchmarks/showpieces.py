"""OpenSCvx's examples solved by jaxscp, and by OpenSCvx: python -m benchmarks.showpieces

Brachistochrone, a drone past obstacles, powered landing with three and with six degrees
of freedom: the same states, limits, numbers of nodes and guesses as in the examples of
OpenSCvx 0.5.2. jaxscp has no second-order cones; limits on norms are smooth path
constraints. Its intervals are all alike, OpenSCvx's have durations of their own unless
"alike" says otherwise.

OpenSCvx runs its own files, in a Python that has it, and is left out without:

    --openscvx-python PATH --openscvx-examples FOLDER   (of its source distribution)
"""

import argparse
import json
import os
import subprocess
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import jax

import jaxscp

from .report import facts_of, write_report
from .showpiece_landings import landing_3dof, landing_6dof
from .showpiece_problems import Showpiece, brachistochrone, drone
from .timing import timed_solve

PEER = Path(__file__).with_name("showpieces_peer.py")
HEADINGS = (
    "problem | solver | objective | at the nodes | from the optimum | iterations"
    " | converged | confirmed | before, s | solve, s"
)


class Case(NamedTuple):
    """A showpiece and the example it is.

    - `measure`: what is minimized, of OpenSCvx's final values by name.
    """

    make: Callable[[], Showpiece]
    example: str
    measure: Callable[[dict], float]


CASES = {
    "brachistochrone": Case(
        brachistochrone, "abstract/brachistochrone.py", lambda last: last["time"][0]
    ),
    "drone": Case(drone, "drone/obstacle_avoidance.py", lambda last: last["time"][0]),
    "landing-3dof": Case(
        landing_3dof, "rocket/3DoF_pdg.py", lambda last: -last["mass"][0]
    ),
    "landing-6dof": Case(
        landing_6dof, "rocket/6DoF_pdg.py", lambda last: -last["mass"][0]
    ),
}


def ours(case: Case, repeats: int) -> dict:
    """How jaxscp ends, and whether limits hold between the nodes, too."""
    problem, guess, discretization, known = case.make()
    found = timed_solve(problem, guess, repeats, discretization=discretization)
    checked = jaxscp.verify(problem, found.result, between=True)
    facts = facts_of(found.result)
    return {
        **facts,
        "error": None if known is None else facts["objective"] / known - 1,
        "flown": checked.objective,
        "verified": checked.verified,
        "cold_seconds": found.cold,
        "warm_seconds": found.warm,
        "final_time": float(found.result.trajectory.final_time),
        "load": os.getloadavg()[0],
    }


def theirs(case: Case, python: Path, examples: Path, *options: str) -> dict:
    """How OpenSCvx ends, or the last line of why it did not."""
    with tempfile.TemporaryDirectory() as folder:
        result = Path(folder) / "result.json"
        command = [str(python), str(PEER), str(examples / case.example), str(result)]
        ended = subprocess.run(
            [*command, *options],
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            cwd=folder,
        )
        if not result.exists():
            lines = ended.stderr.strip().splitlines() or ["nothing said"]
            return {"failed": lines[-1]}
        found = json.loads(result.read_text())
    known = case.make().known
    flown, nodes = (case.measure(found[ends]) for ends in ("flown", "nodes"))
    return {
        **found,
        "objective": nodes,
        "flown": flown,
        "error": None if known is None else nodes / known - 1,
        "load": os.getloadavg()[0],
    }


def our_line(name: str, facts: dict) -> str:
    """A row of the table, in Markdown."""
    ended = "polished" if facts["polished"] else "roughly"
    return (
        f"| {name} | jaxscp | {facts['flown']:.6g} | {facts['objective']:.6g}"
        f" | {_share(facts['error'])}"
        f" | {facts['iterations']} + {facts['polish_iterations']}"
        f" | {ended if facts['converged'] else 'no'}"
        f" | {'yes' if facts['verified'] else 'no'}"
        f" | {facts['cold_seconds']:.1f} | {facts['warm_seconds']:.3f} |"
    )


def their_line(name: str, solver: str, facts: dict) -> str:
    """A row of the table, in Markdown."""
    if "failed" in facts:
        return f"| {name} | {solver} | {facts['failed']} |" + " |" * 7
    return (
        f"| {name} | {solver} | {facts['flown']:.6g} | {facts['objective']:.6g}"
        f" | {_share(facts['error'])} | {facts['iterations']}"
        f" | {'yes' if facts['converged'] else 'no'} | "
        f" | {facts['initialize_seconds']:.1f} | {facts['solve_seconds']:.3f} |"
    )


def _share(error: float | None) -> str:
    return "" if error is None else f"{error:+.1e}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--problems", nargs="*", default=list(CASES), choices=CASES)
    parser.add_argument("--repeats", type=int, default=5, help="warm solves of each")
    parser.add_argument("--openscvx-python", type=Path, help="a Python with OpenSCvx")
    parser.add_argument("--openscvx-examples", type=Path, help="its folder `examples`")
    parser.add_argument("--json", type=Path, help="where to write the numbers")
    arguments = parser.parse_args()
    python, examples = arguments.openscvx_python, arguments.openscvx_examples
    if (python is None) != (examples is None):
        parser.error("give --openscvx-python and --openscvx-examples, or neither.")
    jax.config.update("jax_enable_x64", True)
    print(f"| {HEADINGS} |")
    print("|---" * (HEADINGS.count("|") + 1) + "|")
    rows = []
    for name in arguments.problems:
        case = CASES[name]
        row = {"problem": name, "jaxscp": ours(case, arguments.repeats)}
        print(our_line(name, row["jaxscp"]), flush=True)
        if python is not None:
            row["openscvx"] = theirs(case, python, examples.resolve())
            print(their_line(name, "OpenSCvx", row["openscvx"]), flush=True)
        rows.append(row)
        if arguments.json:
            write_report(arguments.json, showpieces=rows)


if __name__ == "__main__":
    main()
