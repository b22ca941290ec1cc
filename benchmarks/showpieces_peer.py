"""One of OpenSCvx's own examples, for `showpieces.py`: run by the Python that has it.

    python -m benchmarks.showpieces_peer EXAMPLE RESULT [--double] [--interpreted]

Needs no jaxscp.
"""

import argparse
import functools
import importlib.util
import json
import statistics
import sys
import time
import types
from importlib.metadata import version
from pathlib import Path

import openscvx

# What the examples import to draw with, and never need to solve.
DRAWING = ("examples", "examples.plotting", "examples.plotting_viser")
PACKAGES = ("openscvx", "jax", "cvxpy", "qoco")


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
    """What the example ends with, at its nodes and flown again by OpenSCvx."""
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
    flown = problem.post_process()
    residuals = (result.J_tr_history, result.J_vb_history, result.J_vc_history)
    return {
        "initialize_seconds": initialized,
        "first_seconds": seconds[0],
        "warm_seconds": statistics.median(seconds[1:] or seconds),
        "iterations": len(result.X) - 1,
        "converged": bool(result.converged),
        "residuals": [float(last) for last in residuals],
        "flown": {name: vs[-1].tolist() for name, vs in flown.trajectory.items()},
        "largest": {name: vs.max(0).tolist() for name, vs in flown.trajectory.items()},
        "nodes": {name: values.tolist() for name, values in flown.nodes.items()},
        "versions": {package: version(package) for package in PACKAGES},
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("example", type=Path)
    parser.add_argument("result", type=Path)
    parser.add_argument("--double", action="store_true", help="in 64-bit floats")
    parser.add_argument(
        "--interpreted", action="store_true", help="CVXPY and QOCO, no generated code"
    )
    parser.add_argument("--repeats", type=int, default=1)
    arguments = parser.parse_args()
    if arguments.double:
        openscvx.Problem = functools.partial(openscvx.Problem, float_dtype="float64")
    problem = example(arguments.example)
    if arguments.interpreted:
        problem._solver.cvxpygen = False
        problem._solver.cvx_solver = "QOCO"
    found = solve(problem, arguments.repeats)
    arguments.result.write_text(json.dumps(found))


if __name__ == "__main__":
    main()
