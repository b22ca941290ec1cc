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
import matplotlib.pyplot as plt
import numpy as np

from jaxscp import missions

from .discretizer_case import Case, Prepared
from .discretizers import DISCRETIZERS
from .discretizers_jax import jaxscp
from .discretizers_numpy import reference
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


def line(row: dict) -> str:
    """A row of the table, in Markdown."""
    wrong = "" if row["error"] is None else f"{row['error']:.0e}"
    cells = [row["integrals"], row["discretizer"], row["nodes"], row["substeps"]]
    cells += [f"{1e3 * row['seconds']:.3f}", wrong, f"{row['compile_seconds']:.1f}"]
    return f"| {' | '.join(map(str, cells))} |"


def ratios(rows: list[dict]) -> list[str]:
    """How much longer the others take at the middle."""
    nodes, substeps = MIDDLE
    found = []
    for which in dict.fromkeys(row["integrals"] for row in rows):
        middle = [
            row
            for row in rows
            if (row["integrals"], row["nodes"], row["substeps"])
            == (which, nodes, substeps)
        ]
        own = next(row["seconds"] for row in middle if row["discretizer"] == "jaxscp")
        found += [
            f"{which} integrals: {row['discretizer']} takes "
            f"{row['seconds'] / own:.2f} times jaxscp's time"
            for row in middle
            if row["discretizer"] != "jaxscp"
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
    for color, name in enumerate(DISCRETIZERS):
        own = [
            r for r in rows if r["discretizer"] == name and r["integrals"] == "without"
        ]
        middle = [row for row in own if row["nodes"] == MIDDLE[0]]
        look = {"color": f"C{color}", "marker": "o", "label": name}
        errors = [row["error"] for row in middle]
        precision.loglog([1e3 * row["seconds"] for row in middle], errors, **look)
        over = sorted((r["nodes"], r["seconds"]) for r in own if r["substeps"] == 4)
        growth.loglog([n for n, _ in over], [1e3 * s for _, s in over], **look)
    precision.set(xlabel="time [ms], 100 nodes", ylabel="largest relative error")
    growth.set(xlabel="nodes N, four substeps", ylabel="time [ms]")
    finish(drawing, path, legend=7)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--mission", default="free-space-30MB-60dB")
    parser.add_argument("--slow", type=float, default=0.3, help="seconds of a call")
    parser.add_argument("--json", type=Path, help="where to write the numbers")
    parser.add_argument("--figure", type=Path, default=FIGURES / "discretization.png")
    arguments = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    headings = "integrals | discretizer | N | substeps | ms | error | compile, s"
    print(table_head(headings))
    rows = rows_of(arguments.mission, False, arguments.slow)
    rows += rows_of(arguments.mission, True, arguments.slow)
    print(*ratios(rows), sep="\n")
    in_batches = batches(arguments.mission)
    if arguments.json:
        write_report(arguments.json, discretization=rows, batches=in_batches)
    figure(rows, arguments.figure)


if __name__ == "__main__":
    main()
