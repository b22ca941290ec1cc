"""`Quadrotor`: a rigid body with four rotors."""

import equinox as eqx
import jax.numpy as jnp

from .._types import Array, Float, Scalar
from ._parameters import Numbers, parameter


class Rotors(eqx.Module):
    """Four equal rotors, each with thrust C_T Omega^2 (paper, Section II-A).

    **Arguments:**

    - `thrust_coefficient`: C_T [N s^2]. The paper gives none; with the default, four
        rotors at 600 rad/s lift twice the weight of its vehicle, 58.86 N.
    - `drag_ratio`: torque about the rotor's axis per newton of its thrust [m]. The
        default is common for small propellers, and lets them turn the paper's vehicle
        about its vertical axis with 0.5 N m.
    - `maximum_speed`: [rad/s] (paper, Table I).

    **Raises:** `ValueError` unless each is positive.
    """

    thrust_coefficient: Scalar
    drag_ratio: Scalar
    maximum_speed: Scalar

    def __init__(
        self,
        thrust_coefficient: Numbers = 58.86 / (4 * 600.0**2),
        drag_ratio: Numbers = 0.017,
        maximum_speed: Numbers = 600.0,
    ):
        self.thrust_coefficient = parameter(
            "Rotors.thrust_coefficient", thrust_coefficient, above=0.0, unit="N s^2"
        )
        self.drag_ratio = parameter("Rotors.drag_ratio", drag_ratio, above=0.0, unit="m")
        self.maximum_speed = parameter(
            "Rotors.maximum_speed", maximum_speed, above=0.0, unit="rad/s"
        )

    @property
    def thrust_limit(self) -> Scalar:
        """Largest thrust of one rotor [N]."""
        return self.thrust_coefficient * self.maximum_speed**2


