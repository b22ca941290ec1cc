"""Discretization, against others: python -m benchmarks.discretization

The quadrotor of the paper's missions under a zero-order hold: the state at the end of
every interval and its Jacobian by state, control and flight time, with and without the
integrals of cost and data. All of them in one run, each with its error against SciPy's
DOP853 at 1e-13 beside its time. Needs the `bench` extra and, for OpenSCvx, an environment
of its own.
"""

import argparse
import json
from pathlib import Path

import jax
import matplotlib.pyplot as plt
import numpy as np

from jaxscp import missions

from .discretizer_case import Case
from .discretizers import DISCRETIZERS
from .discretizers_jax import jaxscp
from .discretizers_numpy import reference
from .discretizers_openscvx import OPENSCVX, openscvx, runs_of
from .median import median_seconds
from .over_nodes import FIGURES, finish
from .report import table_head, write_report

NODES = (25, 100, 1000, 10_000)
SUBSTEPS = (1, 2, 4, 8, 16)
MIDDLE = (100, 4)


def case_of(name: str, nodes: int, gathers: bool) -> Case:
    """A mission's guess, shaken."""
    mission = missions.get(name)
    guess, draw = mission.guess(nodes), np.random.default_rng(0)
    states = guess.states + 0.1 * draw.normal(size=guess.states.shape)
    # Little torque: an interval may last for seconds.
    size = np.array([1.0, 1e-3, 1e-3, 1e-3])
    controls = guess.controls + size * draw.normal(size=guess.controls.shape)
    final_time = float(guess.final_time)
    plain = json.loads(mission.to_json())
    return Case(mission.problem(), plain, gathers, states, controls, final_time)


def error(found, truth: tuple[np.ndarray, np.ndarray]) -> float:
    """Largest one of values and Jacobian, each relative to its row's largest entry."""
    worst = 0.0
    for mine, right in zip(found, truth, strict=True):
        size = np.max(np.abs(right), axis=(0, *range(2, right.ndim)), keepdims=True)
        worst = max(worst, float(np.max(np.abs(mine - right) / size)))
    return worst


def printed(case: Case, facts: dict) -> dict:
    """A row of what was measured on a case, once it is printed."""
    which = "with" if case.gathers else "without"
    row = {"integrals": which, "nodes": case.intervals + 1, **facts}
    print(line(row), flush=True)
    return row


def measure(name: str, case: Case, substeps: int, truth) -> dict:
    """One discretizer, on one case."""
    prepared = DISCRETIZERS[name](case, substeps)
    found = None if truth is None else prepared.arranged(prepared.call())
    facts = {
        "discretizer": name,
        "substeps": substeps,
        "seconds": median_seconds(prepared.call),
        "error": None if found is None else error(found, truth),
        "compile_seconds": prepared.seconds,
    }
    return printed(case, facts)


def measure_openscvx(
    names: list[str], case: Case, substeps: tuple[int, ...], truth, arguments
) -> list[dict]:
    """All of OpenSCvx's on one case; none, and why, if its process fails."""
    runs, rows = runs_of(names, substeps), []
    if not runs or not arguments.openscvx_python:
        return rows
    options = (arguments.openscvx_python, arguments.limit, truth is not None)
    try:
        measured = openscvx(case, runs, *options)
    except ChildProcessError as failure:
        print(f"OpenSCvx is left out: {failure}")
        return rows
    if len(measured) < len(runs):
        print(f"OpenSCvx took too long: {len(runs) - len(measured)} rows are left out.")
    for facts in measured:
        found = facts.pop("values", None), facts.pop("jacobian", None)
        facts["error"] = None if truth is None else error(map(np.array, found), truth)
        rows.append(printed(case, facts))
    return rows


def rows_of(gathers: bool, arguments: argparse.Namespace) -> list[dict]:
    """Those asked for over substeps, then over nodes. OpenSCvx's compile for ten seconds
    each: fewer substeps, other nodes only with equal steps, integrals only at the middle.
    """
    nodes, middle = MIDDLE
    own = [each for each in arguments.discretizers if each in DISCRETIZERS]
    theirs = [each for each in arguments.discretizers if each in OPENSCVX]
    case = case_of(arguments.mission, nodes, gathers)
    truth, all_substeps = reference(case), (middle,) if arguments.quick else SUBSTEPS
    rows = [measure(each, case, n, truth) for n in all_substeps for each in own]
    few = (middle,) if gathers else all_substeps[::2]
    rows += measure_openscvx(theirs, case, few, truth, arguments)
    equal = [each for each in theirs if OPENSCVX[each][1] != "adaptive" and not gathers]
    for count in () if arguments.quick else NODES:
        if count == nodes:
            continue
        late = {row["discretizer"] for row in rows if too_slow(row, count, arguments)}
        case = case_of(arguments.mission, count, gathers)
        rows += [measure(each, case, middle, None) for each in own if each not in late]
        left = [each for each in equal if each not in late]
        rows += measure_openscvx(left, case, (middle,), None, arguments)
    return rows


