"""Sweeps: what is solved, by whom, in which order, and what is kept of it."""

import csv
import dataclasses
import functools
import os
import re
import subprocess
import sys
from concurrent.futures import BrokenExecutor, Executor, Future

import equinox as eqx
import jax
import numpy as np
import pytest

import jaxscp
from jaxscp import Status, Sweep, missions, sweep
from jaxscp.__main__ import main
from jaxscp._cli import _commands
from jaxscp._sweep._record import Record
from jaxscp._sweep._worker import Origin, solve_point

# As the command line's tests have it: one program serves both.

MASSES, GOALS = [2.8, 3.0, 3.2], [[500.0, 500.0, 100.0], [400.0, 300.0, 50.0]]
GRID = {"vehicle.mass": MASSES, "goal": GOALS}
NODES = 15


class Pretending(Executor):
    """Answers at once: masses of 3 and less converge, to their square.

    **Arguments:**

    - `most`: answers after which its workers are dead.
    """

    def __init__(self, most=100):
        self.asked, self._most = [], most

    def submit(self, function, origin, text, start, settings):
        mission = missions.Mission.from_json(text)
        self.asked.append((mission, start, settings))
        answer = Future()
        if len(self.asked) > self._most:
            answer.set_exception(BrokenExecutor("dead"))
        else:
            answer.set_result(pretended(float(mission.vehicle.mass)))
        return answer

    @property
    def masses(self):
        return [float(mission.vehicle.mass) for mission, *_ in self.asked]


def pretended(mass):
    good = mass <= 3.0
    fractions = np.linspace(0.0, 1.0, 3)
    return Record(
        *("converged" if good else "iteration_limit", good, good, good),
        *(mass**2, 10 * mass, 8e6, 3, 4, 0.5, "" if good else "Raise max_iterations."),
        *(fractions, np.outer(fractions, np.ones(12)), np.outer(fractions, np.ones(4))),
    )


def swept(values=GRID, **settings):
    return sweep("free-flight", values, **{"executor": Pretending()} | settings)


def assert_same(result, expected, *, apart_from=None):
    assert result.table.dtype == expected.table.dtype
    for name in result.table.dtype.names:
        if name != apart_from:
            columns = (result.table[name], expected.table[name])
            np.testing.assert_array_equal(*columns, err_msg=name)
    for pair in zip(result.trajectories, expected.trajectories, strict=True):
        leaves = [jax.tree.leaves(trajectory) for trajectory in pair]
        for found, one in zip(*leaves, strict=True):
            np.testing.assert_array_equal(found, one)


def test_every_combination_has_a_row():
    result = swept()
    assert len(result) == 6
    assert result.table["vehicle.mass"].tolist() == [2.8, 2.8, 3.0, 3.0, 3.2, 3.2]
    np.testing.assert_array_equal(result.table["goal"], GOALS * 3)
    np.testing.assert_allclose(result.table["objective"], np.repeat(MASSES, 2) ** 2)
    np.testing.assert_allclose(result.table["final_time"], np.repeat(MASSES, 2) * 10)
    assert result.succeeded.tolist() == [True] * 4 + [False] * 2
    assert float(result.mission(5).vehicle.mass) == 3.2
    assert result.mission(5).goal.tolist() == GOALS[1]
    assert float(result.trajectories[2].final_time) == 30.0


def test_points_may_be_listed():
    points = [{"goal": GOALS[1], "vehicle.mass": 2.9}]
    points += [{"vehicle.mass": 2.5, "goal": [9, 9, 9]}]
    result = swept(points)
    assert result.table.dtype.names[:3] == ("goal", "vehicle.mass", "status")
    assert result.table["vehicle.mass"].tolist() == [2.9, 2.5]
    assert result.table["goal"][1].tolist() == [9.0] * 3


def test_the_mission_may_be_one_s_own():
    mission = missions.replace(missions.get("urban-flight"), "limits.tilt", 0.5)
    executor = Pretending()
    settings = {"enforce": "nodes", "grid": "free", "nodes": [0.0, 0.4, 1.0]}
    sweep(mission, {"vehicle.mass": [2.5]}, executor=executor, **settings)
    ((asked, start, told),) = executor.asked
    assert (float(asked.limits.tilt), float(asked.vehicle.mass)) == (0.5, 2.5)
    assert start is None
    assert told["nodes"].tolist() == settings["nodes"]
    assert {name: told[name] for name in ("enforce", "grid")} == {
        "enforce": "nodes",
        "grid": "free",
    }


