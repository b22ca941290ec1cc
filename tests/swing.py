"""A swing-up with something of everything, in any units."""

import equinox as eqx
import jax
import jax.numpy as jnp

import jaxscp
from jaxscp import Bounds, Integral, OptimalControlProblem

# Converged far beyond what is compared: two paths to one point differ on the way. All
# tests use this method and this many nodes: with others a solve would compile anew.
SHARP = jaxscp.ProximalSCP(tolerance=1e-11)
NODES = 15


class Pendulum(eqx.Module):
    """A damped pendulum whose angle, speed, torque and clock have units of one's own."""

    angle: jax.Array
    speed: jax.Array
    torque: jax.Array
    time: jax.Array

    def __call__(self, t, x, u):
        angle, speed, torque = x[0] / self.angle, x[1] / self.speed, u[0] / self.torque
        rates = [speed * self.angle, (torque - jnp.sin(angle) - 0.1 * speed) * self.speed]
        return jnp.stack(rates) / self.time


class Scaled(eqx.Module):
    """A function of the pendulum in other units, in another unit itself."""

    plant: Pendulum
    unit: jax.Array
    power: int = 2
    of_angle: bool = False

    def __call__(self, t, x, u):
        value = x[0] / self.plant.angle if self.of_angle else u[0] / self.plant.torque
        return self.unit * value**self.power


class Ceiling(eqx.Module):
    plant: Pendulum
    unit: jax.Array
    speed: jax.Array

    def __call__(self, t, x, u):
        return self.unit * jnp.stack([x[1] / self.plant.speed - self.speed])


def strongly_typed(leaf):
    """Python numbers leave weak types behind, for which a solve would compile anew."""
    return jnp.asarray(leaf, leaf.dtype) if eqx.is_array(leaf) else leaf


def swing(angle=1.0, speed=1.0, torque=1.0, time=1.0, cost=1.0, ceiling=1.0, data=1.0):
    """The same swing-up in the given units: all of them multiply what they name."""
    plant = Pendulum(*(jnp.asarray(unit) for unit in (angle, speed, torque, time)))
    size = jnp.array([angle, speed])
    problem = OptimalControlProblem(
        plant,
        state=Bounds(-4.0 * size, 4.0 * size),
        control=Bounds(-1.5 * jnp.array([torque]), 1.5 * jnp.array([torque])),
        initial_state=Bounds.exactly(jnp.zeros(2)),
        final_state=Bounds.exactly(jnp.array([1.5 * angle, 0.0])),
        final_time=Bounds(2.0 * time, 8.0 * time),
        running_cost=Scaled(plant, jnp.asarray(cost / time)),
        path_constraints={
            "ceiling": Ceiling(plant, jnp.asarray(ceiling), jnp.asarray(0.5))
        },
        integrals={
            "lift": Integral(
                Scaled(plant, jnp.asarray(data / time), power=1, of_angle=True),
                Bounds.at_least(jnp.asarray(3.0 * data)),
            )
        },
    )
    return jax.tree.map(strongly_typed, problem)


def swing_at_its_limit():
    """With a torque that is at its limit for a while."""
    limit = jnp.array([0.8])
    ends = (-limit, limit)
    return eqx.tree_at(lambda p: (p.control.lower, p.control.upper), swing(), ends)


def swung(problem, guess=None) -> jaxscp.Solution:
    return jaxscp.solve(problem, guess, SHARP, nodes=NODES)
