"""One case solved by IPOPT, for `ipopt.py`: python -m benchmarks.ipopt_peer

A process of its own without JAX, so that its memory is that of CasADi and IPOPT.
"""

import argparse
import json
import statistics
import time
from pathlib import Path

import casadi as ca

from . import memory
from .age import age
from .casadi_problem import DiscreteProblem, discrete_problem, packed, trajectory

# Of the objective and the constraints, scaled, that CasADi finds at jaxscp's solution.
SAME = 1e-6


def solve(case: dict, *, graph: str, scaled: bool, limit: float, repeats: int) -> dict:
    """How IPOPT ended; the seconds are its own, without building the problem."""
    imported, begun = memory.resident(), time.perf_counter()
    problem = discrete_problem(case, scaled=scaled)
    settings = {
        # CasADi's, of how functions are evaluated: the whole graph in scalar
        # operations is faster, one interval's function mapped over all is smaller.
        "expand": graph == "expanded",
        "jac_g": jacobian(problem, expand=graph == "expanded"),
        "print_time": False,
        "ipopt.print_level": 0,
        "ipopt.sb": "yes",
        "ipopt.max_wall_time": limit,
    }
    if graph == "compiled":
        flags = {"compiler": "gcc", "flags": ["-O2"]}
        settings |= {"jit": True, "compiler": "shell", "jit_options": flags}
    solver = ca.nlpsol("solver", "ipopt", problem.expressions, settings)
    built = time.perf_counter() - begun
    start = packed(case, case["guess"]) / problem.scale
    begun, cpu = time.perf_counter(), time.process_time()
    found = solver(x0=start, **problem.limits)
    seconds, cpu = time.perf_counter() - begun, time.process_time() - cpu
    cold, outcome = age(), solver.stats()
    again = repeated(lambda: solver(x0=start, **problem.limits), repeats, limit)
    return {
        "objective": float(found["f"]),
        "violation": violation(problem.limits, found["g"]),
        "final_time": float(found["x"][-1]) * problem.scale[-1],
        "iterations": outcome["iter_count"],
        "status": outcome["return_status"],
        "seconds": seconds,
        "cpu_seconds": cpu,
        "build_seconds": built,
        "cold_seconds": cold,
        "warm_seconds": statistics.median(again or [seconds]),
        "found": trajectory(case, found["x"].full().ravel() * problem.scale),
        "memory_imported": imported,
        "memory_peak": memory.peak(),
        "versions": {"casadi": ca.__version__},
    }


def repeated(call, repeats: int, limit: float) -> list[float]:
    """Seconds of further calls: no more of them than the limit has room for."""
    seconds: list[float] = []
    while len(seconds) < repeats and sum(seconds) < limit:
        begun = time.perf_counter()
        call()
        seconds.append(time.perf_counter() - begun)
    return seconds


def jacobian(problem: DiscreteProblem, *, expand: bool) -> ca.Function:
    """Of the constraints, in parts: the defects' columns can be found many at a time, but
    not together with the data's dense row, which CasADi takes backward."""
    z, g = problem.expressions["x"], problem.expressions["g"]
    blocks = [ca.jacobian(part, z) for part in problem.constraints]
    names = (["x", "p"], ["g", "jac_g_x"])
    whole = ca.Function("jac_g", [z, ca.MX.sym("p", 0)], [g, ca.vertcat(*blocks)], *names)
    return whole.expand() if expand else whole


def checked(case: dict) -> dict:
    """jaxscp's solution in this model: by how much its objective differs, and how far
    it is from meeting the constraints.

    **Raises:** `SystemExit` where the objectives disagree: the problems are not the same.
    """
    problem = discrete_problem(case, scaled=True)
    values = [problem.expressions[name] for name in ("f", "g")]
    evaluate = ca.Function("evaluate", [problem.expressions["x"]], values)
    cost, constraints = evaluate(packed(case, case["found"]) / problem.scale)
    difference = float(cost) / case["found"]["objective"] - 1
    if abs(difference) > SAME:
        raise SystemExit(
            f"The objectives differ by {difference:.1e} at jaxscp's solution."
        )
    return {
        "difference": difference,
        "violation": violation(problem.limits, constraints),
    }


def violation(limits: dict, constraints: ca.DM) -> float:
    """The largest of all constraints."""
    values = constraints.full().ravel()
    short, over = limits["lbg"] - values, values - limits["ubg"]
    return float(max(short.max(), over.max(), 0.0))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("case", type=Path)
    parser.add_argument("result", type=Path)
    parser.add_argument("--graph", choices=("mapped", "expanded", "compiled"))
    parser.add_argument("--scaled", action="store_true")
    parser.add_argument("--limit", type=float)
    parser.add_argument("--repeats", type=int, default=0, help="further solves")
    options = vars(parser.parse_args())
    case, result = json.loads(options.pop("case").read_text()), options.pop("result")
    # Before anything else has a part in its memory.
    found = solve(case, **options)
    result.write_text(json.dumps(found | {"check": checked(case)}))


if __name__ == "__main__":
    main()
