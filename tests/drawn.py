"""What figures show, made once: a small solution, and a flight that takes no solve."""

import dataclasses
import functools

import equinox as eqx
import jax.numpy as jnp
import numpy as np

import jaxscp
from jaxscp import Bounds, OptimalControlProblem, missions
from jaxscp._packed import Packed


@functools.cache
def double_integrator():
    """A solution on whose way limits of speed and acceleration are active."""
    problem = OptimalControlProblem(
        lambda t, x, u: jnp.concatenate([x[1:], u]),
        running_cost=lambda t, x, u: u @ u,
        state=Bounds([-1.0, -jnp.inf], [2.0, 1.2]),
        control=Bounds([-8.0], [8.0]),
        initial_state=Bounds.exactly([0.0, 0.0]),
        final_state=Bounds.exactly([1.0, 0.0]),
        final_time=Bounds.exactly(1.0),
        state_names=("position", "speed"),
        control_names=("acceleration",),
        units={
            "position": "m",
            "speed": "m/s",
            "acceleration": "m/s^2",
            "objective": "m^2/s^3",
        },
    )
    return jaxscp.solve(problem, nodes=11)


@functools.cache
def flight():
    """A mission, a solution that nobody solved for, and its guess: a figure needs no
    optimum.
    """
    mission = missions.get("urban-flight")
    guess = mission.guess(nodes=25)
    solution = dataclasses.replace(
        double_integrator(),
        packed_problem=Packed.of(mission.problem()),
        trajectory=bent(guess, -9.0),
    )
    return mission, solution, guess


def bent(guess, aside):
    """The guess, moved aside [m] between its ends, with a thrust that varies.

    It flies from node to node: velocities are such that it arrives.
    """
    fractions, steps = np.asarray(guess.fractions), np.diff(guess.times)[:, None]
    states, controls = np.array(guess.states), np.array(guess.controls)
    states[1:-1, 1] += aside * np.sin(np.pi * fractions)[1:-1]
    controls[:-1, 0] += 6.0 * np.cos(9.0 * fractions[:-1])
    rise = (controls[:-1, :1] - controls[-1:, :1]) / 3.0  # [m/s^2], for 3 kg
    states[:-1, 3:6] = np.diff(states[:, :3], axis=0) / steps
    states[:-1, 5:6] -= 0.5 * rise * steps
    controls[-1] = controls[-2]
    return eqx.tree_at(
        lambda t: (t.states, t.controls),
        guess,
        (jnp.asarray(states), jnp.asarray(controls)),
    )


def routes():
    """Three of them, by name."""
    guess = flight()[2]
    return {f"{aside} m": bent(guess, float(aside)) for aside in (-20, 15, 50)}


@functools.cache
def with_multipliers():
    """The small solution, as if its speed were limited between nodes, too."""
    between = np.zeros((10, 2))
    between[3:7, 1] = (40.0, 90.0, 90.0, 40.0)
    return eqx.tree_at(
        lambda solution: solution.multipliers.state_between,
        double_integrator(),
        jnp.asarray(between),
    )


@functools.cache
def with_history():
    """The small solution, with numbers on its way that no machine rounds otherwise."""
    solution = double_integrator()
    records = np.arange(solution.history.defect.size)
    shown = records < 6
    defect, reduction = (
        jnp.asarray(np.where(shown, rate**records, np.nan)) for rate in (0.1, 0.3)
    )
    return eqx.tree_at(
        lambda s: (
            s.history.defect,
            s.history.predicted_reduction,
            s.history.penalized_cost,
        ),
        solution,
        (defect, reduction, 5.0 + reduction),
    )
