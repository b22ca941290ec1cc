"""benchmarks/README.md shows what the benchmarks have stored."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
if not (ROOT / "benchmarks").is_dir():
    pytest.skip("a source distribution has no benchmarks", allow_module_level=True)
sys.path.append(str(ROOT))

from benchmarks import records, report  # noqa: E402  (no part of the package)

STORED = sorted(records.RESULTS.glob("*.json"))
SOLVED = {
    "mission": "free-flight",
    "objective": 24380.59,
    "iterations": 2,
    "polish_iterations": 14,
    "subproblems": 3,
    "optimality": 5e-9,
    "converged": True,
    "polished": True,
    "verified": True,
}


def of_discretizer(name, nodes, substeps, milliseconds, error):
    return {
        "integrals": "without",
        "discretizer": name,
        "nodes": nodes,
        "substeps": substeps,
        "seconds": 1e-3 * milliseconds,
        "error": error,
        "compile_seconds": 2.0,
    }


# Numbers of a benchmark, and a line that its tables have.
SAMPLES = {
    "methods": (
        {"methods": [SOLVED | {"method": "default", "warm_seconds": 0.504}]},
        "| free-flight | default | 24,380.59 | 2 + 14 | 3 | 5e-09 | 0.50 | yes |",
    ),
    "random_missions": (
        {
            "missions": [
                {**SOLVED, "buildings": 2, "megabytes": None, "cpu_seconds": 1.0},
                {**SOLVED, "buildings": 2, "megabytes": None, "cpu_seconds": 3.0},
                SOLVED | {"verified": False, "buildings": 2, "megabytes": None},
            ]
        },
        "| no | 2 | 3 | 2 | 2, 2 | 14, 14 | 2.0, 3.0 |",
    ),
    "discretization": (
        {
            "discretization": [
                of_discretizer("jaxscp", 100, 4, 2.0, 8e-5),
                of_discretizer("NumPy", 100, 4, 1500.0, 8e-5),
                of_discretizer("jaxscp", 1000, 4, 20.0, None),
            ],
            "batches": [],
        },
        "| NumPy | 1,500.000 (8e-05) | 2.0 to 2.0 | 750.00 |",
    ),
}


def table_rows(text):
    """Lines of each table, first its head."""
    blocks = text.split("\n\n")
    return [block.splitlines() for block in blocks if block.startswith("|")]


def test_the_readme_shows_what_is_stored():
    assert report.main(["--check"]) == 0


def test_the_readme_has_a_section_for_every_benchmark():
    text = report.README.read_text()
    for name in report.TABLES:
        assert "\n\nnew\n\n" in report.replaced(text, name, "new")


def test_stored_numbers_are_few():
    assert all(path.stat().st_size < 100_000 for path in STORED)


def test_tables_need_neither_peers_nor_the_bench_extra():
    code = (
        "import sys\n"
        "peers = ('casadi', 'diffrax', 'openscvx', 'pytest_benchmark')\n"
        "sys.modules.update(dict.fromkeys(peers))\n"
        "from benchmarks import report\n"
        "assert all(report.module(name).tables for name in report.TABLES.values())\n"
    )
    subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=True)


@pytest.mark.parametrize("name", SAMPLES)
def test_a_table_has_its_numbers(name):
    numbers, expected = SAMPLES[name]
    tables = report.module(report.TABLES[name]).tables(numbers)
    assert expected in tables.splitlines()
    for head, *rows in table_rows(tables):
        assert {row.count("|") for row in rows} == {head.count("|")}


def test_every_stored_table_is_as_wide_as_its_head():
    for path in STORED:
        stored = json.loads(path.read_text())
        for head, *rows in table_rows(report.section(path.stem, stored)):
            assert {row.count("|") for row in rows} == {head.count("|")}, path.stem


def test_a_section_is_written_once(tmp_path, capsys):
    readme, results = tmp_path / "README.md", tmp_path / "results"
    readme.write_text(
        "before\n<!-- methods: made by python -m benchmarks.report -->\nold\n"
        "<!-- end of methods -->\nafter\n"
    )
    numbers, expected = SAMPLES["methods"]
    records.write_report(results / "methods.json", versions={"peer": "1.2"}, **numbers)
    assert report.main(["--check"], readme, results) == 1
    assert "old" in readme.read_text()
    assert report.main([], readme, results) == 0
    text = readme.read_text()
    assert expected in text
    assert "peer 1.2" in text
    assert "old" not in text
    assert text.startswith("before\n")
    assert text.endswith("\nafter\n")
    assert report.main(["--check"], readme, results) == 0
    assert "growth: no result is stored" in capsys.readouterr().out


def test_what_does_not_fit_is_told(tmp_path):
    readme = tmp_path / "README.md"
    readme.write_text("no markers")
    numbers, _ = SAMPLES["methods"]
    records.write_report(tmp_path / "methods.json", **numbers)
    with pytest.raises(ValueError, match="needs, once each"):
        report.main([], readme, tmp_path)
    records.write_report(tmp_path / "unknown.json", **numbers)
    with pytest.raises(SystemExit):
        report.main([], readme, tmp_path)


def test_versions_of_rows_are_told_once():
    rows = [{"versions": {"peer": "1"}}, {"deep": [{"versions": {"peer": "2"}}]}]
    told = records._versions(records._told({"rows": rows}))
    assert told == {"peer": "1 and 2"}
