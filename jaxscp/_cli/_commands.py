"""What each command does; each returns the exit status."""

import argparse
import dataclasses
import json
import sys
import time
from typing import Any

import equinox as eqx
import jax

from .. import _files, _writing, missions as catalogue
from .._audit import HEADING, audit_gradient
from .._choice import checked
from .._direction import own_directions
from .._hold import ZeroOrderHold
from .._sensitivity_report import sensitivity_report
from .._solution import Solution
from .._sweep import sweep as run_sweep
from .._trajectory import Trajectory
from .._validation import check_guesses, check_problem
from .._verification import Verification
from ..missions import Mission
from ._arguments import AUDITED, FAILURE, METHODS, SUCCESS, InputError
from ._figures import check_format, write_figure
from ._report import as_json, finite, progress_line, table
from ._reproduce import reproduce as reproduce
from ._timing import CompileClock, process_age


def missions(arguments: argparse.Namespace) -> int:
    """List the missions, a line each."""
    del arguments
    names = catalogue.names()
    width = max(len(name) for name in names)
    for name in names:
        print(f"{name:{width}}  {catalogue.get(name).summary}")
    return SUCCESS


def verify(arguments: argparse.Namespace) -> int:
    """Check a saved solution independently."""
    try:
        mission, trajectory = _files.load(arguments.file)
    except ValueError as error:
        raise InputError(error) from error
    between = arguments.enforce == "between"
    result = checked(mission.problem(), trajectory, between, hold=ZeroOrderHold())
    print(f"{arguments.file}: {mission.name}")
    print(result)
    return SUCCESS if result.verified else FAILURE


def solve(arguments: argparse.Namespace) -> int:
    """Solve a mission, verify the solution and write what was asked for."""
    seconds = {"import": process_age()}
    try:
        _check_outputs(arguments, "json", "save", "plot")
        if arguments.plot is not None:
            check_format(arguments.plot)
        mission, guesses = _checked_mission(arguments, arguments.grid)
    except ValueError as error:
        raise InputError(error) from error
    solution, spent = _timed_solve(mission, arguments)
    seconds |= spent
    between = arguments.enforce == "between"
    verification = checked(solution.problem, solution, between)
    chosen = [bool(attempt.chosen) for attempt in solution.attempts].index(True)
    # The data that rise in steps, the last attempt, rise on the first guess's route.
    start = (*guesses, guesses[0])[chosen]
    _write(arguments, mission, solution, start, verification, seconds)
    good = bool(solution.converged) and verification.verified
    if not arguments.quiet:
        print(table(mission, solution, verification, seconds))
    elif not good:
        print(f"{mission.name}: {solution.message}", file=sys.stderr)
    return SUCCESS if good else FAILURE


def sweep(arguments: argparse.Namespace) -> int:
    """Solve and verify a mission with many values, and write what was asked for."""
    try:
        _check_outputs(arguments, "csv", "npz")
        result = run_sweep(
            _mission(arguments),
            _swept(arguments),
            along=arguments.along,
            workers=arguments.workers,
            folder=arguments.folder,
            method=METHODS[arguments.method](),
            enforce=arguments.enforce,
            grid=arguments.grid,
            nodes=arguments.nodes,
        )
    except ValueError as error:
        raise InputError(error) from error
    if arguments.csv is not None:
        result.to_csv(arguments.csv)
    if arguments.npz is not None:
        result.to_npz(arguments.npz)
    print(result)
    return SUCCESS if result.succeeded.all() else FAILURE