@pytest.mark.parametrize(
    ("values", "column"),
    [
        ([8e6, None], [8e6, np.nan]),
        ([None, None], ["null", "null"]),
    ],
)
def test_what_is_not_there_is_not_a_number(values, column):
    result = sweep("free-space-30MB", {"data_required": values}, executor=Pretending())
    np.testing.assert_array_equal(result.table["data_required"], column)


def test_vectors_of_different_lengths_are_text():
    places = [{"obstacles.centers": [], "obstacles.safe_distances": []}]
    places += [{"obstacles.centers": [[200, 200]], "obstacles.safe_distances": [30]}]
    column = swept(places).table["obstacles.safe_distances"]
    assert column.tolist() == ["[]", "[30]"]


def test_a_line_goes_on_from_the_latest_that_converged():
    """Without `along` no point knows of another."""
    executor = Pretending()
    values = {"goal": GOALS, "vehicle.mass": [3.2, 2.9, 3.1, 2.8]}
    swept(values, along="vehicle.mass", executor=executor)
    assert executor.masses == [3.2, 3.2, 2.9, 2.9, 3.1, 3.1, 2.8, 2.8]
    starts = [start and start.final_time for _, start, _ in executor.asked]
    assert starts == [None] * 4 + [29.0] * 4
    for mission, start, _ in executor.asked[4:]:
        (other,) = (
            asked
            for asked, *_ in executor.asked
            if asked.goal.tolist() == mission.goal.tolist()
            and float(asked.vehicle.mass) * 10 == start.final_time
        )
        assert other is not mission
    alone = Pretending()
    swept(values, executor=alone)
    assert [start for _, start, _ in alone.asked] == [None] * 8


def test_values_that_exclude_each_other_fail_alone():
    executor = Pretending()
    values = {"vehicle.mass": [2.8, 3.1], "limits.thrust": [30.0, 40.0]}
    result = swept(values, executor=executor)
    assert executor.masses == [2.8, 2.8, 3.1]
    assert result.table["status"][2] == "raised"
    assert result.table["error"][2].startswith("limits.thrust=30 N does not carry")
    assert np.isnan(result.table["objective"][2])
    assert result.trajectories[2] is None
    assert all(result.trajectories[index] is not None for index in (0, 1, 3))


def test_nothing_of_it_can_be_changed():
    result = swept()
    with pytest.raises(ValueError, match="read-only"):
        result.table["objective"] = 0.0
    with pytest.raises(AttributeError):
        result.table = None


