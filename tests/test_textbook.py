"""The optima that the docstrings state, found here without the library's solver."""

import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.integrate import solve_bvp
from scipy.optimize import brentq

from jaxscp import textbook


def rates(problem, state, control):
    return np.asarray(
        problem.dynamics(jnp.zeros(()), jnp.asarray(state), jnp.asarray(control))
    )


def test_brachistochrone_is_a_cycloid():
    end = brentq(lambda p: (p - np.sin(p)) - 2 * (1 - np.cos(p)), 1.0, 2 * np.pi - 1e-3)
    radius = 5 / (1 - np.cos(end))
    assert end * np.sqrt(radius / 9.81) == pytest.approx(1.8012955, abs=5e-8)
    # The cycloid rolls at a constant rate, and obeys the dynamics half way.
    problem, spin, p = textbook.brachistochrone(), np.sqrt(9.81 / radius), end / 2
    speed = np.sqrt(2 * 9.81 * radius * (1 - np.cos(p)))
    x_rate = spin * radius * (1 - np.cos(p))
    y_rate = -spin * radius * np.sin(p)
    angle = np.arctan2(x_rate, -y_rate)
    expected = [x_rate, y_rate, 9.81 * np.cos(angle)]
    assert_allclose(rates(problem, [0.0, 0.0, speed], [angle]), expected, atol=1e-12)


def test_hypersensitive_optimum():
    # Pontryagin: u = -l, x' = -x - l, l' = l - x.
    solution = solve_bvp(
        lambda t, y: np.stack([-y[0] - y[1], y[1] - y[0], (y[0] ** 2 + y[1] ** 2) / 2]),
        lambda a, b: np.array([a[0] - 1.5, b[0] - 1, a[2]]),
        np.linspace(0, 10, 200),
        np.zeros((3, 200)),
        tol=1e-10,
        max_nodes=100_000,
    )
    s = np.sqrt(2)
    far = s / np.tanh(10 * s)
    stated = ((far - 1) * 2.25 + (far + 1) - 3 * s / np.sinh(10 * s)) / 2
    assert stated == pytest.approx(1.6730940, abs=5e-8)
    assert solution.y[2, -1] == pytest.approx(stated, abs=1e-8)
    problem = textbook.hypersensitive()
    assert_allclose(rates(problem, [0.3], [0.5]), [0.2])
    cost = problem.running_cost(jnp.zeros(()), jnp.full(1, 3.0), jnp.full(1, 2.0))
    assert float(cost) == 6.5


def test_minimum_energy_double_integrator():
    problem = textbook.minimum_energy_double_integrator(3.0, 2.0)
    t = np.linspace(0, 2.0, 20_001)
    a = 6 * 3.0 * (1 - t) / 4
    v = np.concatenate([[0], np.cumsum((a[1:] + a[:-1]) / 2 * np.diff(t))])
    assert np.trapezoid(v, t) == pytest.approx(3.0)
    assert np.trapezoid(a**2, t) == pytest.approx(12 * 9.0 / 8.0, rel=1e-6)
    assert_allclose(problem.final_state.target, [3.0, 0.0])
    assert float(problem.final_time.target) == 2.0
    assert_allclose(rates(problem, [1.0, 2.0], [3.0]), [2.0, 3.0])


def test_minimum_time_double_integrator():
    problem = textbook.minimum_time_double_integrator(8.0, 2.0)
    time = 2 * np.sqrt(8.0 / 2.0)
    assert 2 * (0.5 * 2.0 * (time / 2) ** 2) == 8.0
    assert float(problem.final_time.lower) < time < float(problem.final_time.upper)
    assert_allclose(problem.control.upper, [2.0])
    assert float(problem.terminal_cost(jnp.asarray(time), jnp.zeros(2))) == time


def test_bryson_denham_branches_meet():
    for limit in (0.1, 0.2, 0.3):
        problem = textbook.bryson_denham(limit)
        assert_allclose(problem.state.upper, [limit, np.inf])
        cost = problem.running_cost(jnp.zeros(()), jnp.ones(2), jnp.full(1, 4.0))
        assert float(cost) == 8.0
    touching, resting = 2 + 6 * (1 - 4 / 6) ** 2, 4 * 6 / 9
    assert touching == pytest.approx(resting)
    # Touching: x reaches the limit l at 1/2 with two cubics; their cost by hand at 1/5.
    t = np.linspace(0, 0.5, 20_001)
    slope = 24 * (1 - 4 * 0.2)
    a = -8 * (1 - 3 * 0.2) + slope * t
    v = 1 - 8 * (1 - 3 * 0.2) * t + slope * t**2 / 2
    assert np.trapezoid(v, t) == pytest.approx(0.2, abs=1e-8)
    assert v[-1] == pytest.approx(0.0, abs=1e-12)
    assert np.trapezoid(a**2, t) == pytest.approx(2 + 6 * (1 - 4 * 0.2) ** 2, rel=1e-6)
