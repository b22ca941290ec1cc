"""README.md's tables and figures from stored results: python -m benchmarks.report

Every benchmark writes its numbers to `results/`. What stands between the two markers of
a benchmark in README.md is made from them, as the benchmark prints it.
"""

import argparse
import importlib
import json
from collections.abc import Sequence
from pathlib import Path
from types import ModuleType

from .records import FIGURES, RESULTS, origin

README = Path(__file__).with_name("README.md")
# Name of a result to the module that makes its tables: none needs the `bench` extra.
TABLES = {
    "missions": "missions",
    "methods": "methods",
    "ipopt": "ipopt",
    "random_missions": "random_missions",
    "growth": "growth",
    "gradients": "gradients",
    "discretization": "discretization_table",
    "solve": "solve",
    "breakdown": "breakdown",
    "showpieces": "showpieces",
    "sweep": "sweep",
}
# ... and to the module that draws its figure.
DRAWINGS = {
    "growth": "growth",
    "gradients": "gradients",
    "discretization": "discretization_figure",
}


def module(name: str) -> ModuleType:
    """One of the benchmarks', imported when it is needed."""
    return importlib.import_module(f".{name}", __package__)


def section(name: str, report: dict) -> str:
    """What stands between a benchmark's markers."""
    return f"{origin(report['facts'])}\n\n{module(TABLES[name]).tables(report)}"


def replaced(text: str, name: str, between: str) -> str:
    """The text with something else between a benchmark's markers.

    **Raises:** `ValueError` where it does not have both of them, once.
    """
    begin = f"<!-- {name}: made by python -m benchmarks.report -->"
    end = f"<!-- end of {name} -->"
    if (text.count(begin), text.count(end)) != (1, 1):
        raise ValueError(f"README.md needs, once each: {begin} and {end}")
    before, _, rest = text.partition(begin)
    _, _, after = rest.partition(end)
    return f"{before}{begin}\n\n{between}\n\n{end}{after}"


def stored(names: Sequence[str], results: Path) -> dict[str, dict]:
    """Those of the results that there are, by name; says which there are not."""
    reports = {}
    for name in names:
        path = results / f"{name}.json"
        if path.exists():
            reports[name] = json.loads(path.read_text())
        else:
            print(f"{name}: no result is stored, so its section stays as it is")
    return reports


def written(reports: dict[str, dict], readme: Path, *, check: bool) -> int:
    """Number of sections that changed, or would: a check writes nothing."""
    text, changes = readme.read_text(), 0
    for name, report in reports.items():
        new = replaced(text, name, section(name, report))
        if new != text:
            changes += 1
            print(f"{name}: {'is not what is stored' if check else 'written'}")
        text = new
    if changes and not check:
        readme.write_text(text)
    return changes


def draw(reports: dict[str, dict]) -> None:
    """The figures of those that have one."""
    for name in DRAWINGS.keys() & reports.keys():
        path = FIGURES / f"{name}.png"
        module(DRAWINGS[name]).figure(reports[name], path)
        print(f"{name}: drawn, {path.name}")


def main(
    arguments: Sequence[str] | None = None, readme: Path = README, results: Path = RESULTS
) -> int:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    known = ", ".join(TABLES)
    parser.add_argument("names", nargs="*", help=f"if not all of {known}")
    parser.add_argument(
        "--check", action="store_true", help="fail if README.md would change; no figures"
    )
    options = parser.parse_args(arguments)
    found = [path.stem for path in results.glob("*.json")]
    if unknown := {*options.names, *found} - TABLES.keys():
        parser.error(f"{', '.join(sorted(unknown))} is none of {known}")
    reports = stored(options.names or list(TABLES), results)
    changes = written(reports, readme, check=options.check)
    if options.check:
        return int(changes > 0)
    draw(reports)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
