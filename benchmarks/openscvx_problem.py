"""A mission's discrete problem, written a second time for OpenSCvx 0.5.2.

It is made from numbers alone, as `casadi_problem.py` is, by an interpreter that need not
have jaxscp. Energy and data are two more states, as OpenSCvx knows no integrals.
"""

import jax.numpy as jnp
import numpy as np
import openscvx as ox

from .second_model import dynamics, integrands

# OpenSCvx wants finite limits: where there are none, the guess's and so many scales more.
WIDE = 4.0
# Of the guess's energy and flight time, and of the data required, the most allowed.
MOST = 2.0
# Of cost and proximal term; by default OpenSCvx's own.
WEIGHTS = {"default": {}, "tuned": {"lam_cost": 1.0, "lam_prox": 0.01}}


def openscvx_problem(case: dict, weights: str, scales: str, precision: str) -> ox.Problem:
    """Held controls on a uniform grid, limits at the nodes, a free flight time.

    **Arguments:**

    - `scales`: of the motion: "jaxscp" for jaxscp's, "limits" for those that OpenSCvx
        makes of the limits.
    """
    final_time = case["guess"]["final_time"]
    motion, control, total = _motion(case, scales), _control(case), _total(case)
    return ox.Problem(
        dynamics={},
        constraints=[],
        states=[motion, total],
        controls=[control],
        N=len(case["fractions"]),
        time=ox.Time(
            initial=0.0,
            final=("free", final_time),
            min=0.0,
            max=MOST * final_time,
            uniform_time_grid=True,
        ),
        algorithm=dict(WEIGHTS[weights]),
        byof={
            "dynamics": _rates(case, motion, control, total),
            "nodal_constraints": [*_buildings(case, motion), *_data(case, total)],
        },
        float_dtype=precision,
    )


def _motion(case: dict, kind: str) -> ox.State:
    """Position, velocity, angles and body rates."""
    guess = np.array(case["guess"]["states"])
    low, high, scales = (
        np.array(case[what]["states"][1]) for what in ("lower", "upper", "scales")
    )
    motion = ox.State("motion", shape=(12,))
    beyond = guess.min(axis=0) - WIDE * scales, guess.max(axis=0) + WIDE * scales
    motion.min = np.where(np.isfinite(low), low, beyond[0])
    motion.max = np.where(np.isfinite(high), high, beyond[1])
    if kind == "jaxscp":
        motion.scaling_min, motion.scaling_max = -scales, scales
    motion.initial, motion.final = list(guess[0]), list(guess[-1])
    motion.guess = guess
    return motion


def _control(case: dict) -> ox.Control:
    control = ox.Control("control", shape=(4,), parameterization="ZOH")
    control.min = np.array(case["lower"]["controls"][0])
    control.max = np.array(case["upper"]["controls"][0])
    control.guess = np.array(case["guess"]["controls"])
    return control


def _total(case: dict) -> ox.State:
    """Data, where there are any to send, and energy in units of the guess's."""
    sums = len(_ends(case))
    total = ox.State("total", shape=(sums,))
    total.min, total.max = np.zeros(sums), np.full(sums, MOST)
    total.initial, total.final = [0.0] * sums, _ends(case)
    total.guess = np.outer(case["fractions"], np.ones(sums))
    return total


def _ends(case: dict) -> list[tuple[str, float]]:
    data = [] if case["mission"]["data_required"] is None else [("free", 1.0)]
    return [*data, ("minimize", 1.0)]


def _rates(case: dict, motion: ox.State, control: ox.Control, total: ox.State) -> dict:
    mission, guess = case["mission"], case["guess"]
    power = np.mean(np.sum(np.square(guess["controls"]), axis=1))
    energy = float(power * guess["final_time"])

    def moving(x, u, node, parameters):
        x, u = x[motion.slice], u[control.slice]
        return jnp.stack(dynamics(jnp, mission["vehicle"], x, u))

    def growing(x, u, node, parameters):
        *data, cost = integrands(jnp, mission, x[motion.slice], u[control.slice])
        return jnp.stack([*data, cost / energy])

    return {"motion": moving, "total": growing}


def _buildings(case: dict, motion: ox.State) -> list[dict]:
    def outside(place, safe):
        def residual(x, u, node, parameters):
            east, north = x[motion.slice][0] - place[0], x[motion.slice][1] - place[1]
            return 1.0 - (east**2 + north**2) / safe**2

        return {"constraint_fn": residual}

    pairs = zip(*case["mission"]["obstacles"].values(), strict=True)
    return [outside(place, safe) for place, safe in pairs]


def _data(case: dict, total: ox.State) -> list[dict]:
    """All data are sent in the end."""
    if case["mission"]["data_required"] is None:
        return []

    def missing(x, u, node, parameters):
        return 1.0 - x[total.slice][0]

    return [{"constraint_fn": missing, "nodes": [len(case["fractions"]) - 1]}]
