"""Free-interval grids, against what is known of a cart in closed form.

From rest to rest over a distance, at a price on time and another on squared
acceleration. All solves share one compilation: they differ in numbers alone.
"""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from bank import steps
from hypothesis import given, strategies as st
from numpy.testing import assert_allclose
from scipy.integrate import quad
from test_validation import compilations

import jaxscp
from jaxscp import (
    Bounds,
    Integral,
    OptimalControlProblem,
    _free_intervals,
    _paced_problem,
)
from jaxscp.models.systems import double_integrator

INTERVALS, RATIO = 5, 1.5
FREE = jaxscp.Discretization(interval_ratio=RATIO)
UNEVEN = np.array([0.0, 0.13, 0.3, 0.5, 0.73, 1.0])
DISTANCE = 3.0
# One by one their operations would each be compiled.
durations = jax.jit(_paced_problem.durations)
guessed_pace = jax.jit(_free_intervals._guessed_pace)


class Effort(eqx.Module):
    price: jax.Array

    def __call__(self, t, x, u):
        return self.price * u[0] ** 2


class Lateness(eqx.Module):
    price: jax.Array

    def __call__(self, t_f, x_f):
        return self.price * t_f


def speed(t, x, u):
    return x[1]


def fence(t, x, u):
    return x[:1] - 50.0


def cart(
    *, effort, lateness, acceleration, final_time=(0.5, 20.0)
) -> OptimalControlProblem:
    limit = jnp.asarray(acceleration, float)[None]
    return OptimalControlProblem(
        double_integrator,
        state=Bounds.free(2, scale=np.array([3.0, 2.0])),
        control=Bounds(-limit, limit),
        initial_state=Bounds.exactly(np.zeros(2)),
        final_state=Bounds.exactly(np.array([DISTANCE, 0.0])),
        final_time=Bounds(*final_time, scale=2.0),
        running_cost=Effort(jnp.asarray(effort, float)),
        terminal_cost=Lateness(jnp.asarray(lateness, float)),
        path_constraints={"fence": fence},
        integrals={"travel": Integral(speed, Bounds(0.0, 50.0))},
        state_names=("position", "velocity"),
        control_names=("acceleration",),
        units={"position": "m", "velocity": "m/s"},
    )


def solved(problem, fractions=UNEVEN, **options) -> jaxscp.Solution:
    guess = jaxscp.straight_line(problem, fractions, final_time=3.0)
    return jaxscp.solve(problem, guess, discretization=FREE, **options)


def lengths(solution) -> np.ndarray:
    return np.diff(np.asarray(solution.trajectory.times))


def check(problem, solution):
    """What holds of every solution: it flies, and neighbours are alike."""
    assert bool(solution.converged), solution.message
    result = jaxscp.verify(problem, solution, between=True, tolerance=1e-6)
    assert result.verified, str(result)
    assert result.objective == pytest.approx(float(solution.objective), rel=1e-7)
    assert np.max(np.abs(np.diff(np.log(lengths(solution))))) <= math.log(RATIO) + 1e-7
    assert float(solution.integrals["travel"]) == pytest.approx(DISTANCE, rel=1e-7)


def test_bang_bang_switches_where_it_should():
    """Five even intervals have no node halfway, where the acceleration changes sign."""
    problem = cart(effort=0.0, lateness=1.0, acceleration=2.0)
    solution = solved(problem)
    check(problem, solution)
    exact = 2 * math.sqrt(DISTANCE / 2.0)
    assert float(solution.objective) == pytest.approx(exact, rel=1e-7)
    assert float(solution.trajectory.final_time) == pytest.approx(exact, rel=1e-7)
    assert np.min(np.abs(np.asarray(solution.trajectory.fractions) - 0.5)) < 1e-6
    # 1 + p v + q u = 0 along the flight, and p is the price of distance: dT / dd.
    price = exact / (2 * DISTANCE)
    assert_allclose(solution.multipliers.dynamics[:, 0], -price, rtol=1e-5)


def even_optimum(lateness) -> float:
    """Best flight time at a price on time and the price 1 on squared acceleration.

    Held over M intervals of lengths h the least effort is 12 d^2 / (T^3 - sum h^3), as
    the impulses must have the moment d: even intervals are best. With c = 1 - 1 / M^2,
    k T + 12 d^2 / (c T^3) is least at T^4 = 36 d^2 / (c k).
    """
    return (36 * DISTANCE**2 / ((1 - INTERVALS**-2) * lateness)) ** 0.25


def test_an_even_grid_is_found_where_it_is_best():
    problem = cart(effort=1.0, lateness=2.0, acceleration=50.0)
    solution = solved(problem)
    check(problem, solution)
    assert bool(solution.polished)
    best = even_optimum(2.0)
    assert_allclose(lengths(solution), best / INTERVALS, rtol=1e-4)
    # A third of the price of time is spent on effort; none on the grid itself.
    assert float(solution.objective) == pytest.approx(4 / 3 * 2.0 * best, rel=1e-8)
    assert float(solution.multipliers.final_time) == pytest.approx(0.0, abs=1e-6)
    # The objective grows with the root of the distance.
    shadow = 2 / 3 * 2.0 * best / DISTANCE
    assert_allclose(solution.multipliers.state[-1, 0], -shadow, rtol=1e-4)


