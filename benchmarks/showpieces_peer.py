"""One of OpenSCvx's own examples, for `showpieces.py`: run by the Python that has it.

    python benchmarks/showpieces_peer.py EXAMPLE RESULT [--uniform] [--repeats N]

Needs neither jaxscp nor this package.
"""

import argparse
import importlib.util
import json
import statistics
import sys
import time
import types
from importlib.metadata import version
from pathlib import Path

# What the examples import to draw with, and never need to solve.
DRAWING = ("examples", "examples.plotting", "examples.plotting_viser")


class _Undrawn(types.ModuleType):
    def __getattr__(self, name: str):
        if name.startswith("__"):
            raise AttributeError(name)
        return object


def example(path: Path):
    """The example's `problem`, as its own file makes it."""
    for name in DRAWING:
        sys.modules[name] = _Undrawn(name)
    spec = importlib.util.spec_from_file_location("example", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.problem


def solve(problem, repeats: int) -> dict:
    """What the example ends with; objectives are of the trajectory flown again."""
    begun = time.perf_counter()
    problem.initialize()
    initialized = time.perf_counter() - begun
    seconds = []
    for repeat in range(repeats + 1):
        if repeat:
            problem.reset()
        begun = time.perf_counter()
        result = problem.solve()
        seconds.append(time.perf_counter() - begun)
    begun = time.perf_counter()
    flown = problem.post_process()
    processed = time.perf_counter() - begun
    last = {name: values[-1] for name, values in flown.trajectory.items()}
    residuals = (result.J_tr_history, result.J_vb_history, result.J_vc_history)
    nodes = {name: values[-1] for name, values in flown.nodes.items()}
    return {
        "initialize_seconds": initialized,
        "first_seconds": seconds[0],
        "solve_seconds": statistics.median(seconds[1:] or seconds),
        "post_seconds": processed,
        "iterations": len(result.X) - 1,
        "converged": bool(result.converged),
        "residuals": [float(last) for last in residuals],
        "final_time": float(flown.nodes["time"][-1].item()),
        "flown": {name: values.tolist() for name, values in last.items()},
        "nodes": {name: values.tolist() for name, values in nodes.items()},
        "openscvx": version("openscvx"),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("example", type=Path)
    parser.add_argument("result", type=Path)
    parser.add_argument("--uniform", action="store_true", help="intervals all alike")
    parser.add_argument("--repeats", type=int, default=3)
    arguments = parser.parse_args()
    problem = example(arguments.example)
    if arguments.uniform:
        problem.settings.sim._uniform_time_grid = True
    found = solve(problem, arguments.repeats)
    arguments.result.write_text(json.dumps(found))


if __name__ == "__main__":
    main()
