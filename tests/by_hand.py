"""A motion known by hand, that `verify` is tested with."""

import equinox as eqx
import jax.numpy as jnp

from jaxscp import Bounds, OptimalControlProblem, Trajectory


def double_integrator(t, x, u):
    return jnp.stack([x[1], u[0]])


def motion(**changes) -> OptimalControlProblem:
    """A point on a line: position [m], velocity [m/s], acceleration [m/s^2]."""
    settings = {
        "state": Bounds.free(2),
        "control": Bounds(-3.0 * jnp.ones(1), 3.0 * jnp.ones(1)),
        "initial_state": Bounds.exactly(jnp.zeros(2)),
        "final_time": Bounds.exactly(4.0),
        "state_names": ("position", "velocity"),
        "control_names": ("acceleration",),
        "units": {"position": "m", "velocity": "m/s", "acceleration": "m/s^2"},
    }
    return OptimalControlProblem(double_integrator, **(settings | changes))


def constant_acceleration(
    acceleration=2.0, velocity=0.0, duration=4.0, nodes=9
) -> Trajectory:
    fractions = jnp.linspace(0.0, 1.0, nodes)
    t = duration * fractions
    position = velocity * t + 0.5 * acceleration * t**2
    return Trajectory(
        fractions=fractions,
        states=jnp.stack([position, velocity + acceleration * t], axis=1),
        controls=jnp.full((nodes, 1), acceleration),
        final_time=jnp.asarray(duration),
    )


def shifted(trajectory: Trajectory, node: int, state: int, by: float) -> Trajectory:
    states = trajectory.states.at[node, state].add(by)
    return eqx.tree_at(lambda trajectory: trajectory.states, trajectory, states)
