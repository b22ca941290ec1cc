"""Limits and scales that are far beyond what a solution needs change nothing."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxscp
from jaxscp import Bounds, OptimalControlProblem, textbook

NODES = 7


class Sled(eqx.Module):
    """Pushed over level ground."""

    mass: jax.Array

    def __call__(self, t, x, u):
        return jnp.stack([x[1], u[0] / self.mass])


class Effort(eqx.Module):
    mass: jax.Array

    def __call__(self, t, x, u):
        return (u[0] / self.mass) ** 2


def sled(reach=100.0, push=2.0, *, mass=1.0, scale=None) -> OptimalControlProblem:
    """From rest to rest over 10 m in 10 s with the least effort."""
    return OptimalControlProblem(
        Sled(jnp.asarray(mass)),
        state=Bounds([-reach, -5.0], [reach, 5.0]),
        control=Bounds([-push], [push], scale=scale),
        initial_state=Bounds.exactly([0.0, 0.0]),
        final_state=Bounds.exactly([10.0, 0.0]),
        final_time=Bounds.exactly(10.0),
        running_cost=Effort(jnp.asarray(mass)),
    )


def solve(problem):
    return jaxscp.solve(problem, nodes=NODES)


def assert_the_same(solution, expected, *, force=1.0):
    assert bool(solution.polished)
    assert jaxscp.verify(solution.problem, solution).verified
    assert solution.objective == pytest.approx(float(expected.objective), rel=1e-7)
    found, wanted = solution.trajectory, expected.trajectory
    np.testing.assert_allclose(found.states, wanted.states, atol=1e-5)
    np.testing.assert_allclose(found.controls / force, wanted.controls, atol=1e-5)
    prices = [jaxscp.shadow_prices(each) for each in (solution, expected)]
    one, other = (each.of("final time", "value") for each in prices)
    np.testing.assert_allclose(one, other, rtol=1e-5)


@pytest.mark.parametrize("push", [30.0, 1e2, 1e3, 1e4, 1e6])
def test_limits_of_the_control(push):
    assert_the_same(solve(sled(push=push)), solve(sled()))


@pytest.mark.parametrize("reach", [1e3, 1e5, 1e7])
def test_limits_of_the_state(reach):
    assert_the_same(solve(sled(reach=reach)), solve(sled()))


def test_both_in_large_units():
    found = solve(sled(1e6, 1e7, mass=1000.0))
    assert_the_same(found, solve(sled()), force=1000.0)


@pytest.mark.parametrize("scale", [1e-2, 1e2, 1e4])
def test_scales_of_the_control(scale):
    assert_the_same(solve(sled(scale=[scale])), solve(sled(scale=[1.0])))


def test_derivatives():
    def effort(distance, push):
        problem = eqx.tree_at(
            lambda p: (p.final_state.lower, p.final_state.upper),
            sled(push=push),
            replace_fn=lambda end: end.at[0].set(distance),
        )
        return solve(problem).objective

    slopes = [jax.grad(effort)(10.0, push) for push in (2.0, 1e4)]
    # The optimum grows with the square of the distance.
    np.testing.assert_allclose(slopes[0], 0.2 * effort(10.0, 2.0), rtol=1e-7)
    np.testing.assert_allclose(slopes[1], slopes[0], rtol=1e-6)


def test_under_transformations():
    pushes = jnp.asarray([2.0, 1e4])
    efforts = jax.jit(jax.vmap(lambda push: solve(sled(push=push)).objective))(pushes)
    np.testing.assert_allclose(efforts[1], efforts[0], rtol=1e-7)


def test_all_steps_are_counted():
    told = []
    solution = jaxscp.solve(sled(push=1e4), nodes=NODES, progress=told.append)
    jax.effects_barrier()
    statistics = solution.statistics
    steps = int(statistics.iterations) + int(statistics.polish_iterations)
    assert [row["iteration"] for row in told] == list(range(1, steps + 1))
    assert np.isfinite(solution.history.objective).sum() == steps
    # It begins again: the weight of the trust region is the first one's.
    weights = [row["radius"] for row in told]
    assert weights.count(weights[0]) > 1


@pytest.mark.parametrize("distance", [1e-2, 1e-3, 1e-4])
def test_what_next_to_nothing_costs(distance):
    problem = textbook.minimum_energy_double_integrator(1.0)
    near = eqx.tree_at(
        lambda p: (p.final_state.lower, p.final_state.upper),
        problem,
        replace_fn=lambda end: end.at[0].set(distance),
    )
    found, whole = solve(near), solve(problem)
    assert bool(found.polished)
    expected = distance**2 * float(whole.objective)
    assert found.objective == pytest.approx(expected, rel=1e-6)


def test_what_costs_next_to_nothing_is_solved_once():
    # A path that can be followed, but for the price of turning onto it.
    problem = OptimalControlProblem(
        Sled(jnp.asarray(1.0)),
        state=Bounds([-20.0, -5.0], [20.0, 5.0]),
        control=Bounds([-2.0], [2.0]),
        final_time=Bounds.exactly(10.0),
        running_cost=lambda t, x, u: (x[0] - 0.1 * t**2) ** 2 + 1e-7 * u[0] ** 2,
    )
    solution = solve(problem)
    assert bool(solution.converged)
    assert 0.0 < solution.objective < 1e-3
    weights = np.asarray(solution.history.radius)
    assert np.sum(weights == weights[0]) == 1
