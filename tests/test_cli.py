"""The command line: its contract with scripts."""

import dataclasses
import json
import os
import sys
from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest

import jaxscp
from jaxscp import Audit, Audited, History, Status, missions
from jaxscp.__main__ import main
from jaxscp._cli import _commands
from jaxscp._cli._report import progress_line

KEYS = {
    "mission",
    "status",
    "converged",
    "verified",
    "objective",
    "final_time",
    "data_bits",
    "data_required_bits",
    "defect_max",
    "position_error",
    "violations",
    "iterations",
    "polished",
    "optimality",
    "polish_iterations",
    "attempts",
    "subproblems",
    "seconds",
    "versions",
}
QUICK = ("solve", "free-flight", "--nodes", "25")


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """Exit status, folder and solution of a solve that writes everything."""
    folder = tmp_path_factory.mktemp("solved")
    options = ("--json", folder / "a.json", "--save", folder / "a.npz")
    options += ("--plot", folder / "a.png", "--quiet")
    solve, found = missions.solve, []

    def kept(*mission, **settings):
        found.append(solve(*mission, **settings))
        return found[-1]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(missions, "solve", kept)
        status = main([*QUICK, *map(str, options)])
    return status, folder, found[0]


@pytest.fixture(scope="module")
def solved(recorded):
    return recorded[:2]


@pytest.fixture
def solved_before(recorded, monkeypatch):
    """What solves are asked for, and none is done again: each would take ten seconds."""
    asked = []

    def again(*mission, **settings):
        asked.append(settings)
        return recorded[2]

    monkeypatch.setattr(missions, "solve", again)
    return asked


def refused(capsys, arguments):
    """Run a command that must be refused; its one line of error."""
    assert main(arguments) == 2
    output = capsys.readouterr()
    assert output.out == ""
    assert output.err.count("\n") == 1, output.err
    return output.err


