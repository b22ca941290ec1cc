"""A study that gradients make possible: where a station goes, and what it is sent."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

import jaxscp
from jaxscp import Bounds, Integral, OptimalControlProblem
from jaxscp.models import systems

pytestmark = pytest.mark.slow

DATA, DURATION = 30.0, 8.0  # [bit], [s]
# Where the station's power comes from, and what a square metre of cable costs.
SOURCE, CABLE = jnp.array([2.0, 6.0]), 0.5


class Design(eqx.Module):
    """What is chosen: a station's place, and its share of all data."""

    place: jax.Array
    share: jax.Array


class Link(eqx.Module):
    """Rate [bit/s] to a station, by Shannon's formula."""

    place: jax.Array

    def __call__(self, t, x, u):
        distance = jnp.sum((x[:2] - self.place) ** 2)
        return jnp.log2(1.0 + 40.0 / (1.0 + distance))


# Functions made anew for every design would be compiled anew.
def double_integrator(t, x, u):
    return jnp.concatenate([x[2:], u])


def flight(design):
    """A point mass crosses the plane and sends its data to two stations on the way."""
    shares = {"moved": design.share, "fixed": 1.0 - design.share}
    links = {"moved": Link(design.place), "fixed": Link(jnp.array([8.0, -4.0]))}
    far, fast = jnp.full(2, 30.0), jnp.full(2, 8.0)
    limits = jnp.concatenate([far, fast])
    return OptimalControlProblem(
        double_integrator,
        running_cost=systems.control_energy,
        state=Bounds(-limits, limits),
        control=Bounds(-5.0 * jnp.ones(2), 5.0 * jnp.ones(2)),
        initial_state=Bounds.exactly(jnp.zeros(4)),
        final_state=Bounds.exactly(jnp.array([10.0, 0.0, 0.0, 0.0])),
        final_time=Bounds.exactly(DURATION),
        integrals={
            name: Integral(links[name], Bounds.at_least(shares[name] * DATA, scale=DATA))
            for name in links
        },
    )


def total_cost(design, guess=None):
    """Of the flight and the cable, and the flight."""
    solution = jaxscp.solve(flight(design), guess, nodes=15)
    cable = CABLE * jnp.sum((design.place - SOURCE) ** 2)
    return solution.objective + cable, solution


@pytest.fixture(scope="module")
def study():
    """Gradient descent from a station at its source of power, each solve from the flight
    before: the design, its flight, and all costs on the way.
    """
    valued = eqx.filter_value_and_grad(total_cost, has_aux=True)
    # A hundredth of the share counts as much as a tenth of a metre.
    unit = jnp.array([1.0, 1.0, 0.1])
    # Of a weak type, as without `float`, the first solve would be compiled for itself.
    design, length, costs = Design(SOURCE, jnp.asarray(0.3, float)), 1.0, []
    (cost, flown), gradient = valued(design)
    while length > 1e-3:
        costs.append(float(cost))
        numbers, unravel = ravel_pytree(design)
        slope = unit * ravel_pytree(gradient)[0]
        way = -unit * slope / jnp.linalg.norm(slope)
        while length > 1e-3:
            trial = unravel(numbers + length * way)
            (cost, moved), gradient = valued(trial, flown.trajectory)
            if float(cost) < costs[-1]:
                design, flown, length = trial, moved, 1.5 * length
                break
            length *= 0.3
    return design, flown, costs


def test_the_design_becomes_cheaper(study):
    _, _, costs = study
    assert costs[-1] < 0.2 * costs[0]


def test_a_bit_costs_the_same_at_either_station(study):
    """Or it would be sent to the other one."""
    prices = jaxscp.shadow_prices(study[1])
    assert float(prices.of("moved")) > 1e-3
    assert float(prices.of("moved")) == pytest.approx(float(prices.of("fixed")), rel=1e-2)


def test_no_design_nearby_is_better(study):
    """By whole solves, without derivatives."""
    design, flown, costs = study
    numbers, unravel = ravel_pytree(design)
    for move in np.diag([0.1, 0.1, 0.01]):
        for sign in (1, -1):
            moved = unravel(numbers + sign * move)
            assert float(total_cost(moved, flown.trajectory)[0]) > costs[-1]
