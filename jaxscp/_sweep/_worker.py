"""What a sweep's worker does: solve and verify a mission that came as text."""

import functools
import multiprocessing
import os
import platform
import threading
import time
from typing import Any, NamedTuple

import jax
import numpy as np

from .. import missions
from .._cache import compile_in_turn, keep_programs
from .._choice import checked
from .._data_sent import data_sent
from .._solution import Solution
from .._status import name_of
from .._trajectory import Trajectory
from .._verification import Verification
from ..missions import Mission
from ._record import Record

# What a worker on the same machine sets as its parent has it.
_SHARED = (
    "jax_platforms",
    "jax_compilation_cache_dir",
    "jax_enable_compilation_cache",
    "jax_persistent_cache_min_compile_time_secs",
    "jax_persistent_cache_min_entry_size_bytes",
)


class Origin(NamedTuple):
    """Which process started the sweep, and how JAX is set there."""

    host: str
    process: int
    settings: tuple[tuple[str, Any], ...]

    @classmethod
    def here(cls) -> "Origin":
        settings = tuple((name, getattr(jax.config, name)) for name in _SHARED)
        return cls(platform.node(), os.getpid(), settings)


@functools.cache
def prepare(origin: Origin) -> None:
    """Make a process ready: 64-bit mode, and programs that all workers share.

    The process that started the sweep may have threads as workers: nothing is set there.
    """
    host = platform.node() == origin.host
    if host and os.getpid() == origin.process:
        return
    for name, value in origin.settings if host else ():
        if getattr(jax.config, name) != value:
            jax.config.update(name, value)
    jax.config.update("jax_enable_x64", True)
    keep_programs()
    compile_in_turn()


def start(origin: Origin) -> None:
    """Make a process ready that lives for one sweep, and ends if that is killed."""
    prepare(origin)
    parent = multiprocessing.parent_process()
    if parent is not None:
        threading.Thread(target=_end_with, args=(parent,), daemon=True).start()


def solve_point(
    origin: Origin, text: str, before: Record | None, settings: dict[str, Any]
) -> Record:
    """Solve and verify a mission; an error becomes a record, too.

    **Arguments:**

    - `text`: the mission as JSON.
    - `before`: of the neighbour whose solution the solve starts from. Where that does
        not lead to convergence, or without it, the mission's own guesses serve.
    - `settings`: those of `missions.solve`.
    """
    prepare(origin)
    begun = time.perf_counter()
    try:
        mission = Mission.from_json(text)
        guess = None if before is None else before.trajectory
        solution = _solved(mission, guess, settings)
        between = settings["enforce"] == "between"
        verification = checked(solution.problem, solution, between)
        return _record(mission, solution, verification, between, begun)
    except Exception as error:
        return Record.failed(error, time.perf_counter() - begun)


def _end_with(parent: Any) -> None:
    parent.join()
    os._exit(1)


def _solved(
    mission: Mission, start: Trajectory | None, settings: dict[str, Any]
) -> Solution:
    if start is not None:
        solution = missions.solve(mission, guess=start, throw=False, **settings)
        if bool(solution.converged):
            return solution
    return missions.solve(mission, throw=False, **settings)


def _record(
    mission: Mission,
    solution: Solution,
    verification: Verification,
    between: bool,
    begun: float,
) -> Record:
    flight, statistics = solution.trajectory, solution.statistics
    converged = bool(solution.converged)
    return Record(
        status=name_of(solution.status),
        converged=converged,
        polished=bool(solution.polished),
        verified=bool(verification.verified),
        objective=float(solution.objective),
        final_time=float(flight.final_time),
        data=data_sent(mission, verification),
        iterations=int(statistics.iterations),
        polish_iterations=int(statistics.polish_iterations),
        seconds=time.perf_counter() - begun,
        error=_broken(verification, between) if converged else solution.message,
        fractions=np.asarray(flight.fractions),
        states=np.asarray(flight.states),
        controls=np.asarray(flight.controls),
    )


def _broken(verification: Verification, between: bool) -> str:
    """Why a flight is not verified, in a line; nothing if it is."""
    if verification.verified:
        return ""
    broken = verification.violations if between else verification.node_violations
    listed = [
        f"{name} broken by {worst.value:.2e} {worst.unit} at {worst.time:.2f} s"
        for name, worst in broken.items()
    ]
    if listed:
        return f"Not verified: {', '.join(listed)}."
    interval, state = verification.worst_interval
    return (
        f"Not verified: flown again, interval {interval} ends off its node in "
        f"{verification.state_names[state]}."
    )
