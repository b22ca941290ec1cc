"""Both powered landings of OpenSCvx 0.5.2's examples, posed in jaxscp.

All numbers are those of its `examples/rocket/3DoF_pdg.py` and `6DoF_pdg.py`, odd ones
included. jaxscp has no second-order cones: limits on norms are smooth path constraints,
squared where the norm may vanish and the constraint still has a slope, with a rounded
tip elsewhere.
"""

import math

import jax.numpy as jnp

import jaxscp
from jaxscp import Bounds, OptimalControlProblem

from .showpiece_problems import SHORTEST, Showpiece, line, turned, turning

ZERO_ORDER = jaxscp.Discretization(between=2)
FIRST_ORDER = jaxscp.Discretization(jaxscp.FirstOrderHold(), between=2)


def norm(vector, tip: float):
    """Length of a vector, `tip` at zero and there with a slope."""
    return jnp.sqrt(vector @ vector + tip**2)


# Of the 3-DoF lander: engines, thrust of each [N], cant of the engines [rad], specific
# impulse [s], gravity of Mars and of Earth [m/s^2].
ENGINES, ENGINE_THRUST, CANT, IMPULSE = 6, 3100.0, math.radians(27.0), 225.0
MARS, EARTH = 3.7114, 9.807
# 30 and 80 % of the engines' thrust, along the vehicle's axis [N].
LEAST, MOST = (share * ENGINES * ENGINE_THRUST * math.cos(CANT) for share in (0.3, 0.8))
# The example means 40 degrees and takes cos(180 - 40 pi / 180), of radians: 167 degrees
# are allowed.
POINTING = math.cos(180 - 40 * math.pi / 180)
GLIDE = math.tan(math.radians(86.0))


def landing_3dof(nodes: int = 10) -> Showpiece:
    """Land on Mars with most mass left. State: position, velocity, mass; SI units."""
    fastest = 500 / 3.6
    start = jnp.array([2000.0, 0.0, 1500.0, 80.0, 30.0, -75.0, 1905.0])
    sides = jnp.full(3, 3000.0)
    speeds = jnp.full(3, fastest)
    box = jnp.full(3, ENGINES * ENGINE_THRUST)
    problem = OptimalControlProblem(
        _lander_rates,
        state=Bounds(
            jnp.concatenate([-sides.at[2].set(0.0), -speeds, jnp.array([1505.0])]),
            jnp.concatenate([sides, speeds, jnp.array([1905.0])]),
        ),
        control=Bounds(-box, box),
        initial_state=Bounds.exactly(start),
        final_state=Bounds(
            jnp.zeros(7).at[6].set(-jnp.inf), jnp.zeros(7).at[6].set(jnp.inf)
        ),
        final_time=Bounds(SHORTEST * 95.0, 100.0),
        terminal_cost=_mass_lost,
        path_constraints={
            "thrust": _thrust_out_of_range,
            "pointing": _pointing,
            "glide slope": _below_glide_slope,
        },
        state_names=("x", "y", "z", "v_x", "v_y", "v_z", "mass"),
    )
    end = jnp.zeros(7).at[6].set(1690.0)
    push = [0.0, 0.0, ENGINES * 0.8 * ENGINE_THRUST / 2]
    guess = line((start, end), (push, push), 95.0, nodes)
    return Showpiece(problem, guess, ZERO_ORDER)


def _lander_rates(t, x, u):
    del t
    flow = norm(u, 1.0) / (IMPULSE * EARTH * math.cos(CANT))
    pull = jnp.array([0.0, 0.0, MARS])
    return jnp.concatenate([x[3:6], u / x[6] - pull, -flow[None]])


def _mass_lost(t_f, x_f):
    """Less the final mass [kg]."""
    del t_f
    return -x_f[6]


def _thrust_out_of_range(t, x, u):
    """Squared thrust beyond either limit, in squares of the larger."""
    del t, x
    squared = u @ u / MOST**2
    return jnp.stack([(LEAST / MOST) ** 2 - squared, squared - 1.0])


def _pointing(t, x, u):
    del t, x
    return (POINTING * norm(u, 1.0) - u[2])[None] / MOST


def _below_glide_slope(t, x, u):
    """[m]; the tip, 0.1 m, keeps a slope where the vehicle lands."""
    del t, u
    return (norm(x[:2], 0.1) - 0.1 - GLIDE * x[2])[None]