class Quadrotor(eqx.Module):
    r"""Rigid-body dynamics under total thrust and three torques (paper, eq. 1).

    $$\dot r = v,\quad \dot v = -g e_3 + \tfrac{1}{m} R(\eta) e_3 F,\quad
      \dot\eta = W(\eta)\,\omega,\quad
      \dot\omega = J^{-1}(\tau - \omega \times J\omega)$$

    The earth frame's z points up. R = Rz(yaw) Ry(pitch) Rx(roll) turns body into earth
    coordinates, and thrust acts along the body's z. At a pitch of 90 degrees the angles
    no longer determine the attitude, and their rates are infinite.

    - State, 12 entries: position [m], velocity [m/s], (roll, pitch, yaw) [rad], body
        rates (p, q, r) [rad/s].
    - Control, 4 entries: thrust [N], torques about the body's x, y, z [N m].

    Rotors stand in a plus, numbered 1 at +x (front), 2 at +y (left), 3 at -x, 4 at -y.
    Rotors 1 and 3 turn clockwise seen from above, so that their drag turns the body
    counterclockwise, its positive yaw; 2 and 4 turn the other way.

    **Arguments:** the defaults are those of the paper's Table I.

    - `mass` [kg], `arm_length` [m] from the centre to each rotor, `gravity` [m/s^2].
    - `inertia`: moments about the body's principal axes, shape (3,) [kg m^2].
    - `rotors`: a [`Rotors`][].

    **Raises:** `ValueError` unless each is positive (gravity may be zero).
    """

    mass: Scalar
    arm_length: Scalar
    inertia: Float[Array, "3"]
    gravity: Scalar
    rotors: Rotors

    def __init__(
        self,
        mass: Numbers = 3.0,
        arm_length: Numbers = 0.3,
        inertia: Numbers = (0.04, 0.04, 0.08),
        gravity: Numbers = 9.81,
        rotors: Rotors | None = None,
    ):
        self.mass = parameter("Quadrotor.mass", mass, above=0.0, unit="kg")
        self.arm_length = parameter(
            "Quadrotor.arm_length", arm_length, above=0.0, unit="m"
        )
        self.inertia = parameter(
            "Quadrotor.inertia", inertia, shape=(3,), above=0.0, unit="kg m^2"
        )
        self.gravity = parameter("Quadrotor.gravity", gravity, at_least=0.0, unit="m/s^2")
        self.rotors = Rotors() if rotors is None else rotors

    def __call__(
        self, t: Scalar, x: Float[Array, "12"], u: Float[Array, "4"]
    ) -> Float[Array, "12"]:
        """Time derivative of the state."""
        del t
        # Written out by entries: no 3 x 3 matrix is formed or inverted, each sine and
        # cosine is taken once, and all of it fuses into one loop over the nodes.
        _, _, _, vx, vy, vz, roll, pitch, yaw, p, q, r = x
        thrust, roll_torque, pitch_torque, yaw_torque = u
        jx, jy, jz = self.inertia
        sin_roll, cos_roll = jnp.sin(roll), jnp.cos(roll)
        sin_pitch, cos_pitch = jnp.sin(pitch), jnp.cos(pitch)
        sin_yaw, cos_yaw = jnp.sin(yaw), jnp.cos(yaw)
        lift = thrust / self.mass
        lean = sin_pitch * cos_roll
        yaw_rate = (q * sin_roll + r * cos_roll) / cos_pitch
        return jnp.stack(
            [
                vx,
                vy,
                vz,
                # The third column of R, times thrust over mass.
                lift * (cos_yaw * lean + sin_yaw * sin_roll),
                lift * (sin_yaw * lean - cos_yaw * sin_roll),
                lift * cos_pitch * cos_roll - self.gravity,
                # W omega; its first row is p + tan(pitch) (q sin(roll) + r cos(roll)).
                p + sin_pitch * yaw_rate,
                q * cos_roll - r * sin_roll,
                yaw_rate,
                # Euler's equations about principal axes.
                (roll_torque + (jy - jz) * q * r) / jx,
                (pitch_torque + (jz - jx) * p * r) / jy,
                (yaw_torque + (jx - jy) * p * q) / jz,
            ]
        )

    @property
    def hover_thrust(self) -> Scalar:
        """Thrust that carries the weight [N]."""
        return self.mass * self.gravity

    @property
    def hover_control(self) -> Float[Array, "4"]:
        """Control that keeps the level vehicle where it is [N, N m]."""
        return jnp.zeros(4).at[0].set(self.hover_thrust)

    @property
    def thrust_limit(self) -> Scalar:
        """Total thrust with every rotor at its maximum speed [N]."""
        return 4 * self.rotors.thrust_limit

    @property
    def torque_limits(self) -> Float[Array, "3"]:
        """Largest torque about each body axis, taken alone [N m].

        Roll and pitch come from one rotor at maximum speed and the opposite one at
        rest, yaw from one pair at maximum speed and the other at rest. They are not
        reached together, nor at full thrust: `rotor_speeds` tells.
        """
        tilting = self.arm_length * self.rotors.thrust_limit
        turning = 2 * self.rotors.drag_ratio * self.rotors.thrust_limit
        return jnp.stack([tilting, tilting, turning])

    def control_from_rotors(
        self, rotor_speeds: Float[Array, "*batch 4"]
    ) -> Float[Array, "*batch 4"]:
        """Thrust [N] and torques [N m] of four rotor speeds [rad/s].

        A negative speed stands for thrust downward, as in `rotor_speeds`.
        """
        forces = self.rotors.thrust_coefficient * rotor_speeds * jnp.abs(rotor_speeds)
        front, left, back, right = (forces[..., rotor] for rotor in range(4))
        return jnp.stack(
            [
                front + left + back + right,
                self.arm_length * (left - right),
                self.arm_length * (back - front),
                self.rotors.drag_ratio * (front - left + back - right),
            ],
            axis=-1,
        )

    def rotor_speeds(self, control: Float[Array, "*batch 4"]) -> Float[Array, "*batch 4"]:
        """Speeds of the four rotors [rad/s] that give thrust [N] and torques [N m].

        Nothing is clipped, so that a control the rotors cannot give stays visible: a
        speed above `rotors.maximum_speed` is too fast, and a negative one belongs to a
        rotor that would have to push down, with the square root taken of its size.
        """
        thrust, roll_torque, pitch_torque, yaw_torque = (
            control[..., entry] / 4 for entry in range(4)
        )
        roll = 2 * roll_torque / self.arm_length
        pitch = 2 * pitch_torque / self.arm_length
        yaw = yaw_torque / self.rotors.drag_ratio
        forces = jnp.stack(
            [
                thrust - pitch + yaw,
                thrust + roll - yaw,
                thrust + pitch + yaw,
                thrust - roll - yaw,
            ],
            axis=-1,
        )
        squared = forces / self.rotors.thrust_coefficient
        # The root has an infinite slope at zero; a rotor at rest gets slope zero.
        turning = squared != 0
        size = jnp.sqrt(jnp.where(turning, jnp.abs(squared), 1.0))
        return jnp.where(turning, jnp.sign(squared) * size, 0.0)
