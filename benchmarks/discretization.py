"""Discretization, against others: python -m benchmarks.discretization

The quadrotor of the paper's missions under a zero-order hold: the state at the end of
every interval and its Jacobian by state, control and flight time, with and without the
integrals of cost and data. All of them in one run, each with its error against SciPy's
DOP853 at 1e-13 beside its time.
"""

import argparse
import json
from pathlib import Path

import jax
import numpy as np

from jaxscp import missions

from .discretization_figure import figure
from .discretization_table import HEADINGS, MIDDLE, line, tables
from .discretizers import DISCRETIZERS, Case, Prepared, jaxscp, reference
from .records import FIGURES, add_json_option, table_head, versions_of, write_report
from .timing import median_seconds

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


def error(prepared: Prepared, truth: tuple[np.ndarray, np.ndarray]) -> float:
    """Largest one of values and Jacobian, each relative to its row's largest entry."""
    found = prepared.arranged(prepared.call())
    worst = 0.0
    for mine, right in zip(found, truth, strict=True):
        size = np.max(np.abs(right), axis=(0, *range(2, right.ndim)), keepdims=True)
        worst = max(worst, float(np.max(np.abs(mine - right) / size)))
    return worst


def measure(name: str, case: Case, substeps: int, truth) -> dict:
    """One discretizer, on one case."""
    prepared = DISCRETIZERS[name](case, substeps)
    wrong = error(prepared, truth) if truth is not None else None
    return {
        "discretizer": name,
        "integrals": "with" if case.gathers else "without",
        "nodes": case.intervals + 1,
        "substeps": substeps,
        "seconds": median_seconds(prepared.call),
        "error": wrong,
        "compile_seconds": prepared.seconds,
    }


def rows_of(name: str, gathers: bool, slow: float) -> list[dict]:
    """All discretizers over substeps, then over nodes.

    **Arguments:**

    - `slow`: who takes longer for a call is not asked for more nodes.
    """
    nodes, middle = MIDDLE
    case = case_of(name, nodes, gathers)
    truth, rows = reference(case), []
    for substeps in SUBSTEPS:
        for each in DISCRETIZERS:
            rows.append(measure(each, case, substeps, truth))
            print(line(rows[-1]), flush=True)
    for each in DISCRETIZERS:
        for count in NODES:
            mine = [r for r in rows if r["discretizer"] == each and r["nodes"] < count]
            if count == nodes or any(row["seconds"] > slow for row in mine):
                continue
            rows.append(measure(each, case_of(name, count, gathers), middle, None))
            print(line(rows[-1]), flush=True)
    return rows


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
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--mission", default="free-space-30MB-60dB")
    parser.add_argument("--slow", type=float, default=0.3, help="seconds of a call")
    add_json_option(parser, "discretization")
    parser.add_argument("--figure", type=Path, default=FIGURES / "discretization.png")
    arguments = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    print(table_head(HEADINGS))
    rows = rows_of(arguments.mission, False, arguments.slow)
    rows += rows_of(arguments.mission, True, arguments.slow)
    report = {
        "versions": versions_of("casadi", "diffrax", "scipy"),
        "discretization": rows,
        "batches": batches(arguments.mission),
    }
    write_report(arguments.json, **report)
    print(tables(report))
    figure(report, arguments.figure)


if __name__ == "__main__":
    main()
