"""One case discretized by OpenSCvx 0.5.2, for `discretization.py`:
python -m benchmarks.openscvx_discretizer

A process of its own, whose interpreter has OpenSCvx and need not have jaxscp. A call is
the one that `Problem.solve()` makes before every subproblem, of the same program.

Nothing has to be converted: OpenSCvx scales its subproblems, not what it discretizes, and
on a uniform grid the control that stretches an interval's time is the flight time. The
integrals are two more states. OpenSCvx always adds two of its own, time and the excess of
its limits, and columns of the next node's control, zero under a zero-order hold: they
are part of the work, but not of what is compared.
"""

import argparse
import contextlib
import json
import os
import time
from importlib.metadata import version
from pathlib import Path
from types import SimpleNamespace

import openscvx as ox

# isort: split
# What follows must find Equinox as OpenSCvx sets it up: exports have no callbacks.
import diffrax
import jax
import numpy as np
from openscvx import discretization
from openscvx.utils.caching import load_or_compile_discretization_solver

from .median import median_seconds
from .second_model import dynamics, integrands

PACKAGES = ("openscvx", "jax", "diffrax")
# Its sparse discretizer wants symbols.
SYMBOLS = SimpleNamespace(
    sin=ox.Sin,
    cos=ox.Cos,
    atan=ox.Atan,
    sqrt=ox.Sqrt,
    exp=ox.Exp,
    log=ox.Log,
    log1p=lambda rest: ox.Log(1 + rest),
)


def discretizer_of(run: dict) -> discretization.Discretizer:
    """With steps as it comes, or so many equal ones: Tsit5's or its own RK45's."""
    kind = getattr(discretization, run["scheme"])
    if run["steps"] == "adaptive":
        return kind(dis_type="ZOH")
    settings = {"num_substeps": run["substeps"] + 1}
    if run["steps"] == "RK45":
        return kind(dis_type="ZOH", custom_integrator=True, diffrax_kwargs=settings)
    settings["stepsize_controller"] = diffrax.ConstantStepSize()
    return kind(dis_type="ZOH", ode_solver=run["steps"], diffrax_kwargs=settings)


def problem_of(case: dict, discretizer: discretization.Discretizer) -> ox.Problem:
    """Of limits that do not matter, with the trajectory as its guess."""
    states, vehicle = np.array(case["states"]), case["mission"]["vehicle"]
    motion, control = ox.State("motion", (12,)), ox.Control("control", (4,))
    _within(motion, states)
    _within(control, np.array(case["controls"]))
    rates = {"motion": ox.Concat(*dynamics(SYMBOLS, vehicle, motion, control))}
    parts = [motion]
    if case["gathers"]:
        sums = integrands(SYMBOLS, case["mission"], motion, control)
        parts.append(ox.State("total", (len(sums),)))
        _within(parts[1], np.zeros((len(states), len(sums))))
        rates["total"] = ox.Concat(*sums)
    for part in parts:
        part.initial, part.final = part.guess[0], part.guess[-1]
    end = case["final_time"]
    return ox.Problem(
        dynamics=rates,
        constraints=[],
        states=parts,
        controls=[control],
        N=len(states),
        time=ox.Time(0.0, ("minimize", end), 0.0, 2 * end, uniform_time_grid=True),
        discretizer=discretizer,
        float_dtype="float64",
    )


def _within(part: ox.State | ox.Control, guess: np.ndarray) -> None:
    part.min, part.max, part.guess = guess.min(axis=0) - 1, guess.max(axis=0) + 1, guess


def measure(case: dict, run: dict) -> dict:
    """Seconds of a call and, if the case asks for them, its values and Jacobian."""
    problem = problem_of(case, discretizer_of(run))
    sizes = problem.settings.sim
    begun = time.perf_counter()
    program = load_or_compile_discretization_solver(
        problem.discretizer.get_solver(problem.lowered.dynamics, problem.settings),
        Path(),
        {},
        *(sizes.n, sizes.n_states, sizes.n_controls),
    )

    def call():
        return program.call(sizes.x.guess, sizes.u.guess, {})

    found = jax.block_until_ready(call())
    compiled = time.perf_counter() - begun
    facts = {"compile_seconds": compiled, "seconds": median_seconds(call)}
    if case["compared"]:
        values, jacobian = arranged(problem, found)
        facts |= {"values": values.tolist(), "jacobian": jacobian.tolist()}
    return run | facts | {"versions": {name: version(name) for name in PACKAGES}}


def arranged(problem: ox.Problem, found) -> tuple[np.ndarray, np.ndarray]:
    """Rows and columns as `discretizer_case.py` has them."""
    by_state, by_control, _, ends, _ = map(np.asarray, found)
    places, order = problem.slices, np.arange(ends.shape[1])
    parts = [places[name] for name in ("motion", "total") if name in places]
    rows = np.concatenate([order[part] for part in parts])
    blocks = [
        by_state[:, :, places["motion"]],
        by_control[:, :, places["control"]],
        by_control[:, :, places["_time_dilation"]],
    ]
    return ends[:, rows], np.concatenate(blocks, axis=2)[:, rows]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("case", type=Path)
    parser.add_argument("result", type=Path)
    parser.add_argument("--limit", type=float, default=120.0, help="of all rows [s]")
    arguments = parser.parse_args()
    case, rows, begun = json.loads(arguments.case.read_text()), [], time.perf_counter()
    with open(os.devnull, "w") as nowhere, contextlib.redirect_stdout(nowhere):
        for run in case["runs"]:
            if time.perf_counter() - begun < arguments.limit:
                rows.append(measure(case, run))
    arguments.result.write_text(json.dumps({"rows": rows}))


if __name__ == "__main__":
    main()