# Of the 6-DoF lander, in units of its length, mass and gravity.
INERTIA = (0.168 * 2e-2, 0.168, 0.168)
ARM, PRESSURE_ARM, DRY, SPEED, TURN = 0.25, 0.05, 1.0, 3.0, 0.3752
GIMBAL, TILT, SLOPE = (math.radians(angle) for angle in (20.0, 75.0, 75.0))
WEAKEST, STRONGEST, EXHAUST, LEAK = 1.5, 6.5, 30.0, 0.01
# Of density 1 and area 0.5; along the body's x, and across.
DRAG = (0.125, 0.25, 0.25)
SPIN = 1e-8


def landing_6dof(nodes: int = 5) -> Showpiece:
    """Land upright with most mass left; the attitude at first is free.

    State: mass, position (x upward), velocity, quaternion (scalar last), body rates;
    control: thrust in the body's frame. The spin about the body's x never changes, so
    that its final value, which the example fixes, is left free.
    """
    start = [2.0, 7.5, 4.5, 2.5, -0.5, -2.8, 0.0]
    rest = [0.0, 0.0, 0.0, -0.1, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, SPIN, 0.0, 0.0]
    spin = [SPIN, 0.0, 0.0]
    free = [jnp.inf] * 4
    inf = jnp.inf
    high = jnp.array([inf, *[10.0] * 3, *[SPEED] * 3, *[inf] * 7])
    scale = jnp.array([0.5, *[10.0] * 3, *[SPEED] * 3, *[1.0] * 4, *[TURN] * 3])
    problem = OptimalControlProblem(
        _rocket_rates,
        state=Bounds(-high.at[0].set(-DRY), high, scale=scale),
        control=Bounds(jnp.full(3, -STRONGEST), jnp.full(3, STRONGEST)),
        initial_state=Bounds(
            jnp.array([*start, *[-f for f in free], *spin]),
            jnp.array([*start, *free, *spin]),
        ),
        final_state=Bounds(
            jnp.array([-inf, *rest]).at[11].set(-inf),
            jnp.array([inf, *rest]).at[11].set(inf),
        ),
        final_time=Bounds(2.0, 10.0),
        terminal_cost=_rocket_mass_lost,
        path_constraints={"rocket": _rocket_limits},
    )
    states = ([*start, 0.0, 0.0, 0.0, 1.0, *spin], [1.5, *rest])
    guess = line(states, ([2.0, 0.0, 0.0], [1.0, 0.0, 0.0]), 10.0, nodes)
    return Showpiece(problem, guess, FIRST_ORDER)


def _rocket_mass_lost(t_f, x_f):
    del t_f
    return -x_f[0]


def _rocket_rates(t, x, u):
    del t
    mass, velocity, rates = x[0], x[4:7], x[11:14]
    vector, scalar = x[7:10], x[10]
    wind = turned(vector, -scalar, velocity)
    drag = -norm(velocity, 1e-6) * jnp.array(DRAG) * wind
    inertia = jnp.array(INERTIA)
    torque = (
        jnp.cross(jnp.array([-ARM, 0.0, 0.0]), u)
        + jnp.cross(jnp.array([PRESSURE_ARM, 0.0, 0.0]), drag)
        - jnp.cross(rates, inertia * rates)
    )
    push = turned(vector, scalar, u + drag) / mass
    along, real = turning(vector, scalar, rates)
    return jnp.concatenate(
        [
            (-norm(u, 1e-6) / EXHAUST - LEAK)[None],
            velocity,
            push - jnp.array([1.0, 0.0, 0.0]),
            *(along, real[None]),
            torque / inertia,
        ]
    )


def _rocket_limits(t, x, u):
    """Glide slope, speed, tilt, turning, gimbal, thrust: with the example's factors."""
    del t
    velocity, rates = x[4:7], x[11:14]
    return jnp.stack(
        [
            0.1 * (norm(x[2:4], 1e-3) - 1e-3) - math.tan(SLOPE) * x[1],
            0.1 * velocity @ velocity - SPEED**2,
            math.cos(TILT) - 1 + 2 * (x[8] ** 2 + x[9] ** 2),
            rates @ rates - TURN**2,
            0.1 * norm(u, 1e-6) - u[0] / math.cos(GIMBAL),
            0.1 * u @ u - STRONGEST**2,
            0.1 * WEAKEST**2 - u @ u,
        ]
    )