def audit(arguments: argparse.Namespace) -> int:
    """Check a mission's derivatives, a line for each of its numbers."""
    try:
        if arguments.json is not None:
            _writing.check_writable("--json", arguments.json)
        mission, _ = _checked_mission(arguments)
        wrt = arguments.wrt or [
            field.name for field in dataclasses.fields(mission) if field.name != "plan"
        ]
        own_directions(mission, wrt)
    except ValueError as error:
        raise InputError(error) from error
    settings = {"enforce": arguments.enforce, "nodes": arguments.nodes}
    solution = catalogue.solve(mission, throw=False, **settings)
    if not bool(solution.polished):
        print(f"{mission.name}: {solution.message}", file=sys.stderr)
        return FAILURE
    print(HEADING)
    tolerance = arguments.tolerance
    if tolerance is None:
        tolerance = AUDITED[arguments.of]
    audit = audit_gradient(
        mission,
        arguments.of,
        wrt,
        build=Mission.problem,
        guess=solution.trajectory,
        discretization=solution.discretization,
        tolerance=tolerance,
        progress=lambda row: print(row, flush=True),
    )
    if arguments.json is not None:
        rows = [dataclasses.asdict(row) for row in audit.rows]
        report = {"mission": mission.name, "of": arguments.of, "rows": rows}
        _write_json(arguments.json, finite(report))
    if audit.passed:
        return SUCCESS
    print(sensitivity_report(mission, solution, build=Mission.problem))
    return FAILURE


def _checked_mission(
    arguments: argparse.Namespace, grid: str = "uniform"
) -> tuple[Mission, tuple[Trajectory, ...]]:
    """The mission that was asked for, and where its solve starts."""
    mission = _mission(arguments)
    problem = mission.problem()
    guesses = catalogue.guesses(mission, arguments.nodes, grid=grid)
    # `solve` would say the same. Asked here, what it raises later is a fault of the
    # program, and shows as one.
    check_problem(problem)
    check_guesses(problem, guesses)
    return mission, guesses


def _mission(arguments: argparse.Namespace) -> Mission:
    mission = catalogue.get(arguments.mission)
    return catalogue.replace_many(mission, dict(arguments.changes))


def _swept(arguments: argparse.Namespace) -> dict[str, Any]:
    """The values of each path."""
    values: dict[str, Any] = {}
    changed = [path for path, _ in arguments.changes]
    for path, column in arguments.over:
        if path in values:
            raise ValueError(f"--over {path}: given twice; put its values in one list.")
        if path in changed:
            raise ValueError(f"--over {path}: --set gives it one value; leave one out.")
        values[path] = column
    return values


def _timed_solve(
    mission: Mission, arguments: argparse.Namespace
) -> tuple[Solution, dict[str, float]]:
    """The solution, converged or not, and the seconds to compile and to solve."""
    method = METHODS[arguments.method]()
    terminal = sys.stdout.isatty() and sys.stderr.isatty()
    progress = _show_progress if terminal and not arguments.quiet else None
    began = time.perf_counter()
    with CompileClock() as compiling:
        solution = catalogue.solve(
            mission,
            method,
            enforce=arguments.enforce,
            grid=arguments.grid,
            nodes=arguments.nodes,
            progress=progress,
            throw=False,
        )
        jax.block_until_ready(eqx.filter(solution, eqx.is_array))
    total = time.perf_counter() - began
    seconds = {"compile": compiling.seconds, "solve": total - compiling.seconds}
    return solution, seconds


def _show_progress(row: dict[str, Any]) -> None:
    print(progress_line(row), file=sys.stderr, flush=True)


def _write(
    arguments: argparse.Namespace,
    mission: Mission,
    solution: Solution,
    guess: Trajectory,
    verification: Verification,
    seconds: dict[str, float],
) -> None:
    if arguments.save is not None:
        _files.save(arguments.save, mission, solution.trajectory)
    if arguments.plot is not None:
        # Imported where needed: Matplotlib takes a second.
        from .. import plot

        write_figure(arguments.plot, plot.mission(mission, solution, guess))
    if arguments.json is not None:
        _write_json(arguments.json, as_json(mission, solution, verification, seconds))


def _write_json(path: str, report: dict[str, Any]) -> None:
    text = json.dumps(report, indent=2, allow_nan=False) + "\n"
    _writing.write_bytes(path, text.encode())


def _check_outputs(arguments: argparse.Namespace, *options: str) -> None:
    for option in options:
        if (path := getattr(arguments, option)) is not None:
            _writing.check_writable(f"--{option}", path)
