"""benchmarks/README.md shows what the benchmarks have stored."""

import json
import subprocess
import sys
from pathlib import Path

import pytest
from benchmark_samples import SAMPLES

ROOT = Path(__file__).parents[1]
if not (ROOT / "benchmarks").is_dir():
    pytest.skip("a source distribution has no benchmarks", allow_module_level=True)
sys.path.append(str(ROOT))

from benchmarks import records, report  # noqa: E402  (no part of the package)

STORED = sorted(records.RESULTS.glob("*.json"))


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


def test_every_benchmark_has_a_sample():
    assert SAMPLES.keys() == report.TABLES.keys()


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
