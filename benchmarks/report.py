"""How every benchmark writes its numbers."""

import json
import os
import platform
from importlib.metadata import version
from pathlib import Path

import jaxscp

PACKAGES = ("jax", "jaxlib", "piqp", "numpy", "equinox")

# Of the cells of a Markdown table that every solve fills.
HEADINGS = "objective | iterations + polish | QPs | residual"


def facts_of(solution: jaxscp.Solution) -> dict:
    """How a solve ended and how many steps it took."""
    statistics = solution.statistics
    return {
        "status": solution.message,
        "converged": bool(solution.converged),
        "polished": bool(solution.polished),
        "objective": float(solution.objective),
        "optimality": float(solution.optimality),
        "iterations": int(statistics.iterations),
        "polish_iterations": int(statistics.polish_iterations),
        "subproblems": int(statistics.subproblems),
    }


def cells(facts: dict) -> str:
    """What stands below `HEADINGS`."""
    return (
        f"{facts['objective']:,.2f}"
        f" | {facts['iterations']} + {facts['polish_iterations']}"
        f" | {facts['subproblems']} | {facts['optimality']:.0e}"
    )


def table_head(headings: str) -> str:
    """The first two lines of a table in Markdown, from what is between its outer bars."""
    return f"| {headings} |\n{'|---' * (headings.count('|') + 1)}|"


def write_report(path: Path, **numbers) -> None:
    """Numbers as JSON, with the machine and the versions that gave them."""
    facts = {
        "machine": platform.machine(),
        "cores": os.cpu_count(),
        "python": platform.python_version(),
        "versions": {package: version(package) for package in PACKAGES},
    }
    path.write_text(json.dumps({"facts": facts, **numbers}, indent=2) + "\n")
