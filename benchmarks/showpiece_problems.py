"""Brachistochrone and drone of OpenSCvx 0.5.2's examples, posed in jaxscp.

All numbers are those of its `examples/abstract/brachistochrone.py` and
`examples/drone/obstacle_avoidance.py`, odd ones included.
"""

from typing import NamedTuple

import jax.numpy as jnp

import jaxscp
from jaxscp import Bounds, OptimalControlProblem
from jaxscp.models.systems import Brachistochrone, elapsed_time

# Limits of the state hold in each half of every interval, as OpenSCvx's do all along.
FIRST_ORDER = jaxscp.Discretization(jaxscp.FirstOrderHold(), between=2)
# Seconds of the flight, guessed; OpenSCvx lets it become 0.3 times as long.
SHORTEST = 0.3


class Showpiece(NamedTuple):
    """A problem, how it is discretized and where its solve starts.

    - `known`: the optimum of the continuous problem, where there is one.
    """

    problem: OptimalControlProblem
    guess: jaxscp.Trajectory
    discretization: jaxscp.Discretization
    known: float | None = None


def line(states, controls, seconds: float, nodes: int) -> jaxscp.Trajectory:
    """The examples' guess: state and control between their first and last values."""
    shares = jnp.linspace(0.0, 1.0, nodes)

    def between(ends):
        first, last = (jnp.asarray(end, float) for end in ends)
        return first[None] + shares[:, None] * (last - first)[None]

    return jaxscp.Trajectory(
        shares, between(states), between(controls), jnp.asarray(seconds)
    )


def turned(vector, scalar, arrow):
    """An arrow turned by a quaternion, times the square of its length."""
    across = jnp.cross(vector, arrow)
    along = (scalar**2 - vector @ vector) * arrow + 2 * (vector @ arrow) * vector
    return along + 2 * scalar * across


def turning(vector, scalar, rates):
    """Derivatives of a quaternion's vector and scalar under body rates [rad/s]."""
    vector_rate = 0.5 * (scalar * rates + jnp.cross(vector, rates))
    return vector_rate, -0.5 * (vector @ rates)


def brachistochrone(nodes: int = 2) -> Showpiece:
    """Down from rest at (0, 10) to (10, 5) [m] in least time.

    `jaxscp.textbook` has it without the example's limits, of which two are felt: the
    cycloid ends 0.007 degrees beyond 100.5, and is as fast as 10.07 m/s at its lowest.
    """
    steepest = jnp.array([100.5]) * jnp.pi / 180
    problem = OptimalControlProblem(
        Brachistochrone(9.81),
        state=Bounds(jnp.zeros(3), jnp.full(3, 10.0)),
        control=Bounds(jnp.zeros(1), steepest),
        initial_state=Bounds.exactly([0.0, 10.0, 0.0]),
        final_state=Bounds([10.0, 5.0, -jnp.inf], [10.0, 5.0, jnp.inf]),
        final_time=Bounds(SHORTEST * 2.0, 2.0),
        terminal_cost=elapsed_time,
        state_names=("x", "y", "speed"),
        control_names=("angle",),
    )
    states = ([0.0, 10.0, 0.0], [10.0, 5.0, 10.0])
    guess = line(states, (jnp.array([5.0]) * jnp.pi / 180, steepest), 2.0, nodes)
    # A cycloid through both ends: 1.8012955 s, see `jaxscp.textbook`.
    return Showpiece(problem, guess, FIRST_ORDER, known=1.8012955)


# Of the drone: thrust [N] at most, mass 1 kg, inertia 1 kg m^2 about each axis, and the
# example's gravity [m/s^2], which is 9.18 and not 9.81.
THRUST, TORQUE, GRAVITY = 4.179446268 * 9.81, (18.665, 18.665, 0.55562), 9.18
# Its obstacles: centers [m], common axes (columns) and inverse squared half axes
# [1/m^2], as the example draws them with JAX's and NumPy's seeds 0.
CENTERS = ((-5.1, 0.1, 2.0), (0.1, 0.1, 2.0), (5.1, 0.1, 2.0))
AXES = (
    (-0.8601148, 0.34324238, 0.37734184),
    (-0.42536962, -0.074347615, -0.9019607),
    (-0.28153667, -0.9362996, 0.20995244),
)
INVERSE_HALF_AXES = (
    (0.648813504, 0.815189366, 0.702763376),
    (0.644883183, 0.523654799, 0.745894113),
    (0.537587211, 0.991773001, 1.063662761),
)


def drone(nodes: int = 6) -> Showpiece:
    """Past three ellipsoids from rest, 20 m in least time; attitude free at both ends.

    State: position, velocity, quaternion (w first), body rates; control: thrust along
    the body's z and three torques.
    """
    rates, limits = jnp.full(3, 10.0), jnp.array([THRUST, *TORQUE])
    free = jnp.full(7, jnp.inf)
    low = jnp.array([-200.0, -100.0, 0.0, *[-100.0] * 3, *[-1.0] * 4])
    high = jnp.array([200.0, 10.0, 20.0, *[100.0] * 3, *[1.0] * 4])
    rest, ahead = [10.0, 0.0, 2.0, 0.0, 0.0, 0.0], [-10.0, 0.0, 2.0]
    start, end = jnp.array(rest), jnp.array(ahead)
    problem = OptimalControlProblem(
        _drone_rates,
        state=Bounds(jnp.append(low, -rates), jnp.append(high, rates)),
        control=Bounds(limits * jnp.array([0.0, -1.0, -1.0, -1.0]), limits),
        initial_state=Bounds(jnp.append(start, -free), jnp.append(start, free)),
        final_state=Bounds(
            jnp.concatenate([end, jnp.full(10, -jnp.inf)]),
            jnp.concatenate([end, jnp.full(10, jnp.inf)]),
        ),
        final_time=Bounds(SHORTEST * 4.0, 4.0),
        terminal_cost=elapsed_time,
        path_constraints={"ellipsoids": _inside},
    )
    level = [1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]
    states = ([*rest, *level], [*ahead, 0.0, 0.0, 0.0, *level])
    full = [THRUST, 0.0, 0.0, 0.0]
    return Showpiece(problem, line(states, (full, full), 4.0, nodes), FIRST_ORDER)


def _drone_rates(t, x, u):
    """Rigid body with the quaternion normalized wherever it is used, as the example's."""
    del t
    unit = x[6:10] / jnp.linalg.norm(x[6:10])
    scalar, vector = unit[0], unit[1:]
    lift = turned(vector, scalar, jnp.array([0.0, 0.0, u[0]]))
    fall = jnp.array([0.0, 0.0, GRAVITY])
    along, real = turning(vector, scalar, x[10:13])
    return jnp.concatenate([x[3:6], lift - fall, real[None], along, u[1:4]])


def _inside(t, x, u):
    """How deep in each ellipsoid, 1 at its center."""
    del t, u
    away = (x[None, :3] - jnp.array(CENTERS)) @ jnp.array(AXES)
    return 1.0 - jnp.sum((away * jnp.array(INVERSE_HALF_AXES)) ** 2, axis=1)
