"""One case solved by jaxscp, for `ipopt.py`: python -m benchmarks.ipopt_jaxscp

A process of its own, so that its memory is not shared with the peer. It writes the
discrete problem in numbers, too: what the peer is to solve.
"""

import argparse
import json
import time
from pathlib import Path

import jax
import numpy as np

import jaxscp
from jaxscp import Discretization, Trajectory, missions

from . import memory
from .records import facts_of
from .timing import timed_solve


def case_of(mission: missions.Mission, solution: jaxscp.Solution, guess: Trajectory):
    """The discrete problem in plain numbers, with the guess and what jaxscp found."""
    problem, nodes = solution.problem, guess.nodes

    def numbers(states, controls, final_time) -> dict:
        states = np.broadcast_to(states, (nodes, 12))
        controls = np.broadcast_to(controls, (nodes, 4))
        return {
            "states": states.tolist(),
            "controls": controls.tolist(),
            "final_time": float(final_time),
        }

    def limits(side: str) -> dict:
        states = np.tile(getattr(problem.state, side), (nodes, 1))
        states[0], states[-1] = problem.initial_state.lower, problem.final_state.lower
        return numbers(
            states, getattr(problem.control, side), getattr(problem.final_time, side)
        )

    sizes = np.asarray(problem.state.scale)
    sizes = np.where(np.isnan(sizes), problem.state.upper, sizes)
    found = solution.trajectory
    return {
        "mission": json.loads(mission.to_json()),
        "quadrature": solution.discretization.quadrature.value,
        "substeps": int(solution.statistics.substeps),
        "fractions": np.asarray(guess.fractions).tolist(),
        "lower": limits("lower"),
        "upper": limits("upper"),
        "scales": numbers(sizes, problem.control.upper, guess.final_time),
        "guess": numbers(guess.states, guess.controls, guess.final_time),
        "found": numbers(found.states, found.controls, found.final_time)
        | {"objective": float(solution.objective)},
    }


def solve(name: str, quadrature: str, nodes: int, repeats: int) -> tuple[dict, dict]:
    """How jaxscp ended, and the case."""
    imported = memory.resident()
    mission = missions.get(name)
    problem, guess = mission.problem(), mission.guess(nodes)
    settings = Discretization(quadrature=jaxscp.Quadrature(quadrature))
    _, cold, _ = timed_solve(problem, guess, 1, discretization=settings)
    whole = memory.peak()
    # What is left once everything is compiled.
    memory.forget_peak()
    held = memory.resident()
    # What is told of the solution is of one of the solves that are timed: they differ.
    solution, _, warm = timed_solve(problem, guess, repeats - 1, discretization=settings)
    solving, cpu = memory.peak(), time.process_time()
    jax.block_until_ready(
        jaxscp.solve(problem, guess, discretization=settings, throw=False)
    )
    return {
        **facts_of(solution),
        "substeps": int(solution.statistics.substeps),
        "final_time": float(solution.trajectory.final_time),
        "seconds": warm,
        "cpu_seconds": time.process_time() - cpu,
        "cold_seconds": cold,
        "memory_imported": imported,
        "memory_peak": whole,
        "memory_held": held,
        "memory_warm_peak": solving,
    }, case_of(mission, solution, guess)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("case", type=Path, help="where to write the problem")
    parser.add_argument("result", type=Path)
    parser.add_argument("--mission", dest="name")
    parser.add_argument("--quadrature")
    parser.add_argument("--nodes", type=int)
    parser.add_argument("--repeats", type=int)
    options = vars(parser.parse_args())
    place, result = options.pop("case"), options.pop("result")
    jax.config.update("jax_enable_x64", True)
    facts, case = solve(**options)
    place.write_text(json.dumps(case))
    result.write_text(json.dumps(facts))


if __name__ == "__main__":
    main()
