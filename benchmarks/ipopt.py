"""The paper's missions beside CasADi and IPOPT: python -m benchmarks.ipopt

The same discrete problem (held controls, classical Runge-Kutta with as many substeps as
jaxscp ended with, integrals along the flow, limits at the nodes) from the same guess in
the same run. IPOPT has its default settings and exact derivatives; the model is written
again in CasADi. Needs the `bench` extra.
"""

import argparse
import time

import casadi as ca
import jax
import numpy as np

from jaxscp import missions

from .timing import timed_solve

MISSIONS = ("free-flight", "free-space-30MB-60dB")


def rates(mission, x, u):
    """State derivative, data rate if there is any, and running cost."""
    vehicle = mission.vehicle
    roll, pitch, yaw, p, q, r = (x[entry] for entry in range(6, 12))
    jx, jy, jz = map(float, vehicle.inertia)
    lift, lean = u[0] / float(vehicle.mass), ca.sin(pitch) * ca.cos(roll)
    turn = (q * ca.sin(roll) + r * ca.cos(roll)) / ca.cos(pitch)
    rows = [
        *(x[3], x[4], x[5]),
        lift * (ca.cos(yaw) * lean + ca.sin(yaw) * ca.sin(roll)),
        lift * (ca.sin(yaw) * lean - ca.cos(yaw) * ca.sin(roll)),
        lift * ca.cos(pitch) * ca.cos(roll) - float(vehicle.gravity),
        *(p + ca.sin(pitch) * turn, q * ca.cos(roll) - r * ca.sin(roll), turn),
        (u[1] + (jy - jz) * q * r) / jx,
        (u[2] + (jz - jx) * p * r) / jy,
        (u[3] + (jx - jy) * p * q) / jz,
    ]
    if mission.data_required is not None:
        rows.append(data_rate(mission.channel, x[:3]) / float(mission.data_required))
    return ca.vertcat(*rows, ca.sumsqr(u))


def data_rate(channel, place):
    """Expected rate [bit/s] at a position."""
    away = place - np.asarray(channel.ground_station)
    level = ca.sqrt(away[0] ** 2 + away[1] ** 2 + 1e-6)
    elevation = ca.atan2(away[2], level) * 180 / np.pi
    threshold, steepness = map(float, channel.environment)
    sight = 1 / (1 + threshold * ca.exp(-steepness * (elevation - threshold)))
    zeta = float(channel.reflection_attenuation)
    distance = ca.sqrt(ca.sumsqr(away) + 1e-6)
    gain = (zeta + (1 - zeta) * sight) * distance ** -float(channel.path_loss_exponent)
    snr = float(channel.snr_constant) * gain
    return float(channel.bandwidth) * ca.log1p(snr) / np.log(2)


def interval(mission, substeps: int) -> ca.Function:
    """State and growth of the integrals at the end of one interval."""
    x, u, seconds = ca.SX.sym("x", 12), ca.SX.sym("u", 4), ca.SX.sym("seconds")
    extra = rates(mission, x, u).numel() - 12
    y, h = ca.vertcat(x, ca.SX.zeros(extra)), seconds / substeps
    for _ in range(substeps):
        k1 = rates(mission, y, u)
        k2 = rates(mission, y + h / 2 * k1, u)
        k3 = rates(mission, y + h / 2 * k2, u)
        k4 = rates(mission, y + h * k3, u)
        y = y + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    return ca.Function("interval", [x, u, seconds], [y[:12], y[12:]])


def ipopt(mission, guess, substeps: int) -> dict:
    """Solve with IPOPT; seconds are its own, without building the problem."""
    problem, nodes = mission.problem(), guess.nodes
    states, controls = ca.MX.sym("X", 12, nodes), ca.MX.sym("U", 4, nodes - 1)
    final = ca.MX.sym("T")
    widths = ca.DM(np.diff(np.asarray(guess.fractions))).T
    ends, growth = interval(mission, substeps).map(nodes - 1)(
        states[:, :-1], controls, final * widths
    )
    constraints = [ca.vec(states[:, 1:] - ends)]
    lower, upper = [np.zeros(12 * (nodes - 1))], [np.zeros(12 * (nodes - 1))]
    if mission.data_required is not None:
        constraints.append(ca.sum2(growth[0, :]))
        lower, upper = [*lower, [1.0]], [*upper, [np.inf]]
    cost = ca.sum2(growth[-1, :])
    bounds = []
    for side in ("lower", "upper"):
        inner = np.tile(np.asarray(getattr(problem.state, side)), (nodes, 1))
        inner[0] = np.asarray(problem.initial_state.target)
        inner[-1] = np.asarray(problem.final_state.target)
        held = np.tile(np.asarray(getattr(problem.control, side)), (nodes - 1, 1))
        end = float(np.asarray(getattr(problem.final_time, side)))
        bounds.append(np.concatenate([inner.ravel(), held.ravel(), [end]]))
    solver = ca.nlpsol(
        "solver",
        "ipopt",
        {
            "x": ca.vertcat(ca.vec(states), ca.vec(controls), final),
            "f": cost,
            "g": ca.vertcat(*constraints),
        },
        {"print_time": False, "ipopt.print_level": 0, "ipopt.sb": "yes"},
    )
    start = np.concatenate(
        [
            np.asarray(guess.states).ravel(),
            np.asarray(guess.controls)[:-1].ravel(),
            [float(guess.final_time)],
        ]
    )
    begun = time.perf_counter()
    found = solver(
        x0=start,
        lbx=bounds[0],
        ubx=bounds[1],
        lbg=np.concatenate(lower),
        ubg=np.concatenate(upper),
    )
    seconds, outcome = time.perf_counter() - begun, solver.stats()
    return {
        "objective": float(found["f"]),
        "seconds": seconds,
        "iterations": outcome["iter_count"],
        "status": outcome["return_status"],
    }


def measure(name: str, nodes: int, repeats: int) -> None:
    """Print one row for each solver."""
    mission = missions.get(name)
    problem, guess = mission.problem(), mission.guess(nodes)
    solution, _, ours = timed_solve(problem, guess, repeats)
    statistic = solution.statistics
    count = int(statistic.iterations + statistic.polish_iterations)
    print(
        f"| {name} | jaxscp | {float(solution.objective):,.2f} | {count} | {ours:.2f} |"
        f" {'converged' if bool(solution.converged) else 'no'} | |",
        flush=True,
    )
    theirs = ipopt(mission, guess, int(statistic.substeps))
    print(
        f"| {name} | IPOPT | {theirs['objective']:,.2f} | {theirs['iterations']} |"
        f" {theirs['seconds']:.2f} | {theirs['status']} |"
        f" {theirs['seconds'] / ours:.0f} times |",
        flush=True,
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--missions", nargs="*", default=list(MISSIONS))
    parser.add_argument("--nodes", type=int, default=100)
    parser.add_argument("--repeats", type=int, default=5)
    arguments = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    print("| mission | solver | objective | iterations | s | status | jaxscp faster by |")
    print("|---|---|---|---|---|---|---|")
    for name in arguments.missions:
        measure(name, arguments.nodes, arguments.repeats)


if __name__ == "__main__":
    main()
