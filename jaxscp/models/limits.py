"""`Limits`: what a quadrotor may do."""

import math

import equinox as eqx

from .._types import Array, Float, Scalar
from ._parameters import Numbers, parameter


class Limits(eqx.Module):
    """Limits of attitude and control (paper, eqs. 5c to 5f and Table I).

    **Arguments:** the paper leaves thrust and torques open; the defaults are a choice,
    the thrust being what the default rotors lift together.

    - `tilt`: largest roll and largest pitch, either way [rad].
    - `thrust`: largest total thrust [N].
    - `torque`: largest torque about each body axis, either way, shape (3,) [N m].

    **Raises:** `ValueError` unless each is positive.
    """

    tilt: Scalar
    thrust: Scalar
    torque: Float[Array, "3"]

    def __init__(
        self,
        tilt: Numbers = 35 * math.pi / 180,
        thrust: Numbers = 58.86,
        torque: Numbers = (1.0, 1.0, 0.5),
    ):
        # At 90 degrees of pitch the Euler angles are singular.
        self.tilt = parameter(
            "Limits.tilt", tilt, above=0.0, at_most=math.radians(89), unit="rad"
        )
        self.thrust = parameter("Limits.thrust", thrust, above=0.0, unit="N")
        self.torque = parameter(
            "Limits.torque", torque, shape=(3,), above=0.0, unit="N m"
        )
