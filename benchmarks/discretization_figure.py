"""The figure of `discretization.py`, from its numbers alone."""

from pathlib import Path

import matplotlib.pyplot as plt

from .discretization_table import MIDDLE
from .over_nodes import finish


def figure(report: dict, path: Path) -> None:
    """Error against time, and time against nodes."""
    rows = report["discretization"]
    names = dict.fromkeys(row["discretizer"] for row in rows)
    drawing, (precision, growth) = plt.subplots(1, 2, figsize=(11, 4.5), layout="tight")
    for color, name in enumerate(names):
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
