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
import numpy as np

from jaxscp import missions

from .discretization_figure import figure
from .discretization_table import HEADINGS, MIDDLE, line, tables
from .discretizer_case import Case
from .discretizers import DISCRETIZERS
from .discretizers_jax import jaxscp
from .discretizers_numpy import reference
from .discretizers_openscvx import OPENSCVX, openscvx, runs_of
from .median import median_seconds
from .records import FIGURES, add_json_option, table_head, versions_of, write_report

NODES = (25, 100, 1000, 10_000)
SUBSTEPS = (1, 2, 4, 8, 16)


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
    quick = "100 nodes, four substeps, no integrals; nothing stored, no figure"
    parser.add_argument("--quick", action="store_true", help=quick)
    add_json_option(parser, "discretization")
    parser.add_argument("--figure", type=Path, default=FIGURES / "discretization.png")
    arguments = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    if not arguments.openscvx_python:
        print("OpenSCvx is left out: no --openscvx-python was given.\n")
    print(table_head(HEADINGS))
    rows = rows_of(False, arguments)
    rows += [] if arguments.quick else rows_of(True, arguments)
    report = {
        "versions": versions_of("casadi", "diffrax", "scipy"),
        "discretization": rows,
        "batches": [] if arguments.quick else batches(arguments.mission),
    }
    print(tables(report))
    if not arguments.quick:
        write_report(arguments.json, **report)
        figure(report, arguments.figure)


if __name__ == "__main__":
    main()
