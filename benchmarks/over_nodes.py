"""Measurements of missions over the number of nodes: command line, table and figure."""

import argparse
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import jax
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from .records import FIGURES, add_json_option, table_head, write_report

MISSIONS = ("free-flight", "free-space-30MB-60dB")


class Measured(NamedTuple):
    """Rows of each mission, as they are stored, and where their figure is to be drawn."""

    report: dict
    figure: Path


def measured(
    name: str,
    description: str,
    nodes: Sequence[int],
    headings: str,
    measure: Callable[[str, int, int], dict],
    line: Callable[[dict], str],
) -> Measured:
    """Measure what the command line asks for, and print a row at a time.

    **Arguments:**

    - `name`: of the result and the figure. `description`: of the benchmark, whose first
        line counts.
    - `nodes`: numbers of nodes, if none are asked for.
    - `headings`: of the table, between its outer bars. `line`: a row of it.
    - `measure`: of a mission's name, a number of nodes and a number of repeats.
    """
    figure = FIGURES / f"{name}.png"
    parser = argparse.ArgumentParser(description=description.partition("\n")[0])
    parser.add_argument("--missions", nargs="*", default=list(MISSIONS))
    parser.add_argument("--nodes", type=int, nargs="*", default=list(nodes))
    parser.add_argument("--repeats", type=int, default=3)
    add_json_option(parser, name)
    parser.add_argument("--figure", type=Path, help="where to draw it", default=figure)
    arguments = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    print(table_head(headings))
    rows: dict[str, list[dict]] = {mission: [] for mission in arguments.missions}
    for count in arguments.nodes:
        for mission, own in rows.items():
            own.append(measure(mission, count, arguments.repeats))
            print(line(own[-1]), flush=True)
        write_report(arguments.json, missions=rows)
    return Measured({"missions": rows}, arguments.figure)


def in_order(report: dict) -> list[dict]:
    """Rows of all missions as they were measured, few nodes first."""
    rows = [row for own in report["missions"].values() for row in own]
    return sorted(rows, key=lambda row: row["nodes"])


def exponent(rows: list[dict], of: str) -> float:
    """The power of the number of nodes that fits best."""
    nodes, values = ([row[what] for row in rows] for what in ("nodes", of))
    return float(np.polyfit(np.log(nodes), np.log(values), 1)[0])


def finish(drawing: Figure, path: Path, legend: int) -> None:
    """Add legends, of so many points, and grids; save and close the figure."""
    for axes in drawing.axes:
        place = {"loc": "lower left", "bbox_to_anchor": (0.0, 1.0)}
        axes.legend(fontsize=legend, ncols=2, frameon=False, **place)
        axes.grid(alpha=0.3)
    path.parent.mkdir(exist_ok=True)
    drawing.savefig(path, dpi=120)
    plt.close(drawing)
