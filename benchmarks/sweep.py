"""How much time several processes save in a sweep: python -m benchmarks.sweep

The same missions by one process and by two, by jaxscp's and by Dask's, with an empty
cache of programs and with a full one. All start from nothing: the time includes what a
process takes to import, to trace and to compile or load.

Then a sweep is killed half-way and started again with the same folder.
"""

import argparse
import contextlib
import multiprocessing
import os
import signal
import tempfile
import time
from collections.abc import Iterator
from concurrent.futures import Executor
from pathlib import Path

import jax
import numpy as np

import jaxscp

from .records import add_json_option, table, versions_of, write_report

MASSES = np.linspace(2.2, 3.6, 8).tolist()
GOALS = [[x, y, 100.0] for x in (350.0, 400.0, 450.0, 500.0) for y in (400.0, 500.0)]
VALUES = {"vehicle.mass": MASSES, "goal": GOALS}
SETTINGS = {"nodes": 30, "enforce": "nodes"}
COLUMNS = "workers | programs | s | of one process | CPU s | points | same table"


def swept(**settings) -> jaxscp.Sweep:
    return jaxscp.sweep("free-flight", VALUES, **SETTINGS, **settings)


@contextlib.contextmanager
def dask(workers: int) -> Iterator[Executor]:
    """Worker processes on this machine."""
    from distributed import Client, LocalCluster

    cluster = LocalCluster(
        n_workers=workers, threads_per_worker=1, dashboard_address=None
    )
    with cluster, Client(cluster) as client:
        yield client.get_executor()


def measure(kind: str, workers: int, programs: str) -> tuple[dict, jaxscp.Sweep]:
    """One sweep with the cache that JAX is set to; seconds are wall-clock."""
    begun, spent = time.perf_counter(), _children()
    if kind == "Dask":
        with dask(workers) as executor:
            result = swept(executor=executor)
    else:
        result = swept(workers=workers)
    row = {
        "kind": kind,
        "workers": workers,
        "programs": programs,
        "seconds": time.perf_counter() - begun,
        "cpu_seconds": _children() - spent,
        "points": len(result),
        "succeeded": int(result.succeeded.sum()),
    }
    return row, result


def same(result: jaxscp.Sweep, expected: jaxscp.Sweep) -> bool:
    """Whether two tables agree to the last digit, apart from times."""
    return all(
        np.array_equal(result.table[name], expected.table[name])
        for name in set(expected.table.dtype.names or ()) - {"seconds"}
    )


def killed(workers: int) -> dict:
    """Points that a killed sweep left, and those its second start had to solve."""
    with tempfile.TemporaryDirectory() as folder:
        process = multiprocessing.get_context("spawn").Process(
            target=_begun, args=(folder, workers, jax.config.jax_compilation_cache_dir)
        )
        process.start()
        half = len(MASSES) * len(GOALS) // 2
        while len(files := _points(folder)) < half:
            assert process.is_alive()
            time.sleep(0.05)
        os.kill(process.pid, signal.SIGKILL)
        process.join()
        files = _points(folder)
        begun = time.perf_counter()
        result = swept(workers=workers, folder=folder)
        again = _points(folder).items() - files.items()
        return {
            "kept": len(files),
            "solved_again": len(again),
            "seconds": time.perf_counter() - begun,
            "succeeded": int(result.succeeded.sum()),
        }


def tables(report: dict) -> str:
    """What was measured, in Markdown."""
    alone = {r["programs"]: r["seconds"] for r in report["sweeps"] if r["workers"] == 1}
    lines = [
        f"| {row['workers']} {row['kind']} | {row['programs']} | {row['seconds']:.1f}"
        f" | {row['seconds'] / alone[row['programs']]:.2f} | {row['cpu_seconds']:.0f}"
        f" | {row['succeeded']} of {row['points']} | {'yes' if row['same'] else 'no'} |"
        for row in report["sweeps"]
    ]
    left = report["killed"]
    return (
        f"{table(COLUMNS, lines)}\n\n"
        f"Killed with {left['kept']} points kept, it solved {left['solved_again']} when "
        "started again."
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--workers", type=int, default=2)
    add_json_option(parser, "sweep")
    arguments = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    rows, expected = [], None
    several = arguments.workers
    for kind, workers in (("jaxscp", 1), ("jaxscp", several), ("Dask", several)):
        with tempfile.TemporaryDirectory() as folder:
            jax.config.update("jax_compilation_cache_dir", folder)
            for programs in ("to compile", "kept"):
                row, result = measure(kind, workers, programs)
                expected = expected or result
                rows.append(row | {"same": same(result, expected)})
                print(rows[-1], flush=True)
            if (kind, workers) == ("jaxscp", several):
                left = killed(workers)
                print(left, flush=True)
    versions = versions_of("distributed")
    write_report(arguments.json, sweeps=rows, killed=left, versions=versions)


def _begun(folder: str, workers: int, programs: str) -> None:
    jax.config.update("jax_enable_x64", True)
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    jax.config.update("jax_compilation_cache_dir", programs)
    swept(workers=workers, folder=folder)


def _points(folder: str) -> dict[str, int]:
    """Names of the points' files, and when they were written."""
    files = Path(folder).glob("point-*.npz")
    return {file.name: file.stat().st_mtime_ns for file in files}


def _children() -> float:
    """Processor time of the processes that have ended [s]."""
    times = os.times()
    return times.children_user + times.children_system


if __name__ == "__main__":
    main()
