"""One case solved by OpenSCvx, for `solve.py`: python -m benchmarks.openscvx_peer

A process of its own, whose interpreter has OpenSCvx and need not have jaxscp.
"""

import argparse
import contextlib
import copy
import json
import os
import time
from importlib.metadata import version
from pathlib import Path

import numpy as np

from .age import age
from .openscvx_problem import WEIGHTS, openscvx_problem

PACKAGES = ("openscvx", "jax", "qoco")


def solve(case: dict, *, repeats: int, limit: float, **settings: str) -> dict:
    """How OpenSCvx ended, and its nodes; the settings are those of the problem."""
    problem = openscvx_problem(case, **settings)
    problem.initialize()
    ready, first = age(), copy.deepcopy(problem.algorithm.weights)
    result = problem.solve(time_limit=limit)
    cold, seconds = age(), []
    while len(seconds) < repeats and sum(seconds) < limit:
        # The tuner changes them, and a reset keeps what it made of them.
        problem.algorithm.weights = copy.deepcopy(first)
        problem.reset()
        begun = time.perf_counter()
        result = problem.solve(time_limit=limit)
        seconds.append(time.perf_counter() - begun)
    return {
        "status": "says it converged" if result.converged else "did not converge",
        "iterations": problem.state.k - 1,
        "prepare_seconds": ready,
        "cold_seconds": cold,
        "warm_seconds": float(np.median(seconds or [cold - ready])),
        "found": {
            "states": np.asarray(result.nodes["motion"], float).tolist(),
            "controls": np.asarray(result.nodes["control"], float).tolist(),
            "final_time": float(np.ravel(result.t_final)[0]),
        },
        # What its own test of convergence looks at, in the end.
        "trust_region": last(result.J_tr_history),
        "virtual_control": last(result.J_vc_history),
        "virtual_buffer": last(result.J_vb_history),
        "versions": {package: version(package) for package in PACKAGES},
    }


def last(values) -> float:
    """OpenSCvx keeps some of its measures as lists, others as one number."""
    return float(np.ravel(values)[-1])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("case", type=Path)
    parser.add_argument("result", type=Path)
    parser.add_argument("--weights", choices=WEIGHTS, default="default")
    parser.add_argument("--scales", choices=("jaxscp", "limits"), default="jaxscp")
    parser.add_argument("--precision", choices=("float32", "float64"), default="float64")
    parser.add_argument("--repeats", type=int, default=2)
    parser.add_argument("--limit", type=float, default=120.0, help="of a solve [s]")
    options = vars(parser.parse_args())
    case, result = json.loads(options.pop("case").read_text()), options.pop("result")
    with open(os.devnull, "w") as nowhere, contextlib.redirect_stdout(nowhere):
        found = solve(case, **options)
    result.write_text(json.dumps(found))


if __name__ == "__main__":
    main()
