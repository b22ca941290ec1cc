"""Solves against optima known in closed form."""

import functools
import math

import jax.numpy as jnp
import numpy as np
import pytest
from bank import BANK, Known, cycloid_time, hypersensitive_optimum, steps

import jaxscp
from jaxscp.verify import verify

BY_NAME = {known.name: known for known in BANK}
every_problem = pytest.mark.parametrize("name", BY_NAME)


@functools.cache
def solved(name: str):
    known = BY_NAME[name]
    problem = known.build()
    guess = known.guess(problem, known.nodes)
    discretization = jaxscp.Discretization(hold=known.hold)
    return problem, jaxscp.solve(problem, guess, discretization=discretization)


def test_the_figures_of_the_literature():
    assert cycloid_time(10.0, 5.0, 9.81) == pytest.approx(1.8012955, abs=5e-8)
    assert hypersensitive_optimum(1.5, 1.0, 10.0) == pytest.approx(1.6730940, abs=5e-8)


@every_problem
def test_objective(name):
    known: Known = BY_NAME[name]
    _, solution = solved(name)
    assert bool(solution.converged)
    assert float(solution.objective) == pytest.approx(
        known.objective, rel=known.tolerance
    )


@every_problem
def test_verification(name):
    problem, solution = solved(name)
    result = verify(problem, solution)
    assert result.verified, str(result)
    assert result.objective == pytest.approx(float(solution.objective), rel=1e-6)
    assert result.flight_error is not None
    assert np.max(result.flight_error) < 1e-4


def test_minimum_energy_trajectory_and_costates():
    _, solution = solved("minimum-energy")
    assert bool(solution.polished)
    assert float(solution.optimality) <= 1e-8
    assert "optimality conditions" in solution.message
    change = np.diff(np.asarray(solution.trajectory.controls[:, 0]))
    np.testing.assert_allclose(change, change[0], atol=1e-5)
    d, duration = 3.0, 2.0
    trajectory = solution.trajectory
    s = np.asarray(trajectory.fractions)
    np.testing.assert_allclose(trajectory.states[:, 0], d * s**2 * (3 - 2 * s), atol=1e-5)
    np.testing.assert_allclose(
        trajectory.states[:, 1], 6 * d / duration * s * (1 - s), atol=1e-5
    )
    acceleration = 6 * d / duration**2 * (1 - 2 * s)
    np.testing.assert_allclose(trajectory.controls[:, 0], acceleration, atol=1e-3)
    # u^2 + p v + q u is least at u = -q / 2, and q' = -p: what one more metre, or metre
    # per second, at a node would add to the cost.
    costates = solution.multipliers.dynamics
    p = -24 * d / duration**3
    np.testing.assert_allclose(costates[:, 0], p, rtol=1e-4)
    np.testing.assert_allclose(costates[:, 1], -2 * acceleration[1:], atol=2e-3)
    # Raising what is fixed at an end changes the cost by minus its multiplier.
    ends = solution.multipliers.state
    q = 12 * d / duration**2
    np.testing.assert_allclose(ends[-1], [p, q], rtol=1e-3)
    np.testing.assert_allclose(ends[0], [-p, q], rtol=1e-3)


def test_minimum_time_trajectory_and_costates():
    _, solution = solved("minimum-time")
    d, a = 3.0, 2.0
    duration = 2 * math.sqrt(d / a)
    trajectory = solution.trajectory
    assert float(trajectory.final_time) == pytest.approx(duration, rel=1e-6)
    t = duration * np.asarray(trajectory.fractions)
    early = t < duration / 2 - 1e-9
    np.testing.assert_allclose(
        trajectory.controls[:-1, 0], np.where(early, a, -a)[:-1], atol=1e-4
    )
    position = np.where(early, a * t**2 / 2, d - a * (duration - t) ** 2 / 2)
    np.testing.assert_allclose(trajectory.states[:, 0], position, atol=1e-5)
    speed = np.where(early, a * t, a * (duration - t))
    np.testing.assert_allclose(trajectory.states[:, 1], speed, atol=1e-5)
    # 1 + p v + q u = 0 with q' = -p and q = 0 at the switch. Held controls leave the
    # zero of q free within half an interval on either side.
    costates = solution.multipliers.dynamics
    slope = 2 / (a * duration)
    np.testing.assert_allclose(costates[:, 0], -slope, rtol=1e-3)
    half_interval = duration / (t.size - 1) / 2
    np.testing.assert_allclose(
        costates[:, 1],
        slope * (t[1:] - duration / 2),
        atol=1.01 * slope * half_interval,
    )


def test_brachistochrone_is_a_cycloid():
    _, solution = solved("brachistochrone")
    x, y, speed = np.asarray(solution.trajectory.states).T
    # Energy, and the cycloid's angle: the wire turns evenly from straight down.
    np.testing.assert_allclose(speed**2, 2 * 9.81 * (10.0 - y), atol=1e-3)
    angle = np.asarray(solution.trajectory.controls[:, 0])
    last = cycloid_time(10.0, 5.0, 9.81)
    radius = 5.0 / (2 * math.sin(angle[-1]) ** 2)
    np.testing.assert_allclose(
        angle, angle[-1] * solution.trajectory.fractions, atol=1e-3
    )
    assert angle[-1] * 2 * math.sqrt(radius / 9.81) == pytest.approx(last, rel=1e-4)
    p = 2 * angle
    np.testing.assert_allclose(x, radius * (p - np.sin(p)), atol=1e-3)


def test_bryson_denham_acceleration():
    _, solution = solved("bryson-denham-resting")
    limit = 0.1
    t = np.asarray(solution.trajectory.fractions)
    ramp = np.maximum(0.0, 1 - np.minimum(t, 1 - t) / (3 * limit))
    exact = -2 / (3 * limit) * ramp
    np.testing.assert_allclose(solution.trajectory.controls[:, 0], exact, atol=0.1)
    assert np.max(solution.trajectory.states[:, 0]) <= limit + 1e-6
    push = np.asarray(solution.multipliers.state[:, 0])
    touching = np.abs(t - 0.5) <= 0.5 - 3 * limit + 1e-9
    inner = (t > 0) & (t < 1)
    np.testing.assert_allclose(push[inner & ~touching], 0, atol=1e-2)
    # The cost 4 / (9 l) falls with the limit; starting nearer to it is half a descent.
    assert np.sum(push[inner]) == pytest.approx(4 / (9 * limit**2), rel=1e-3)
    assert push[0] == pytest.approx(-2 / (9 * limit**2), rel=1e-3)


def test_a_warm_start_stays_where_it_is():
    problem, solution = solved("minimum-energy")
    again = jaxscp.solve(
        problem, solution.trajectory, discretization=solution.discretization
    )
    assert steps(again) < steps(solution)
    np.testing.assert_allclose(
        again.trajectory.states, solution.trajectory.states, atol=1e-6
    )
    assert jnp.isclose(again.objective, solution.objective, rtol=1e-8)