def too_slow(row: dict, nodes: int, arguments: argparse.Namespace) -> bool:
    """Who takes too long for a call is not asked for more nodes."""
    return row["nodes"] < nodes and row["seconds"] > arguments.slow


def line(row: dict) -> str:
    """A row of the table, in Markdown."""
    wrong = "" if row["error"] is None else f"{row['error']:.0e}"
    cells = [row["integrals"], row["discretizer"], row["nodes"]]
    cells.append(row["substeps"] or "adaptive")
    cells += [f"{1e3 * row['seconds']:.3f}", wrong, f"{row['compile_seconds']:.1f}"]
    return f"| {' | '.join(map(str, cells))} |"


def ratios(rows: list[dict]) -> list[str]:
    """How much longer the others take at the middle, not what their errors are."""
    nodes, substeps = MIDDLE
    found = []
    for which in dict.fromkeys(row["integrals"] for row in rows):
        middle = [
            row
            for row in rows
            if (row["integrals"], row["nodes"]) == (which, nodes)
            and row["substeps"] in (substeps, None)
        ]
        own = [row["seconds"] for row in middle if row["discretizer"] == "jaxscp"]
        found += [
            f"{which} integrals: {row['discretizer']} takes "
            f"{row['seconds'] / own[0]:.2f} times jaxscp's time"
            for row in middle
            if own and row["discretizer"] != "jaxscp"
        ]
    return found


def batches(name: str) -> list[dict]:
    """Many trajectories at once, where there is an accelerator."""
    if jax.default_backend() == "cpu":
        print("No accelerator here: batches are not measured.")
        return []
    nodes, substeps = MIDDLE
    case, rows = case_of(name, nodes, True), []
    for count in (1, 10, 100, 1000, 10_000):
        prepared = jaxscp(case, substeps, batch=count)
        rows.append({"batch": count, "seconds": median_seconds(prepared.call)})
        print(f"batch of {count}: {1e3 * rows[-1]['seconds']:.3f} ms")
    return rows


def figure(rows: list[dict], path: Path) -> None:
    """Error against time, and time against nodes."""
    drawing, (precision, growth) = plt.subplots(1, 2, figsize=(11, 4.5), layout="tight")
    plain = [row for row in rows if row["integrals"] == "without"]
    for color, name in enumerate(dict.fromkeys(row["discretizer"] for row in plain)):
        own = [row for row in plain if row["discretizer"] == name]
        middle = [row for row in own if row["nodes"] == MIDDLE[0]]
        marker = "s" if name in OPENSCVX else "o"
        look = {"color": f"C{color}", "marker": marker, "label": name}
        errors = [row["error"] for row in middle]
        precision.loglog([1e3 * row["seconds"] for row in middle], errors, **look)
        at = [row for row in own if row["substeps"] in (MIDDLE[1], None)]
        over = sorted((row["nodes"], row["seconds"]) for row in at)
        growth.loglog([n for n, _ in over], [1e3 * s for _, s in over], **look)
    precision.set(xlabel="time [ms], 100 nodes", ylabel="largest relative error")
    growth.set(xlabel="nodes N, four substeps", ylabel="time [ms]")
    finish(drawing, path, legend=7)


def main() -> None:
    every = [*DISCRETIZERS, *OPENSCVX]
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--mission", default="free-space-30MB-60dB")
    parser.add_argument("--discretizers", nargs="*", default=every, choices=every)
    parser.add_argument(
        "--openscvx-python", help="an interpreter that has OpenSCvx 0.5.2"
    )
    parser.add_argument("--slow", type=float, default=0.3, help="seconds of a call")
    limit = "of OpenSCvx's process for a case [s]"
    parser.add_argument("--limit", type=float, default=150.0, help=limit)
    quick = "100 nodes, four substeps, no integrals; no figure"
    parser.add_argument("--quick", action="store_true", help=quick)
    parser.add_argument("--json", type=Path, help="where to write the numbers")
    parser.add_argument("--figure", type=Path, default=FIGURES / "discretization.png")
    arguments = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    if not arguments.openscvx_python:
        print("OpenSCvx is left out: no --openscvx-python was given.\n")
    headings = "integrals | discretizer | N | substeps | ms | error | compile, s"
    print(table_head(headings))
    rows = rows_of(False, arguments)
    rows += [] if arguments.quick else rows_of(True, arguments)
    print(*ratios(rows), sep="\n")
    in_batches = [] if arguments.quick else batches(arguments.mission)
    if arguments.json:
        write_report(arguments.json, discretization=rows, batches=in_batches)
    if not arguments.quick:
        figure(rows, arguments.figure)


if __name__ == "__main__":
    main()