def test_csv(tmp_path):
    result = swept()
    result.to_csv(tmp_path / "a.csv")
    with (tmp_path / "a.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [float(row["goal[1]"]) for row in rows] == [500.0, 300.0] * 3
    objectives = [float(row["objective"]) for row in rows]
    assert objectives == result.table["objective"].tolist()
    assert rows[4]["error"] == "Raise max_iterations."
    assert rows[4]["converged"] == "False"


def test_npz_holds_everything(tmp_path):
    values = {"vehicle.mass": [2.8, 3.1], "limits.thrust": [30.0, 40.0]}
    result = swept(values)
    result.to_npz(tmp_path / "a.npz")
    again = Sweep.load(tmp_path / "a.npz")
    assert (again.manifest, str(again)) == (result.manifest, str(result))
    assert again.trajectories[2] is None
    assert_same(again, result)
    with pytest.raises(ValueError, match="read-only"):
        again.table["objective"] = 0.0


def test_other_files_are_refused(tmp_path, monkeypatch):
    path = tmp_path / "a.npz"
    swept().to_npz(path)
    whole = path.read_bytes()
    for kept in (0, 10, len(whole) - 30):
        path.write_bytes(whole[:kept])
        with pytest.raises(ValueError, match=rf"{path}: not a complete npz file"):
            Sweep.load(path)
    path.write_bytes(whole)
    monkeypatch.setattr("jaxscp._sweep._result.FORMAT", 2)
    with pytest.raises(ValueError, match=f"{path}: has format 1, and .* reads 2"):
        Sweep.load(path)


def test_it_prints_a_short_table():
    text = str(swept({"vehicle.mass": np.linspace(2.0, 3.1, 45)}))
    lines = text.splitlines()
    assert lines[0].split()[:3] == ["point", "vehicle.mass", "status"]
    assert lines[21] == "... 5 more ..."
    assert lines[-2] == "point 44: Raise max_iterations."
    assert lines[-1] == "41 of 45 converged and verified"
    assert len(lines) < 50


def test_a_bar_is_shown_where_asked_for(capsys):
    swept()
    assert capsys.readouterr().err == ""
    swept(progress=True)
    assert "free-flight: 100%" in capsys.readouterr().err


def test_only_what_is_missing_is_solved_again(tmp_path):
    """Also in the middle of a line, which goes on from where it was."""
    begun = Pretending(most=2)
    settings = {"along": "vehicle.mass", "folder": tmp_path / "kept"}
    with pytest.raises(BrokenExecutor):
        swept(executor=begun, **settings)
    kept = sorted(os.listdir(tmp_path / "kept"))
    assert kept == ["point-000000.npz", "point-000001.npz", "sweep.json"]
    rest = Pretending()
    result = swept(executor=rest, **settings)
    assert rest.masses == [3.0, 3.0, 3.2, 3.2]
    assert [start.final_time for _, start, _ in rest.asked] == [28.0] * 2 + [30.0] * 2
    assert_same(result, swept(along="vehicle.mass"))
    nothing = Pretending(most=0)
    again = swept(executor=nothing, **settings)
    assert nothing.asked == []
    assert_same(again, result)


def test_numbers_may_be_written_otherwise(tmp_path):
    swept({"vehicle.mass": [2, 3]}, folder=tmp_path)
    nothing = Pretending()
    swept({"vehicle.mass": np.array([2.0, 3.0])}, folder=tmp_path, executor=nothing)
    assert nothing.asked == []


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"nodes": 30}, "settings="),
        ({"along": "goal"}, 'along=null, not "goal"'),
        ({"values": {"vehicle.mass": [2.0]}}, "points="),
        ({"method": jaxscp.ProximalSCP(max_polish=7)}, "settings="),
    ],
    ids=["nodes", "along", "values", "method"],
)
def test_a_folder_of_another_sweep_is_refused(change, named, tmp_path):
    swept(folder=tmp_path)
    with pytest.raises(ValueError, match=named) as raised:
        swept(folder=tmp_path, **change)
    assert str(tmp_path / "sweep.json") in str(raised.value)
    assert "\n" not in str(raised.value)


def test_a_folder_of_another_version_is_refused(tmp_path, monkeypatch):
    swept(folder=tmp_path)
    monkeypatch.setattr("jaxscp._sweep._run.__version__", "9.9")
    with pytest.raises(ValueError, match=r'jaxscp="0.1.0", not "9.9"'):
        swept(folder=tmp_path)
    monkeypatch.setattr("jaxscp._sweep._run.FORMAT", 2)
    with pytest.raises(ValueError, match=r"format=1, not 2"):
        swept(folder=tmp_path)


def test_damaged_folders_are_refused(tmp_path):
    swept(folder=tmp_path)
    file, manifest = tmp_path / "point-000001.npz", tmp_path / "sweep.json"
    whole = file.read_bytes()
    for kept in (0, 300, len(whole) - 30):
        file.write_bytes(whole[:kept])
        with pytest.raises(ValueError, match=f"{file}: not .*; remove it"):
            swept(folder=tmp_path)
    other = tmp_path / "other"
    swept({"vehicle.mass": [2.0, 2.5]}, folder=other)
    file.write_bytes((other / file.name).read_bytes())
    with pytest.raises(ValueError, match=f"{file}: is a point of another sweep"):
        swept(folder=tmp_path)
    for text in ("", "[]", '{"format": 1}', manifest.read_text()[:-9]):
        manifest.write_text(text)
        with pytest.raises(ValueError, match=f"{manifest}: not the manifest of a sweep"):
            swept(folder=tmp_path)


