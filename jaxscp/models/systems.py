"""Small systems and costs of the textbooks, as functions of (t, x, u)."""

import equinox as eqx
import jax.numpy as jnp

from .._types import Array, Control, Float, Scalar, State
from ._parameters import Numbers, parameter


def double_integrator(
    t: Scalar, x: Float[Array, "2"], u: Float[Array, "1"]
) -> Float[Array, "2"]:
    """Position and velocity under a chosen acceleration."""
    del t
    return jnp.stack([x[1], u[0]])


def linear_hypersensitive(
    t: Scalar, x: Float[Array, "1"], u: Float[Array, "1"]
) -> Float[Array, "1"]:
    """A decaying state, x' = -x + u, whose adjoint grows as fast as it decays."""
    del t
    return u - x


class Brachistochrone(eqx.Module):
    """A bead without friction on a wire; the control is the wire's direction.

    - State: horizontal position x [m], height y [m], speed v [m/s].
    - Control: angle between the wire and straight down [rad], positive toward x.

    **Arguments:** `gravity` [m/s^2], not negative.
    """

    gravity: Scalar

    def __init__(self, gravity: Numbers = 9.81):
        self.gravity = parameter(
            "Brachistochrone.gravity", gravity, at_least=0.0, unit="m/s^2"
        )

    def __call__(
        self, t: Scalar, x: Float[Array, "3"], u: Float[Array, "1"]
    ) -> Float[Array, "3"]:
        """Time derivative of the state."""
        del t
        speed, angle = x[2], u[0]
        down = jnp.cos(angle)
        return jnp.stack([speed * jnp.sin(angle), -speed * down, self.gravity * down])


def control_energy(t: Scalar, x: State, u: Control) -> Scalar:
    """u'u, the paper's running cost (paper, eq. 5a)."""
    del t, x
    return jnp.sum(u * u)


def half_control_energy(t: Scalar, x: State, u: Control) -> Scalar:
    """u'u / 2."""
    return 0.5 * control_energy(t, x, u)


def half_state_and_control_energy(t: Scalar, x: State, u: Control) -> Scalar:
    """(x'x + u'u) / 2."""
    return 0.5 * jnp.sum(x * x) + half_control_energy(t, x, u)


def elapsed_time(t_f: Scalar, x_f: State) -> Scalar:
    """The final time, as a terminal cost."""
    del x_f
    return t_f
