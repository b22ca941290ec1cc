"""`sweep`: many missions, solved side by side."""

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    Executor,
    Future,
    ProcessPoolExecutor,
    wait,
)
from contextlib import contextmanager
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from .. import missions
from .._proximal import ProximalSCP
from .._records import plain, to_dict
from .._scp import AbstractSCP
from .._trajectory import time_grid
from .._types import ArrayLike
from .._validation import check_precision
from .._version import __version__
from ..missions import Mission
from ._folder import Folder
from ._points import lines_of, missions_of, points_of
from ._record import Record
from ._result import FORMAT, Sweep
from ._worker import Origin, solve_point, start


def sweep(
    mission: Mission | str,
    values: Mapping[str, Any] | Sequence[Mapping[str, Any]],
    *,
    along: str | None = None,
    executor: Executor | None = None,
    workers: int | None = None,
    folder: str | Path | None = None,
    progress: bool | None = None,
    method: AbstractSCP = ProximalSCP(),  # noqa: B008  (immutable)
    enforce: str = "between",
    grid: str = "uniform",
    nodes: int | ArrayLike = 100,
) -> Sweep:
    """Solve and verify a mission with many values, side by side in processes.

        sweep = jaxscp.sweep("free-flight", {"vehicle.mass": [2.5, 3.0, 3.5]})

    A point whose solve does not converge, or raises an error, does not stop the others:
    its row of the table says why. A script that calls this needs the line
    `if __name__ == "__main__":` around what it does, as every one that starts processes.

    **Main arguments:**

    - `mission`: a mission, or the name of one.
    - `values`: the values that each path takes, in all their combinations; paths as in
        `missions.replace`. Or a list of points, each with a value for every path.
    - `along`: a path. Points that differ in its value alone are solved one after
        another, in their order, each from the solution of the latest before it that
        converged, or from its own guesses where that leads nowhere. Without it each is
        solved from its own guesses, whatever becomes of the others.
    - `workers`: number of processes; by default as many as there are cores.
    - `folder`: where each point is kept as soon as it is solved. Started again with the
        same folder, a sweep solves only those that are missing.
    - `method`, `enforce`, `grid`, `nodes`: as in `missions.solve`.

    **Other arguments:**

    - `executor`: what runs the solves instead of processes of its own: any
        `concurrent.futures.Executor`, such as Dask's `Client.get_executor()`. Processes
        that it uses are switched to 64-bit mode and share compiled programs with those
        on the same machine.
    - `progress`: whether to show a bar; by default where standard error is a terminal.

    **Raises:** `ValueError`, before anything is solved, for arguments that make no
    sense, and for a folder that holds another sweep or damaged files. `RuntimeError` if
    JAX is not in 64-bit mode. `BrokenExecutor` if a worker dies.
    """
    check_precision()
    base = missions.get(mission) if isinstance(mission, str) else mission
    settings = _settings(method, enforce, grid, nodes)
    _check_workers(workers, executor)
    points = points_of(base, values)
    lines = lines_of(points, along)
    built = missions_of(base, points)
    manifest = {
        "format": FORMAT,
        "jaxscp": __version__,
        "mission": to_dict(base),
        "points": list(points),
        "along": along,
        "settings": settings | {"method": repr(method), "nodes": plain(nodes)},
    }
    kept = None if folder is None else Folder(folder, manifest)
    texts = {
        i: each.to_json() for i, each in enumerate(built) if isinstance(each, Mission)
    }
    records = {
        index: Record.failed(each)
        for index, each in enumerate(built)
        if isinstance(each, ValueError)
    }
    records |= {} if kept is None else kept.found()
    origin = Origin.here()
    bar = _bar(base.name, len(points), len(records), progress)
    with bar, _pool(executor, workers, len(lines), origin) as pool:

        def submit(index: int, before: Record | None) -> Future[Record]:
            return pool.submit(solve_point, origin, texts[index], before, settings)

        def keep(index: int, record: Record) -> None:
            if kept is not None:
                kept.keep(index, record)
            bar.update()

        _solve_lines(lines, records, submit, keep)
    return Sweep.of_records(manifest, [records[index] for index in range(len(points))])


def _solve_lines(
    lines: Sequence[Sequence[int]],
    records: dict[int, Record],
    submit: Callable[[int, Record | None], Future[Record]],
    keep: Callable[[int, Record], None],
) -> None:
    """Add the records that are missing: of each line one after another."""
    pending: dict[Future[Record], tuple[int, Sequence[int]]] = {}

    def advance(line: Sequence[int]) -> None:
        index = next((index for index in line if index not in records), None)
        if index is not None:
            earlier = (records[i] for i in reversed(line[: line.index(index)]))
            before = next((record for record in earlier if record.converged), None)
            pending[submit(index, before)] = index, line

    try:
        for line in lines:
            advance(line)
        while pending:
            done, _ = wait(pending, return_when=FIRST_COMPLETED)
            for future in done:
                index, line = pending.pop(future)
                records[index] = future.result()
                keep(index, records[index])
                advance(line)
    finally:
        for future in pending:
            future.cancel()


@contextmanager
def _pool(
    executor: Executor | None, workers: int | None, most: int, origin: Origin
) -> Iterator[Executor]:
    """The executor given, or processes of our own: PIQP holds the interpreter's lock."""
    if executor is not None:
        yield executor
        return
    pool = ProcessPoolExecutor(
        min(workers or _cores(), most),
        mp_context=get_context("spawn"),
        initializer=start,
        initargs=(origin,),
    )
    try:
        yield pool
    except BrokenExecutor as error:
        raise BrokenExecutor(
            "a worker of the sweep ended, perhaps for want of memory, or because its "
            "script lacks `if __name__ == '__main__':`; with fewer workers and the same "
            "folder the sweep goes on where it was."
        ) from error
    finally:
        pool.shutdown(cancel_futures=True)


def _bar(name: str, total: int, done: int, progress: bool | None) -> tqdm:
    # None leaves it to tqdm: where standard error is a terminal.
    hidden = None if progress is None else not progress
    return tqdm(total=total, initial=done, disable=hidden, desc=name, unit="mission")


def _settings(
    method: AbstractSCP, enforce: str, grid: str, nodes: int | ArrayLike
) -> dict[str, Any]:
    """What every solve is told, in plain data.

    **Raises:** `ValueError` for what `missions.solve` would refuse.
    """
    missions.check_settings(enforce, grid)
    time_grid(nodes)
    number = isinstance(nodes, (int, np.integer))
    counted = int(nodes) if number else np.asarray(nodes, float)  # type: ignore[arg-type]
    return {"method": method, "enforce": enforce, "grid": grid, "nodes": counted}


def _check_workers(workers: int | None, executor: Executor | None) -> None:
    if workers is None:
        return
    if executor is not None:
        raise ValueError(
            f"workers={workers}: the executor has its own; leave one of them out."
        )
    if workers < 1:
        raise ValueError(f"workers={workers}: give an integer of at least 1.")


def _cores() -> int:
    """Processors that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