def test_folders_that_cannot_be_used_are_refused(tmp_path):
    (tmp_path / "letter").write_text("Dear")
    with pytest.raises(ValueError, match=r"has no sweep.json but letter; choose"):
        swept(folder=tmp_path)
    with pytest.raises(ValueError, match=r"folder .*letter: cannot write there"):
        swept(folder=tmp_path / "letter")
    assert os.listdir(tmp_path) == ["letter"]


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"values": {}}, "there is nothing to solve"),
        ({"values": []}, "there is nothing to solve"),
        ({"values": [{}]}, "there is nothing to solve"),
        ({"values": {"vehicle.mass": []}}, r"vehicle.mass=\[\]: there is nothing"),
        ({"values": {"vehicle.mass": 3.0}}, "vehicle.mass=3.0: give a list"),
        ({"values": {"vehicle.mass": "heavy"}}, "vehicle.mass='heavy': give a list"),
        ({"values": {"vehicle.mas": [3.0]}}, "vehicle.mas: no such .*vehicle.mass"),
        ({"values": {"vehicle.mass": [3.0, -1.0]}}, "vehicle.mass=-1: give"),
        ({"values": {"vehicle.mass": [3.0, "heavy"]}}, "vehicle.mass='heavy'"),
        ({"values": {"goal": [1.0, 2.0]}}, "goal has shape"),
        ({"values": {"vehicle.mass": [np.nan]}}, "vehicle.mass=nan"),
        (
            {"values": [{"vehicle.mass": 3.0}, {"start": [0, 0, 20]}]},
            r"values\[1\] has the paths start, and values\[0\] vehicle.mass",
        ),
        ({"along": "start"}, "along='start': not swept over.*vehicle.mass, goal"),
        ({"workers": 0, "executor": None}, "workers=0: give an integer"),
        ({"workers": 2}, "workers=2: the executor has its own"),
        ({"nodes": 1}, "nodes=1: "),
        ({"enforce": "never"}, "enforce='never': choose"),
        ({"grid": "even"}, "grid='even': choose"),
        ({"mission": "flight"}, "mission='flight': no such mission"),
    ],
    ids=str,
)
def test_bad_input_is_refused_before_anything_starts(change, named, tmp_path):
    executor = Pretending()
    arguments = {"mission": "free-flight", "values": GRID, "executor": executor}
    with pytest.raises(ValueError, match=named):
        sweep(**arguments | {"folder": tmp_path / "new"} | change)
    assert executor.asked == []
    assert os.listdir(tmp_path) == []


@pytest.fixture
def command(monkeypatch):
    """`jaxscp sweep`, with pretended solves; what it was told."""
    told = []

    def run(*arguments, workers, **settings):
        told.append((workers, settings))
        return sweep(*arguments, executor=Pretending(), **settings)

    monkeypatch.setattr(_commands, "run_sweep", run)
    return told


def test_the_command_writes_what_was_asked_for(command, tmp_path, capsys):
    outputs = ["--csv", tmp_path / "a.csv", "--npz", tmp_path / "a.npz"]
    options = ["--over", "vehicle.mass=[2.8, 3]", "--along", "vehicle.mass"]
    options += ["--workers", "3", "--folder", tmp_path / "kept", "--nodes", "9"]
    options += ["--method", "paper", "--enforce", "nodes", "--set", "limits.tilt=0.5"]
    assert main(["sweep", "free-flight", *map(str, options + outputs)]) == 0
    assert sorted(os.listdir(tmp_path)) == ["a.csv", "a.npz", "kept"]
    result = Sweep.load(tmp_path / "a.npz")
    assert capsys.readouterr().out == f"{result}\n"
    assert result.manifest["mission"]["limits"]["tilt"] == 0.5
    ((workers, settings),) = command
    assert (workers, settings["nodes"], settings["along"]) == (3, 9, "vehicle.mass")
    assert isinstance(settings["method"], jaxscp.PaperSCP)


def test_the_command_tells_of_points_that_failed(command, capsys):
    assert main(["sweep", "free-flight", "--over", "vehicle.mass=[3, 3.1]"]) == 1
    assert "point 1: Raise max_iterations." in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        ([], "--over"),
        (["--over", "vehicle.mass=3"], "vehicle.mass=3: give a list"),
        (["--over", "vehicle.mass=[3", "--quick"], "not JSON"),
        (["--over", "mass=[3]"], "mass: no such entry"),
        (["--over", "start=[[0,0,9]]", "--over", "start=[[0,0,8]]"], "given twice"),
        (["--over", "vehicle.mass=[3]", "--along", "goal"], "along='goal'"),
        (["--over", "vehicle.mass=[3]", "--workers", "0"], "at least 1"),
        (["--over", "vehicle.mass=[3]", "--csv", "/nowhere/a.csv"], "--csv /nowhere"),
        (["--over", "vehicle.mass=[3]", "--npz", "/"], "--npz /: is a directory"),
    ],
    ids=str,
)
def test_the_command_refuses_bad_input(arguments, named, command, capsys):
    assert main(["sweep", "free-flight", *arguments]) == 2
    output = capsys.readouterr()
    assert output.out == ""
    assert output.err.count("\n") == 1
    assert named in output.err


