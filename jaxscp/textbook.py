"""Ready problems whose optima are known in closed form."""

import jax.numpy as jnp

from ._bounds import Bounds
from ._problem import OptimalControlProblem
from ._types import ArrayLike
from .models.systems import (
    Brachistochrone,
    control_energy,
    double_integrator,
    elapsed_time,
    half_control_energy,
    half_state_and_control_energy,
    linear_hypersensitive,
)

_MOTION_UNITS = {"position": "m", "velocity": "m/s", "acceleration": "m/s^2"}


def minimum_energy_double_integrator(
    distance: ArrayLike = 1.0, duration: ArrayLike = 1.0
) -> OptimalControlProblem:
    r"""Rest to rest over `distance` d [m] in `duration` T [s] with least int a^2 dt.

    The optimum is $12 d^2 / T^3$, with $a(t) = 6 d (1 - 2t/T) / T^2$: the costates are
    linear in time, so the acceleration is, and both ends fix its two constants.
    """
    distance = jnp.asarray(distance, float)
    return OptimalControlProblem(
        double_integrator,
        state=Bounds.free(2, scale=_of_motion(distance, duration)),
        control=Bounds.free(1, scale=6 * distance / jnp.asarray(duration, float) ** 2),
        initial_state=Bounds.exactly(jnp.zeros(2)),
        final_state=Bounds.exactly(jnp.stack([distance, jnp.zeros(())])),
        final_time=Bounds.exactly(duration),
        running_cost=control_energy,
        state_names=("position", "velocity"),
        control_names=("acceleration",),
        units=_MOTION_UNITS,
    )


def minimum_time_double_integrator(
    distance: ArrayLike = 1.0, limit: ArrayLike = 1.0
) -> OptimalControlProblem:
    r"""Rest to rest over `distance` d [m] in least time with |a| <= `limit` [m/s^2].

    The optimum is $T = 2 \sqrt{d / a}$: full acceleration, then full braking, changing
    at T/2 (Bryson and Ho, Applied Optimal Control, on bang-bang control).
    """
    distance, limit = jnp.asarray(distance, float), jnp.asarray(limit, float)
    time = jnp.sqrt(distance / limit)
    return OptimalControlProblem(
        double_integrator,
        state=Bounds.free(2, scale=_of_motion(distance, time)),
        control=Bounds(-limit[None], limit[None]),
        initial_state=Bounds.exactly(jnp.zeros(2)),
        final_state=Bounds.exactly(jnp.stack([distance, jnp.zeros(())])),
        final_time=Bounds(0.5 * time, 5 * time, scale=time, fixed=(False,)),
        terminal_cost=elapsed_time,
        state_names=("position", "velocity"),
        control_names=("acceleration",),
        units=_MOTION_UNITS,
    )


def brachistochrone(gravity: ArrayLike = 9.81) -> OptimalControlProblem:
    """The quickest wire from rest at (0, 10) to (10, 5) [m].

    The optimum is a cycloid, x = r (p - sin p), y = 10 - r (1 - cos p), with the end
    fixing r and the last p; the time is p sqrt(r / g), 1.8012955 s at 9.81 m/s^2
    (Johann Bernoulli, Acta Eruditorum, 1697).
    """
    return OptimalControlProblem(
        Brachistochrone(gravity),
        state=Bounds.free(3, scale=jnp.array([10.0, 5.0, 10.0])),
        control=Bounds(jnp.zeros(1), jnp.full(1, jnp.pi)),
        initial_state=Bounds.exactly(jnp.array([0.0, 10.0, 0.0])),
        final_state=Bounds(
            jnp.array([10.0, 5.0, -jnp.inf]), jnp.array([10.0, 5.0, jnp.inf])
        ),
        final_time=Bounds(0.5, 10.0, scale=2.0),
        terminal_cost=elapsed_time,
        state_names=("x", "y", "speed"),
        control_names=("angle",),
        units={"x": "m", "y": "m", "speed": "m/s", "angle": "rad"},
    )


def hypersensitive(duration: ArrayLike = 10.0) -> OptimalControlProblem:
    r"""x' = -x + u from 1.5 to 1 with least int (x^2 + u^2)/2 dt: stiff both ways.

    With $s = \sqrt 2$ and T = `duration` [s], the optimum is
    $\tfrac12 [(s \coth sT - 1)\,1.5^2 + (s \coth sT + 1) - 3 s / \sinh sT]$, 1.6730940
    at 10 s: the value of a linear-quadratic problem with both ends fixed, whose Riccati
    equation $P^2 + 2P - 1 = 0$ has the roots $s - 1$ and $-s - 1$.
    """
    return OptimalControlProblem(
        linear_hypersensitive,
        state=Bounds.free(1, scale=jnp.ones(1)),
        control=Bounds.free(1, scale=jnp.ones(1)),
        initial_state=Bounds.exactly(jnp.full(1, 1.5)),
        final_state=Bounds.exactly(jnp.ones(1)),
        final_time=Bounds.exactly(duration),
        running_cost=half_state_and_control_energy,
        state_names=("x",),
        control_names=("u",),
    )


def bryson_denham(limit: ArrayLike = 1 / 9) -> OptimalControlProblem:
    r"""Turn back within 1 s from speed 1 to -1 without passing `limit` l [m].

    The least int a^2/2 dt has three branches (Bryson and Ho, Applied Optimal Control,
    on inequality constraints on the state): 2 if $l \ge 1/4$, where the limit is not
    felt; $2 + 6 (1 - 4l)^2$ if $1/6 \le l \le 1/4$, touching it at one instant;
    $4 / (9l)$ if $l \le 1/6$, resting on it from 3l to 1 - 3l.
    """
    limit = jnp.asarray(limit, float)
    return OptimalControlProblem(
        double_integrator,
        state=Bounds(
            jnp.full(2, -jnp.inf),
            jnp.stack([limit, jnp.asarray(jnp.inf)]),
            scale=jnp.stack([limit, jnp.ones(())]),
        ),
        control=Bounds.free(1, scale=jnp.full(1, 10.0)),
        initial_state=Bounds.exactly(jnp.array([0.0, 1.0])),
        final_state=Bounds.exactly(jnp.array([0.0, -1.0])),
        final_time=Bounds.exactly(1.0),
        running_cost=half_control_energy,
        state_names=("position", "velocity"),
        control_names=("acceleration",),
        units=_MOTION_UNITS,
    )


def _of_motion(distance: ArrayLike, duration: ArrayLike) -> ArrayLike:
    """Typical position and velocity of a motion over a distance."""
    length = jnp.abs(jnp.asarray(distance, float))
    return jnp.stack([length, length / jnp.asarray(duration, float)])
