"""The states and controls of a mission: their units, sizes, and which have limits."""

import numpy as np

STATE_UNITS = {
    **dict.fromkeys(("x", "y", "z"), "m"),
    **dict.fromkeys(("vx", "vy", "vz"), "m/s"),
    **dict.fromkeys(("roll", "pitch", "yaw"), "rad"),
    **dict.fromkeys(("p", "q", "r"), "rad/s"),
}
CONTROL_UNITS = {
    "thrust": "N",
    **dict.fromkeys(("roll_torque", "pitch_torque", "yaw_torque"), "N m"),
}
UNITS = {
    **STATE_UNITS,
    **CONTROL_UNITS,
    "buildings": "m",
    "data": "bit",
    "objective": "N^2 s",
}
# The states that have limits.
ALTITUDE, TILTS = 2, slice(6, 8)
# Typical size of each state, for the automatic scaling: how far it moves in a flight of
# half a kilometre where no limit says so. NaN leaves roll and pitch to their limits.
STATE_SCALES = np.array(
    [250.0, 250.0, 50.0, 10.0, 10.0, 10.0, np.nan, np.nan, 0.5, 1.0, 1.0, 1.0]
)


def limited(floor: bool) -> tuple[tuple[bool, ...], tuple[bool, ...]]:
    """Which states have a lower and which an upper limit: altitude, roll and pitch."""
    upper = np.zeros(12, bool)
    upper[TILTS] = True
    lower = upper.copy()
    lower[ALTITUDE] = floor
    return tuple(lower.tolist()), tuple(upper.tolist())