# Short flights with much room to tilt: few steps of Newton's method.
REAL = {"goal": [[200.0, 100.0, 20.0], [100.0, 100.0, 10.0]], "vehicle.mass": [3.0, 2.9]}


@functools.cache
def solution():
    """Of the first point, from its own guess."""
    first = missions.replace(agile(), "goal", REAL["goal"][0])
    return missions.solve(first, nodes=NODES)


def agile():
    return missions.replace(missions.get("free-flight"), "limits.tilt", 0.9)


def told_to(answers, monkeypatch):
    """A worker's record where solves end so, and the guesses they started from."""
    guesses, left = [], list(answers)

    def solve(mission, *, guess=None, throw, **settings):
        guesses.append(guess)
        return left.pop(0)

    monkeypatch.setattr(missions, "solve", solve)
    settings = {"enforce": "between", "nodes": NODES}
    text = agile().to_json()
    record = solve_point(Origin.here(), text, pretended(2.0), settings)
    assert not left
    return record, guesses


def test_a_worker_starts_where_it_is_told(monkeypatch):
    record, guesses = told_to([solution()], monkeypatch)
    assert (record.status, record.error) == ("converged", "")
    assert record.converged
    assert record.polished
    assert record.verified
    assert record.objective == float(solution().objective)
    assert record.data > 0.0
    (guess,) = guesses
    assert float(guess.final_time) == 20.0


def test_a_worker_tries_the_mission_s_own_guesses_then(monkeypatch):
    lost = dataclasses.replace(solution(), status=Status.iteration_limit)
    record, guesses = told_to([lost, solution()], monkeypatch)
    assert guesses[1] is None
    assert record.converged
    record, _ = told_to([lost, lost], monkeypatch)
    assert (record.status, record.error) == ("iteration_limit", lost.message)
    assert not record.converged


def test_a_worker_says_what_is_not_verified(monkeypatch):
    flight = solution().trajectory
    tilted = flight.states.at[9, 6].set(1.0)
    wrong = eqx.tree_at(lambda s: s.trajectory.states, solution(), tilted)
    record, _ = told_to([wrong], monkeypatch)
    assert (record.converged, record.verified) == (True, False)
    assert record.error.startswith("Not verified: ")
    assert "roll broken by " in record.error
    # Off for the interval that ends there and the one that begins there.
    moved = flight.states.at[9, 0].add(1.0)
    wrong = eqx.tree_at(lambda s: s.trajectory.states, solution(), moved)
    record, _ = told_to([wrong], monkeypatch)
    assert re.match(
        r"Not verified: flown again, interval [89] ends off its node in x\.", record.error
    )


def test_a_worker_s_errors_are_told():
    record = solve_point(Origin.here(), "{}", None, {"enforce": "nodes"})
    assert (record.status, record.converged) == ("raised", False)
    assert record.error == "name is missing: give it a value."
    record = solve_point(Origin.here(), agile().to_json(), None, {"method": 1, "x": 2})
    assert record.error.startswith("TypeError: ")


@functools.cache
def flown():
    """In two processes of our own, each line from its neighbour."""
    return sweep(agile(), REAL, along="vehicle.mass", workers=2, nodes=NODES)


@pytest.mark.slow
def test_two_processes_find_what_one_solve_does():
    result = flown()
    assert result.succeeded.all()
    first, expected = result.table[0], solution()
    assert first["objective"] == pytest.approx(float(expected.objective), rel=1e-9)
    for name in ("states", "controls"):
        found = getattr(result.trajectories[0], name)
        np.testing.assert_allclose(found, getattr(expected.trajectory, name), atol=1e-4)
    # The second of a line starts from the first.
    took = result.table["iterations"] + result.table["polish_iterations"]
    assert took[1] < took[0]


@pytest.mark.slow
def test_dask_finds_the_same():
    distributed = pytest.importorskip("distributed")
    cluster = distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, dashboard_address=None
    )
    with cluster, distributed.Client(cluster) as client:
        executor = client.get_executor()
        settings = {"along": "vehicle.mass", "executor": executor, "nodes": NODES}
        result = sweep(agile(), REAL, **settings)
    assert_same(result, flown(), apart_from="seconds")


def test_importing_it_starts_nothing():
    """Neither processes nor tqdm's thread."""
    code = "import threading, jaxscp; assert threading.active_count() == 1"
    subprocess.run([sys.executable, "-c", code], check=True)
