"""How many Runge-Kutta substeps a solve takes, and what they cost it in error."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from bank import steps

import jaxscp
from jaxscp import Bounds, OptimalControlProblem, textbook


class Sink(eqx.Module):
    """Flows out too fast for steps of half an interval, which empty it beyond the floor
    of its logarithm.
    """

    def __call__(self, t, x, u):
        return u - 3.2 * x + 0.01 * jnp.log(x + 0.5)


def drained(**settings):
    problem = OptimalControlProblem(
        Sink(),
        running_cost=lambda t, x, u: (u[0] - 0.1) ** 2,
        state=Bounds.free(1),
        control=Bounds([-1.0], [1.0]),
        initial_state=Bounds.exactly([1.0]),
        final_time=Bounds.exactly(1.0),
    )
    discretization = jaxscp.Discretization(**settings)
    return jaxscp.solve(problem, nodes=2, discretization=discretization, throw=False)


def test_steps_too_long_for_a_function_become_shorter():
    solution = drained()
    assert bool(solution.polished)
    assert int(solution.statistics.substeps) > 2
    assert float(solution.statistics.integration_error) < 1e-4


def test_the_error_of_a_single_step_is_known():
    one, two = (drained(min_substeps=n, max_substeps=n) for n in (7, 14))
    error = float(one.statistics.integration_error)
    np.testing.assert_allclose(error / 16, two.statistics.integration_error, rtol=0.5)
    problem = textbook.minimum_energy_double_integrator()
    settings = jaxscp.Discretization(min_substeps=1, max_substeps=1)
    solution = jaxscp.solve(problem, nodes=7, discretization=settings)
    assert int(solution.statistics.substeps) == 1
    # The flow is a parabola, which one step follows exactly.
    assert float(solution.statistics.integration_error) < 1e-12


class Lagging(eqx.Module):
    """A cart whose push follows the command with a lag [s]."""

    lag: jax.Array

    def __call__(self, t, x, u):
        return jnp.stack([x[1], x[2], (u[0] - x[2]) / self.lag])


def behind(lag) -> OptimalControlProblem:
    return OptimalControlProblem(
        Lagging(jnp.asarray(lag)),
        running_cost=lambda t, x, u: u @ u,
        state=Bounds([-5.0, -5.0, -3.0], [20.0, 5.0, 3.0]),
        control=Bounds([-2.0], [2.0]),
        initial_state=Bounds.exactly([0.0, 0.0, 0.0]),
        final_state=Bounds.exactly([10.0, 0.0, 0.0]),
        final_time=Bounds.exactly(10.0),
    )


@pytest.mark.parametrize("lag", [0.1, 0.02, 0.01])
def test_a_short_lag_asks_for_substeps_once(lag):
    solution = jaxscp.solve(behind(lag), nodes=30)
    assert bool(solution.polished)
    # In intervals of 1/3 s steps of a seventh of the lag are stable, and accurate.
    assert int(solution.statistics.substeps) > 1 / (2.8 * 3 * lag)
    assert steps(solution) < 20
    assert jaxscp.verify(solution.problem, solution).verified
    # All but without a lag it takes 12 * 10^2 / 10^3, but for the held control.
    assert solution.objective == pytest.approx(1.2, rel=0.15)


def test_of_too_short_a_lag_it_says_what_to_do():
    with pytest.raises(jaxscp.SolveError, match=r"stiff dynamics need Discretization"):
        jaxscp.solve(behind(1e-4), nodes=30)


def test_a_small_cost_is_as_exact_as_a_large_one():
    def following(t, x, u):
        return (x[0] - jnp.sin(t)) ** 2 + 1e-3 * u @ u

    problem = OptimalControlProblem(
        lambda t, x, u: 50.0 * (u - x),
        running_cost=following,
        state=Bounds([-5.0], [5.0]),
        control=Bounds([-5.0], [5.0]),
        initial_state=Bounds.exactly([0.0]),
        final_time=Bounds.exactly(10.0),
    )
    solution = jaxscp.solve(problem, nodes=50)
    flown = jaxscp.verify(problem, solution)
    # Scales are those of the limits, of which it uses a fifth.
    assert 0.0 < solution.objective < 0.02
    assert solution.objective == pytest.approx(flown.objective, rel=1e-3)