def test_the_price_of_a_flight_time():
    allowed = 2.0
    problem = cart(effort=1.0, lateness=2.0, acceleration=50.0, final_time=(0.5, allowed))
    solution = solved(problem)
    check(problem, solution)
    assert float(solution.trajectory.final_time) == pytest.approx(allowed, rel=1e-9)
    # Raising the limit changes the objective by minus its multiplier.
    slope = 2.0 * (1 - (even_optimum(2.0) / allowed) ** 4)
    assert float(solution.multipliers.final_time) == pytest.approx(-slope, rel=1e-5)


def test_what_is_returned_is_the_users_own():
    problem = cart(effort=1.0, lateness=2.0, acceleration=50.0)
    solution = solved(problem)
    assert solution.problem.state_names == problem.state_names
    assert solution.trajectory.states.shape == (INTERVALS + 1, 2)
    assert solution.trajectory.controls.shape == (INTERVALS + 1, 1)
    multipliers = solution.multipliers
    assert multipliers.state.shape == (INTERVALS + 1, 2)
    assert multipliers.control.shape == (INTERVALS + 1, 1)
    assert multipliers.dynamics.shape == multipliers.state_between.shape == (INTERVALS, 2)
    half = solution.sample([0.5 * float(solution.trajectory.final_time)])
    assert_allclose(half.states[0, 0], DISTANCE / 2, rtol=1e-5)


def test_new_numbers_compile_nothing():
    solved(cart(effort=1.0, lateness=2.0, acceleration=50.0))
    with compilations() as compiled:
        solution = solved(cart(effort=1.0, lateness=3.0, acceleration=40.0))
        best = float(solution.trajectory.final_time)
    assert best == pytest.approx(even_optimum(3.0), rel=1e-5)
    assert not compiled, compiled


def test_a_solution_is_a_guess_that_stays():
    problem = cart(effort=1.0, lateness=2.0, acceleration=50.0)
    first = solved(problem)
    again = jaxscp.solve(problem, first.trajectory, discretization=first.discretization)
    assert steps(again) < steps(first)
    assert_allclose(lengths(again), lengths(first), rtol=1e-4)
    assert float(again.objective) == pytest.approx(float(first.objective), rel=1e-8)


def test_what_cannot_be_met_is_named():
    """Nothing that accelerates by 0.1 m/s^2 goes 3 m in two seconds."""
    problem = cart(effort=1.0, lateness=1.0, acceleration=0.1, final_time=(0.5, 2.0))
    solution = solved(problem, throw=False)
    assert not bool(solution.converged)
    assert "virtual control moves" in solution.message


@given(st.floats(-2.0, 2.0), st.floats(-3.0, 3.0) | st.floats(-1e-4, 1e-4))
def test_durations_are_the_integral_of_the_pace(start, rise):
    exact, _ = quad(lambda s: math.exp(start + 2 * s * rise), 0.0, 0.5, epsrel=1e-12)
    pace = jnp.array([start, start + rise, start + rise])
    assert_allclose(durations(pace)[0], exact, rtol=1e-9)
    assert_allclose(durations(pace)[1], 0.5 * math.exp(start + rise), rtol=1e-12)


def test_a_smooth_guess_is_kept():
    seconds = jnp.exp(0.3 * jnp.sin(jnp.linspace(0.0, 6.0, 40)))
    pace = guessed_pace(seconds, math.log(1.2))
    assert_allclose(durations(pace), seconds, rtol=2e-3)


@given(st.lists(st.floats(0.01, 100.0), min_size=7, max_size=7))
def test_any_guess_is_made_gradual(seconds):
    seconds = jnp.array(seconds)
    pace = guessed_pace(seconds, math.log(1.2))
    found = np.asarray(durations(pace))
    assert np.max(np.abs(np.diff(np.log(found)))) <= math.log(1.2) + 1e-9
    assert found.sum() == pytest.approx(float(jnp.sum(seconds)))


def test_derivatives_on_a_free_grid():
    """By the price of effort, against differences of solves."""

    def cost_and_time(problem):
        solution = solved(problem)
        return solution.objective, solution.trajectory.final_time

    def problem_of(effort):
        return cart(effort=effort, lateness=1.0, acceleration=1.1)

    price, step = 0.4, 1e-3
    problem = problem_of(price)
    way = jax.tree.map(jnp.zeros_like, eqx.filter(problem, eqx.is_inexact_array))
    way = eqx.tree_at(lambda p: p.running_cost.price, way, jnp.ones(()))
    _, found = eqx.filter_jvp(cost_and_time, (problem,), (way,))
    high, low = (cost_and_time(problem_of(price + s)) for s in (step, -step))
    for slope, above, below in zip(found, high, low, strict=True):
        assert float(slope) == pytest.approx(float(above - below) / (2 * step), rel=1e-3)
