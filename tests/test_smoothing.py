"""Smoothed derivatives, where the sharp ones jump: Bryson-Denham at l = 1/4."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

import jaxscp
from jaxscp import Discretization, FirstOrderHold, textbook
from jaxscp._kkt import KKTPoint, conditions
from jaxscp._kkt_system import kkt_solve
from jaxscp._smoothing import softened

LINEAR = Discretization(hold=FirstOrderHold())
KINK = 0.25
# What the controls change by with the limit where it holds, and where it doesn't.
TIMES = np.linspace(0.0, 1.0, 9)
HELD = 24.0 - 96.0 * np.minimum(TIMES, 1.0 - TIMES)
FREE = np.zeros(9)


def solved(limit, smoothing):
    problem = textbook.bryson_denham(limit)
    return jaxscp.solve(
        problem, nodes=9, discretization=LINEAR, smoothing=smoothing, throw=False
    )


@jax.jit
def slopes(limit, smoothing):
    """Derivatives of objective and controls by the limit."""

    def outputs(limit):
        solution = solved(limit, smoothing)
        return solution.objective, solution.trajectory.controls[:, 0]

    return jax.jacfwd(outputs)(limit)


def weighed(limit, smoothing):
    """The derivative of a sum of the controls, in reverse, and without `jax.jit`."""
    weights = jnp.arange(9.0)
    return jax.grad(lambda at: weights @ solved(at, smoothing).trajectory.controls[:, 0])(
        limit
    )


def test_sharp_derivatives_jump():
    np.testing.assert_allclose(slopes(KINK - 1e-6, 0.0)[1], HELD, atol=1e-6)
    np.testing.assert_allclose(slopes(KINK + 1e-6, 0.0)[1], FREE, atol=1e-6)


def test_a_smoothing_that_fades_to_nothing_is_finite():
    """Where a limit is weakly active, and the compiled program is told to smooth by 0."""
    assert np.isfinite(slopes(KINK, 0.0)[1]).all()


def test_smoothed_derivatives_are_between_and_do_not_jump():
    below, at, above = (
        slopes(limit, 1e-6)[1] for limit in (KINK - 1e-6, KINK, KINK + 1e-6)
    )
    share = np.asarray(at)[0] / HELD[0]
    assert 0.1 < share < 0.9
    # One limit holds in part, and everything follows; what others add is small.
    np.testing.assert_allclose(at, share * HELD, atol=0.02)
    step = np.max(np.abs(above - below))
    assert step < 0.05 * HELD[0]


def test_they_fade_from_one_to_the_other():
    # Python's numbers, as elsewhere: NumPy's would be compiled anew.
    limits = np.linspace(0.24, 0.26, 7).tolist()
    shares = [float(slopes(limit, 1e-6)[1][0]) / HELD[0] for limit in limits]
    assert shares == sorted(shares, reverse=True)
    assert shares[0] > 0.9
    assert shares[-1] < 0.1


def test_the_bias_is_proportional_to_the_smoothing():
    errors = [np.max(np.abs(slopes(0.2, tau)[1] - HELD)) for tau in (1e-5, 1e-6, 1e-7)]
    np.testing.assert_allclose(np.divide(errors[:-1], errors[1:]), 10.0, rtol=0.1)


@pytest.mark.parametrize("limit", [0.2, KINK])
def test_the_objective_is_not_smoothed(limit):
    """Its derivative, -48 (1 - 4 l), is continuous as it is."""
    np.testing.assert_allclose(
        slopes(limit, 1e-3)[0], -48.0 * (1.0 - 4.0 * limit), atol=1e-6
    )


@pytest.mark.parametrize("limit", [0.22, KINK, 0.252])
def test_forward_is_reverse(limit):
    expected = jnp.arange(9.0) @ slopes(limit, 1e-5)[1]
    np.testing.assert_allclose(weighed(limit, 1e-5), expected, rtol=1e-9)


def test_the_system_is_that_of_the_conditions():
    """Against the whole matrix, with all of the limits soft."""
    problem = textbook.bryson_denham(0.2)
    solution = jaxscp.solve(problem, nodes=9, discretization=LINEAR)
    transcription = solution.transcription
    optimum = softened(transcription, solution.optimum, jnp.asarray(1e-3))
    flat, unravel = ravel_pytree(optimum.point)
    assert np.sum(np.abs(ravel_pytree(optimum.active)[0]) % 1.0 > 0.0) > 5

    def left(flat):
        return ravel_pytree(conditions(transcription, optimum, unravel(flat)))[0]

    matrix = jax.jit(jax.jacfwd(left))(flat)
    np.testing.assert_allclose(matrix, matrix.T, atol=1e-12)
    right = jax.random.normal(jax.random.key(0), flat.shape)
    answer = eqx.filter_jit(kkt_solve)(transcription, optimum, unravel(right)).point
    assert isinstance(answer, KKTPoint)
    expected = np.linalg.solve(matrix, right)
    np.testing.assert_allclose(
        ravel_pytree(answer)[0], expected, rtol=1e-7, atol=1e-8 * np.max(np.abs(expected))
    )


@pytest.mark.parametrize("smoothing", [-1e-6, np.nan, np.inf])
def test_bad_smoothing_is_named(smoothing):
    with pytest.raises(ValueError, match="smoothing="):
        jaxscp.solve(textbook.bryson_denham(0.2), nodes=9, smoothing=smoothing)
