"""One mission solved by jaxscp, for `solve.py`: python -m benchmarks.solve_jaxscp

A process of its own, so that everything is compiled in it. It writes the discrete problem
in numbers, too: what the peers are to solve.
"""

import argparse
import json
from pathlib import Path

import jax

import jaxscp
from jaxscp import missions

from .age import age
from .ipopt_jaxscp import case_of
from .records import facts_of
from .timing import timed


def solve(name: str, tolerance: float, nodes: int, repeats: int) -> tuple[dict, dict]:
    """How jaxscp ended, and the case."""
    mission = missions.get(name)
    problem, guess = mission.problem(), mission.guess(nodes)
    method = jaxscp.ProximalSCP(tolerance=tolerance)

    def once() -> jaxscp.Solution:
        return jaxscp.solve(problem, guess, method, throw=False)

    jax.block_until_ready(once())
    cold = age()
    solution, _, warm = timed(once, repeats)
    case, facts = case_of(mission, solution, guess), facts_of(solution)
    return {
        "status": facts["status"],
        "iterations": f"{facts['iterations']} + {facts['polish_iterations']}",
        "residual": facts["optimality"],
        "cold_seconds": cold,
        "warm_seconds": warm,
        "piqp_seconds": float(solution.statistics.qp_seconds),
        "found": case["found"],
    }, case


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("case", type=Path, help="where to write the problem")
    parser.add_argument("result", type=Path)
    parser.add_argument("--mission", dest="name")
    parser.add_argument("--tolerance", type=float, default=jaxscp.ProximalSCP().tolerance)
    parser.add_argument("--nodes", type=int, default=100)
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--cache", help="folder to keep compiled programs in")
    options = vars(parser.parse_args())
    place, result = options.pop("case"), options.pop("result")
    jax.config.update("jax_enable_x64", True)
    if cache := options.pop("cache"):
        jaxscp.keep_programs(cache)
    facts, case = solve(**options)
    place.write_text(json.dumps(case))
    result.write_text(json.dumps(facts))


if __name__ == "__main__":
    main()
