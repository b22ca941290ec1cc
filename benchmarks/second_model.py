"""A mission's equations written a second time, for whatever module has the functions:
CasADi's symbols, NumPy's numbers, complex ones too, or JAX's arrays.
"""

import math
from collections.abc import Callable


def dynamics(module, vehicle: dict, x, u) -> list:
    """Time derivative of the quadrotor's state."""
    sin, cos = module.sin, module.cos
    roll, pitch, yaw, p, q, r = (x[entry] for entry in range(6, 12))
    jx, jy, jz = vehicle["inertia"]
    lift, lean = u[0] / vehicle["mass"], sin(pitch) * cos(roll)
    turn = (q * sin(roll) + r * cos(roll)) / cos(pitch)
    return [
        *(x[3], x[4], x[5]),
        lift * (cos(yaw) * lean + sin(yaw) * sin(roll)),
        lift * (sin(yaw) * lean - cos(yaw) * sin(roll)),
        lift * cos(pitch) * cos(roll) - vehicle["gravity"],
        *(p + sin(pitch) * turn, q * cos(roll) - r * sin(roll), turn),
        (u[1] + (jy - jz) * q * r) / jx,
        (u[2] + (jz - jx) * p * r) / jy,
        (u[3] + (jx - jy) * p * q) / jz,
    ]


def data_rate(module, channel: dict, x):
    """Expected rate [bit/s] at a state's position."""
    east, north, up = (x[i] - channel["ground_station"][i] for i in range(3))
    level = east**2 + north**2
    elevation = module.atan(up / module.sqrt(level + 1e-6)) * 180 / math.pi
    threshold, steepness = channel["environment"]
    sight = 1 / (1 + threshold * module.exp(-steepness * (elevation - threshold)))
    zeta = channel["reflection_attenuation"]
    log_distance = module.log(level + up**2 + 1e-6) / 2
    loss = module.exp(-channel["path_loss_exponent"] * log_distance)
    snr = channel["snr_constant"] * (zeta + (1 - zeta) * sight) * loss
    return channel["bandwidth"] * module.log1p(snr) / math.log(2)


def integrands(module, mission: dict, x, u) -> list:
    """Share of the data sent per second, if any are to be, and running cost."""
    rates = [sum(u[entry] ** 2 for entry in range(4))]
    if mission["data_required"] is not None:
        share = data_rate(module, mission["channel"], x) / mission["data_required"]
        rates.insert(0, share)
    return rates


def runge_kutta(rates: Callable, y, seconds, steps: int):
    """The end of so many classical steps of equal length."""
    h = seconds / steps
    for _ in range(steps):
        k1 = rates(y)
        k2 = rates(y + h / 2 * k1)
        k3 = rates(y + h / 2 * k2)
        k4 = rates(y + h * k3)
        y = y + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    return y