def test_missions_are_listed_a_line_each(capsys):
    assert main(["missions"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert tuple(line.split()[0] for line in lines) == missions.names()


def test_the_version_is_told(capsys):
    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"jaxscp {jaxscp.__version__}\n"


def test_values_set_and_swept_are_refused(capsys):
    sweep = ["sweep", "free-flight", "--over", "vehicle.mass=[3]"]
    assert "--over vehicle.mass: --set gives it one value" in refused(
        capsys, [*sweep, "--set", "vehicle.mass=4"]
    )


def test_help_succeeds(capsys):
    assert main(["--help"]) == 0
    assert "verify" in capsys.readouterr().out


@pytest.mark.slow
def test_solve_writes_what_was_asked_for(solved):
    status, folder = solved
    assert status == 0
    assert sorted(os.listdir(folder)) == ["a.json", "a.npz", "a.png"]
    assert (folder / "a.png").read_bytes().startswith(b"\x89PNG")


def test_limits_hold_between_the_nodes_unless_told_otherwise(solved):
    _, folder = solved
    report = json.loads((folder / "a.json").read_text())
    assert report["violations"] == {}
    assert main(["verify", str(folder / "a.npz"), "--enforce", "between"]) == 0


@pytest.mark.parametrize("passed", [True, False])
def test_audit_says_what_it_found(passed, tmp_path, capsys, monkeypatch):
    """The table row by row; where a row fails, also whether the point is regular."""
    found = Audited("vehicle.mass", 2.0, float("nan"), 2.1, 1e-3, 1e-5, passed)

    def audit(mission, of, wrt, *, build, progress, **settings):
        assert (of, wrt) == ("final_time", ["vehicle"])
        assert build(mission).state_names[0] == "x"
        assert settings["guess"].nodes == 25
        assert settings["tolerance"] == 1e-2
        progress(found)
        return Audit((found,))

    def solve(mission, *, enforce, nodes, throw):
        assert enforce == "between"
        assert not throw
        guess = mission.guess(nodes)
        return SimpleNamespace(polished=True, trajectory=guess, discretization=None)

    monkeypatch.setattr(missions, "solve", solve)
    monkeypatch.setattr(_commands, "audit_gradient", audit)
    monkeypatch.setattr(_commands, "sensitivity_report", lambda *_, build: "regular no")
    path = tmp_path / "audit.json"
    arguments = ["--nodes", "25", "--wrt", "vehicle", "--of", "final_time"]
    status = main(["audit", "free-flight", *arguments, "--json", str(path)])
    assert status == (0 if passed else 1)
    heading, row, *rest = capsys.readouterr().out.splitlines()
    assert heading.split()[:2] == ["parameter", "implicit"]
    assert row == str(found)
    assert rest == ([] if passed else ["regular no"])
    report = json.loads(path.read_text())
    assert (report["mission"], report["of"]) == ("free-flight", "final_time")
    (entry,) = report["rows"]
    assert (entry["passed"], entry["envelope"]) == (passed, None)


def test_audit_names_what_there_is(capsys):
    message = refused(capsys, ["audit", "free-flight", "--wrt", "weight"])
    assert "wrt=['weight']: no parameter's name begins so" in message
    assert "vehicle.mass" in message


@pytest.mark.slow
def test_limits_at_the_nodes_alone_and_progress_on_terminals(
    tmp_path, capsys, monkeypatch
):
    """Both are part of what is compiled: together they take one compilation more."""
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    path = tmp_path / "nodes.json"
    assert main([*QUICK, "--enforce", "nodes", "--json", str(path)]) == 0
    report = json.loads(path.read_text())
    assert report["verified"] is True
    # Between the nodes they are exceeded.
    assert {"roll", "pitch"} & set(report["violations"])
    output = capsys.readouterr()
    assert "objective" in output.out
    lines = output.err.splitlines()
    assert lines[0].split()[0] == "iteration"
    assert lines[1].split()[0] == "1"


def test_json_holds_the_contract(solved):
    report = json.loads((solved[1] / "a.json").read_text())
    assert set(report) == KEYS
    assert report["mission"] == "free-flight"
    assert report["status"] in {"converged", "converged_roughly"}
    assert report["polished"] == (report["status"] == "converged")
    assert report["optimality"] < 1e-3
    assert report["converged"] is True
    assert report["verified"] is True
    assert report["data_required_bits"] is None
    (attempt,) = report["attempts"]
    assert (attempt["verified"], attempt["chosen"]) == (True, True)
    assert 0.0 <= report["position_error"] < 0.1
    assert 0.0 <= report["defect_max"] < 1e-3
    assert report["iterations"] >= 1
    assert report["subproblems"] >= 1
    assert set(report["seconds"]) == {"import", "compile", "solve"}
    assert all(spent > 0 for spent in report["seconds"].values())
    assert {"jaxscp", "jax", "piqp"} <= set(report["versions"])
    for violation in report["violations"].values():
        assert set(violation) == {"value", "unit", "time"}


def test_every_attempt_is_reported(recorded, tmp_path, capsys, monkeypatch):
    def another_way_too(*_, **__):
        solution = recorded[2]
        (attempt,) = solution.attempts
        other = dataclasses.replace(
            attempt,
            objective=jnp.asarray(12345.678),
            status=Status.iteration_limit,
            chosen=jnp.asarray(False),
        )
        return dataclasses.replace(solution, attempts=(attempt, other))

    monkeypatch.setattr(missions, "solve", another_way_too)
    path = tmp_path / "a.json"
    assert main([*QUICK, "--json", str(path)]) == 0
    lines = capsys.readouterr().out.splitlines()
    first, second = (line for line in lines if line.startswith("attempt "))
    assert first.startswith("attempt 1 ")
    assert first.endswith(", chosen")
    assert second.split()[:4] == ["attempt", "2", "12,345.68,", "iteration_limit,"]
    report = json.loads(path.read_text())
    chosen, other = report["attempts"]
    assert chosen == {
        "objective": report["objective"],
        "status": report["status"],
        "converged": True,
        "verified": True,
        "chosen": True,
    }
    assert other == {
        "objective": 12345.678,
        "status": "iteration_limit",
        "converged": False,
        "verified": None,
        "chosen": False,
    }


def test_what_rising_data_led_to_is_written(recorded, tmp_path, monkeypatch):
    def in_steps(*_, **__):
        solution = recorded[2]
        (attempt,) = solution.attempts
        lost = dataclasses.replace(
            attempt, status=Status.iteration_limit, chosen=jnp.asarray(False)
        )
        return dataclasses.replace(solution, attempts=(lost, attempt))

    monkeypatch.setattr(missions, "solve", in_steps)
    saved, drawn = tmp_path / "a.npz", tmp_path / "a.pdf"
    assert main([*QUICK, "--save", str(saved), "--plot", str(drawn)]) == 0
    assert saved.exists()
    assert drawn.exists()


def test_progress_numbers_the_attempts_after_the_first():
    numbers = dict.fromkeys(vars(History.empty(1)), 0.5)
    line = progress_line({"attempt": 1, "iteration": 1, **numbers})
    title, headings, _ = line.splitlines()
    assert title == "attempt 2"
    assert headings.split()[0] == "iteration"
    first = progress_line({"attempt": 0, "iteration": 1, **numbers})
    assert first == line.partition("\n")[2]


def test_npz_holds_the_contract(solved):
    report = json.loads((solved[1] / "a.json").read_text())
    with np.load(solved[1] / "a.npz") as entries:
        assert set(entries) == {"time", "state", "control", "final_time", "mission"}
        assert entries["time"].shape == (25,)
        assert entries["state"].shape == (25, 12)
        assert entries["control"].shape == (25, 4)
        assert float(entries["final_time"]) == report["final_time"]
        assert entries["time"][-1] == pytest.approx(report["final_time"])
        mission = missions.Mission.from_json(str(entries["mission"]))
        np.testing.assert_allclose(entries["state"][0, :3], mission.start, atol=1e-6)


def test_failure_is_reported_with_its_files(tmp_path, capsys):
    outputs = ("--json", tmp_path / "a.json", "--save", tmp_path / "a.npz")
    impossible = ("--set", "final_time_range=[1, 5]")
    assert main([*QUICK, *impossible, *map(str, outputs), "--quiet"]) == 1
    output = capsys.readouterr()
    assert output.out == ""
    assert output.err.startswith("free-flight: ")
    assert sorted(os.listdir(tmp_path)) == ["a.json", "a.npz"]
    report = json.loads((tmp_path / "a.json").read_text())
    assert set(report) == KEYS
    assert report["converged"] is False
    assert report["status"] != "converged"


def test_saved_file_verifies(solved, capsys):
    assert main(["verify", str(solved[1] / "a.npz")]) == 0
    assert "free-flight" in capsys.readouterr().out


def test_tampered_file_does_not_verify(solved, tmp_path, capsys):
    with np.load(solved[1] / "a.npz") as entries:
        changed = {name: entries[name] for name in entries}
    changed["control"] = changed["control"] * 1.1
    np.savez(tmp_path / "b.npz", **changed)
    assert main(["verify", str(tmp_path / "b.npz")]) == 1
    assert "no" in capsys.readouterr().out.split()


@pytest.mark.parametrize("kept", [0, 10, 2000, -30])
def test_truncated_file_is_refused(solved, tmp_path, capsys, kept):
    cut = tmp_path / "cut.npz"
    cut.write_bytes((solved[1] / "a.npz").read_bytes()[:kept])
    assert str(cut) in refused(capsys, ["verify", str(cut)])


def test_foreign_files_are_refused(tmp_path, capsys):
    np.savez(tmp_path / "other.npz", time=np.zeros(3))
    np.save(tmp_path / "array.npy", np.zeros(3))
    assert "state" in refused(capsys, ["verify", str(tmp_path / "other.npz")])
    assert "array.npy" in refused(capsys, ["verify", str(tmp_path / "array.npy")])
    assert "no such file" in refused(capsys, ["verify", str(tmp_path / "none.npz")])


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["free-fligth"], ["free-fligth", "free-flight"]),
        (["free-flight", "--set", "vehicle.mas=3"], ["vehicle.mas", "vehicle.mass"]),
        (["free-flight", "--set", "vehicle.mass=-3"], ["mass", "-3"]),
        (["free-flight", "--set", "vehicle.mass=[1, 2]"], ["mass", "(2,)"]),
        (["free-flight", "--set", 'vehicle.mass="heavy"'], ["mass", "heavy"]),
        (["free-flight", "--set", "vehicle.mass=NaN"], ["vehicle.mass", "NaN"]),
        (["free-flight", "--set", "vehicle.mass="], ["vehicle.mass", "JSON"]),
        (["free-flight", "--set", "vehicle.mass"], ["vehicle.mass", "PATH=JSON"]),
        (["free-flight", "--set", "start=[0, 0]"], ["start", "(2,)"]),
        (["urban-flight", "--set", "start=[190, 200, 20]"], ["start", "safe distance"]),
        (["free-flight", "--nodes", "1"], ["nodes", "'1'"]),
        (["free-flight", "--nodes", "ten"], ["nodes", "'ten'"]),
        (["free-flight", "--method", "newton"], ["newton", "proximal", "paper"]),
        (["free-flight", "--grid", "even"], ["even", "uniform", "free"]),
        (["free-flight", "--fast"], ["--fast"]),
    ],
    ids=lambda value: " ".join(value),
)
def test_bad_input_is_refused(arguments, named, tmp_path, capsys):
    outputs = ["--json", tmp_path / "a.json", "--save", tmp_path / "a.npz"]
    error = refused(capsys, ["solve", *arguments, *map(str, outputs)])
    assert all(text in error for text in named), error
    assert os.listdir(tmp_path) == []


