"""A mission's discrete problem, written a second time in CasADi.

It is made from numbers alone (`ipopt_peer.py` says which), so that a process that solves
it needs no JAX.
"""

from typing import NamedTuple

import casadi as ca
import numpy as np

from .second_model import dynamics, integrands, runge_kutta


class DiscreteProblem(NamedTuple):
    """minimize f(z) subject to bounds on z and on g(z).

    - `expressions`: "x", "f" and "g", as `casadi.nlpsol` takes them.
    - `constraints`: the parts of g: defects, then buildings and data where there are any.
    - `limits`: "lbx", "ubx", "lbg" and "ubg", as the solver takes them.
    - `scale`: what an entry of z stands for in physical units.
    """

    expressions: dict[str, ca.MX]
    constraints: list[ca.MX]
    limits: dict[str, np.ndarray]
    scale: np.ndarray


def interval(mission: dict, substeps: int, gathers: bool) -> ca.Function:
    """State at the end of one interval, and growth of the integrals if it `gathers`."""
    x, u, seconds = ca.SX.sym("x", 12), ca.SX.sym("u", 4), ca.SX.sym("seconds")

    def rates(y):
        sums = integrands(ca, mission, y, u) if gathers else []
        return ca.vertcat(*dynamics(ca, mission["vehicle"], y, u), *sums)

    start = ca.vertcat(x, ca.SX.zeros(rates(x).numel() - 12))
    y = runge_kutta(rates, start, seconds, substeps)
    return ca.Function("interval", [x, u, seconds], [y[:12], y[12:]])


def nodal_integrands(mission: dict) -> ca.Function:
    x, u = ca.SX.sym("x", 12), ca.SX.sym("u", 4)
    return ca.Function("integrands", [x, u], [ca.vertcat(*integrands(ca, mission, x, u))])


def discrete_problem(case: dict, *, scaled: bool) -> DiscreteProblem:
    """Multiple shooting with one interval a node, as jaxscp has it.

    **Arguments:**

    - `scaled`: whether z and the defects are in the case's scales, or in SI units.
    """
    nodes, mission = len(case["fractions"]), case["mission"]
    intervals, gathers = nodes - 1, case["quadrature"] == "flow"
    scale = packed(case, case["scales"])
    scale = scale if scaled else np.ones_like(scale)
    z = ca.MX.sym("z", scale.size)
    states, controls, final_time = unpacked(case, scale * z)
    seconds = final_time * ca.DM(np.diff(case["fractions"])).T
    ends, growth = interval(mission, case["substeps"], gathers).map(intervals)(
        states[:, :-1], controls[:, :intervals], seconds
    )
    if not gathers:
        rates = nodal_integrands(mission).map(nodes)(states, controls)
        width = ca.repmat(seconds, rates.size1(), 1)
        growth = width / 2 * (rates[:, :-1] + rates[:, 1:])
    totals, defects = ca.sum2(growth), ca.vec(states[:, 1:] - ends)
    constraints = [defects / scale[12 : 12 * nodes]]
    lower = upper = np.zeros(12 * intervals)
    for place, safe in zip(*mission["obstacles"].values(), strict=True):
        squares = ca.sum1((states[:2, :] - ca.DM(place)) ** 2)
        constraints.append(1.0 - squares.T / safe**2)
        lower = np.append(lower, np.full(nodes, -np.inf))
        upper = np.append(upper, np.zeros(nodes))
    if mission["data_required"] is not None:
        constraints.append(totals[0])
        lower, upper = np.append(lower, 1.0), np.append(upper, np.inf)
    return DiscreteProblem(
        {"x": z, "f": totals[-1], "g": ca.vertcat(*constraints)},
        constraints,
        {
            "lbx": packed(case, case["lower"]) / scale,
            "ubx": packed(case, case["upper"]) / scale,
            "lbg": lower,
            "ubg": upper,
        },
        scale,
    )


def packed(case: dict, trajectory: dict) -> np.ndarray:
    """Nodal states and controls and the flight time in one vector."""
    controls = np.asarray(trajectory["controls"])[: control_nodes(case)]
    states, final_time = np.ravel(trajectory["states"]), trajectory["final_time"]
    return np.concatenate([states, controls.ravel(), [final_time]])


def trajectory(case: dict, vector: np.ndarray) -> dict:
    """What `packed` packed: only such controls as the problem has."""
    nodes, free = len(case["fractions"]), control_nodes(case)
    return {
        "states": vector[: 12 * nodes].reshape(nodes, 12).tolist(),
        "controls": vector[12 * nodes : -1].reshape(free, 4).tolist(),
        "final_time": float(vector[-1]),
    }


def unpacked(case: dict, vector: ca.MX) -> tuple[ca.MX, ca.MX, ca.MX]:
    """States (12, N), controls (4, M) and flight time."""
    nodes, free = len(case["fractions"]), control_nodes(case)
    states, controls = vector[: 12 * nodes], vector[12 * nodes : -1]
    return ca.reshape(states, 12, nodes), ca.reshape(controls, 4, free), vector[-1]


def control_nodes(case: dict) -> int:
    """Under the trapezoid rule the last node has a control of its own, too."""
    return len(case["fractions"]) - (case["quadrature"] == "flow")
