"""The figure of `discretization.py`, from its numbers alone."""

from pathlib import Path

import matplotlib.pyplot as plt

from .discretization_table import MIDDLE
from .discretizers_openscvx import OPENSCVX
from .over_nodes import finish


def figure(report: dict, path: Path) -> None:
    """Error against time, and time against nodes."""
    drawing, (precision, growth) = plt.subplots(1, 2, figsize=(11, 4.5), layout="tight")
    plain = [row for row in report["discretization"] if row["integrals"] == "without"]
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