@pytest.mark.parametrize("value", ["0", "-1e-3", "nan", "inf", "little"])
def test_a_tolerance_is_a_positive_number(value, capsys):
    error = refused(capsys, ["audit", "free-flight", f"--tolerance={value}"])
    assert f"'{value}': give a positive number" in error


@pytest.mark.parametrize("option", ["--json", "--save", "--plot"])
def test_unwritable_output_is_refused(option, tmp_path, capsys):
    missing = tmp_path / "missing" / "file.png"
    assert str(missing) in refused(capsys, [*QUICK, option, str(missing)])
    assert "directory" in refused(capsys, [*QUICK, option, str(tmp_path)])
    assert os.listdir(tmp_path) == []


def test_unknown_picture_format_is_refused(tmp_path, capsys):
    error = refused(capsys, [*QUICK, "--plot", str(tmp_path / "a.xyz")])
    assert ".png" in error
    assert os.listdir(tmp_path) == []


def test_output_may_be_a_device(solved_before, capsys):
    """A rename would replace the device by a file."""
    assert main([*QUICK, "--quiet", "--json", os.devnull]) == 0
    assert capsys.readouterr().out == ""
    assert not os.path.isfile(os.devnull)


def test_progress_is_for_terminals_only(solved_before, capsys, monkeypatch):
    monkeypatch.setattr(sys.stdout, "isatty", lambda: False)
    monkeypatch.setattr(sys.stderr, "isatty", lambda: False)
    assert main([*QUICK]) == 0
    (asked,) = solved_before
    assert asked["progress"] is None
    output = capsys.readouterr()
    assert "objective" in output.out
    assert output.err == ""
