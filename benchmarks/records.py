"""How every benchmark keeps its numbers, and what of them its tables show."""

import argparse
import datetime
import json
import os
import platform
import sys
import textwrap
from collections import defaultdict
from collections.abc import Iterable, Iterator
from importlib.metadata import version
from pathlib import Path

import jaxscp

RESULTS = Path(__file__).parent / "results"
FIGURES = Path(__file__).parent / "figures"
PACKAGES = ("jax", "jaxlib", "piqp", "numpy", "equinox")
# Of a line in README.md.
WIDTH = 90

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


def table(headings: str, lines: Iterable[str]) -> str:
    """A whole table in Markdown, from its lines."""
    return "\n".join([table_head(headings), *lines])


def add_json_option(parser: argparse.ArgumentParser, name: str) -> None:
    """Where a benchmark writes its numbers: by default to what README.md is made from."""
    parser.add_argument(
        "--json",
        type=Path,
        default=RESULTS / f"{name}.json",
        help="where to write the numbers, if not where README.md is made from",
    )


def write_report(path: Path, **numbers) -> None:
    """Numbers as JSON, with what gave them.

    An entry `versions`, of the numbers or of a row of them, tells of further packages.
    """
    versions = _versions([versions_of(*PACKAGES), *_told(numbers)])
    facts = circumstances() | {"arguments": sys.argv[1:], "versions": versions}
    path.parent.mkdir(exist_ok=True)
    path.write_text(json.dumps({"facts": facts, **numbers}, indent=1) + "\n")


def circumstances() -> dict:
    """When and on what machine; its load over 1, 5 and 15 minutes."""
    return {
        "date": datetime.datetime.now().astimezone().isoformat(timespec="minutes"),
        "processor": _processor(),
        "cores": os.cpu_count(),
        "load": [round(load, 2) for load in os.getloadavg()],
        "python": platform.python_version(),
    }


def versions_of(*packages: str) -> dict[str, str]:
    """Of packages that are installed here."""
    return {package: version(package) for package in packages}


def _told(numbers) -> Iterator[dict[str, str]]:
    """All entries `versions`, however deep."""
    if isinstance(numbers, dict):
        for name, entry in numbers.items():
            yield from [entry] if name == "versions" else _told(entry)
    elif isinstance(numbers, list):
        for entry in numbers:
            yield from _told(entry)


def _versions(told: Iterable[dict[str, str]]) -> dict[str, str]:
    """All of them together: interpreters may have different ones."""
    found = defaultdict(set)
    for versions in told:
        for package, each in versions.items():
            found[package].add(each)
    return {package: " and ".join(sorted(each)) for package, each in found.items()}


def _processor() -> str:
    """The model's name, where Linux tells it."""
    cpus = Path("/proc/cpuinfo")
    for line in cpus.read_text().splitlines() if cpus.exists() else ():
        if line.startswith("model name"):
            return line.partition(":")[2].strip()
    return platform.machine()


def origin(facts: dict) -> str:
    """When and where numbers were measured, and with what, as a paragraph."""
    load = f"load {min(facts['load']):.1f} to {max(facts['load']):.1f}"
    versions = [f"{package} {each}" for package, each in facts["versions"].items()]
    parts = [facts["date"][:10], facts["processor"], f"{facts['cores']} cores", load]
    parts += [f"Python {facts['python']}", *versions]
    return textwrap.fill(f"{', '.join(parts)}:", WIDTH, break_on_hyphens=False)
