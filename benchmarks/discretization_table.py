"""The tables of `discretization.py`, from its numbers alone: that needs no peer."""

import math

from .records import table

# Nodes and substeps, of which one changes while the other stays.
MIDDLE = (100, 4)
HEADINGS = "integrals | discretizer | N | substeps | ms | error | compile, s"


def line(row: dict) -> str:
    """A row for the eye while the benchmark runs, in Markdown."""
    steps = row["substeps"] or "adaptive"
    where = [row["integrals"], row["discretizer"], row["nodes"], steps]
    cells = [milliseconds(row), wrong(row), f"{row['compile_seconds']:.1f}"]
    return f"| {' | '.join(map(str, where + cells))} |"


def milliseconds(row: dict) -> str:
    return f"{1e3 * row['seconds']:,.3f}"


def wrong(row: dict) -> str:
    """The error, where it was measured."""
    return "" if row["error"] is None else f"{row['error']:.0e}"


def tables(report: dict) -> str:
    """What was measured, in Markdown: over substeps, over nodes, in batches."""
    rows, found = report["discretization"], []
    for which in dict.fromkeys(row["integrals"] for row in rows):
        own = [row for row in rows if row["integrals"] == which]
        found += [substeps_table(which, own), nodes_table(which, own)]
    if report["batches"]:
        found.append(batches_table(report["batches"]))
    return "\n\n".join(found)


def substeps_table(which: str, rows: list[dict]) -> str:
    """Milliseconds of a call with the error, by discretizer, at the middle of nodes."""
    nodes, middle = MIDDLE
    rows = [row for row in rows if row["nodes"] == nodes]
    # Adaptive steps have no number, and come last.
    counts = sorted({row["substeps"] for row in rows}, key=lambda n: n or math.inf)
    ours = {row["substeps"]: row for row in rows if row["discretizer"] == "jaxscp"}
    lines = []
    for name in dict.fromkeys(row["discretizer"] for row in rows):
        own = {row["substeps"]: row for row in rows if row["discretizer"] == name}
        cells = [
            f"{milliseconds(own[n])} ({wrong(own[n])})" if n in own else ""
            for n in counts
        ]
        compiling = [row["compile_seconds"] for row in own.values()]
        cells.append(f"{min(compiling):.1f} to {max(compiling):.1f}")
        cells.append(_ratio(own.get(middle, own.get(None)), ours.get(middle)))
        lines.append(f"| {name} | {' | '.join(cells)} |")
    columns = " | ".join(str(count or "adaptive") for count in counts)
    ends = f"compile, s | times jaxscp's with {middle}"
    title = f"N = {nodes}, {which} integrals, ms (error) by substeps:"
    return f"{title}\n\n{table(f'discretizer | {columns} | {ends}', lines)}"


def _ratio(row: dict | None, ours: dict | None) -> str:
    """To jaxscp's time, where both were measured, whatever their errors are."""
    return f"{row['seconds'] / ours['seconds']:.2f}" if row and ours else ""


def nodes_table(which: str, rows: list[dict]) -> str:
    """Milliseconds of a call by discretizer; some were not asked for many nodes."""
    rows = [row for row in rows if row["substeps"] == MIDDLE[1]]
    counts = sorted({row["nodes"] for row in rows})
    lines = []
    for name in dict.fromkeys(row["discretizer"] for row in rows):
        own = {row["nodes"]: row for row in rows if row["discretizer"] == name}
        cells = [milliseconds(own[n]) if n in own else "" for n in counts]
        lines.append(f"| {name} | {' | '.join(cells)} |")
    columns = " | ".join(map(str, counts))
    title = f"{MIDDLE[1]} substeps, {which} integrals, ms by number of nodes:"
    return f"{title}\n\n{table(f'discretizer | {columns}', lines)}"


def batches_table(rows: list[dict]) -> str:
    """Milliseconds of a call for many trajectories at once."""
    lines = [f"| {row['batch']} | {milliseconds(row)} |" for row in rows]
    return f"On an accelerator:\n\n{table('batch | ms', lines)}"
