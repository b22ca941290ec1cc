"""Derivatives of the optimum, against finite differences of whole solves."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from swing import SHARP, swing, swing_at_its_limit, swung

import jaxscp
from jaxscp import Discretization, FirstOrderHold, textbook


def moved(problem, direction, step):
    """The problem a step along a direction; `None` there is what stays."""
    return eqx.apply_updates(problem, jax.tree.map(lambda way: step * way, direction))


def drawn_direction(problem, seed):
    """Random numbers for finite parameters, of their own size where that is known."""
    draw = np.random.default_rng(seed)

    def of(leaf):
        size = np.where(np.isfinite(leaf) & (leaf != 0.0), np.abs(leaf), 0.0)
        return jnp.asarray(0.3 * size * draw.normal(size=leaf.shape))

    parameters = eqx.filter(problem, eqx.is_inexact_array)
    direction = jax.tree.map(of, parameters)
    # Fixed entries have one value: both ends move together.
    for name in ("initial_state", "final_state"):
        way = getattr(direction, name).lower
        direction = eqx.tree_at(
            lambda d, name=name: getattr(d, name).upper, direction, way
        )
    return direction


def fields(solution):
    """Everything that can be differentiated, in one vector."""
    multipliers = solution.multipliers
    parts = (
        solution.objective,
        solution.integrals["lift"],
        solution.trajectory.final_time,
        solution.trajectory.states,
        solution.trajectory.controls,
        multipliers.dynamics,
        multipliers.path_constraints["ceiling"],
        multipliers.integrals["lift"],
        multipliers.state,
        multipliers.control,
    )
    return jnp.concatenate([jnp.ravel(part) for part in parts])


@pytest.fixture(scope="module")
def problem():
    return swing_at_its_limit()


@pytest.fixture(scope="module")
def solution(problem):
    return swung(problem)


class TestOfEverything:
    """A swing-up with a path constraint, an integral and a free final time."""

    def test_the_constraints_are_active(self, solution):
        """Or what follows would say nothing about them."""
        assert float(jnp.max(solution.multipliers.path_constraints["ceiling"])) > 1e-3
        assert abs(float(solution.multipliers.integrals["lift"])) > 1e-3
        assert float(jnp.max(jnp.abs(solution.multipliers.control))) > 1e-3

    @pytest.mark.parametrize("seed", range(3))
    def test_forward_reverse_and_differences_agree(self, problem, solution, seed):
        direction = drawn_direction(problem, seed)
        guess = solution.trajectory

        def of(problem):
            return fields(swung(problem, guess))

        _, forward = eqx.filter_jvp(of, (problem,), (direction,))
        weights = jnp.asarray(np.random.default_rng(seed).normal(size=forward.shape))
        gradient = eqx.filter_grad(lambda problem: weights @ of(problem))(problem)
        products = jax.tree.map(jnp.vdot, gradient, direction)
        reverse = sum(jax.tree.leaves(products))
        assert float(reverse) == pytest.approx(float(weights @ forward), rel=1e-9)
        step = 1e-5
        high, low = (of(moved(problem, direction, s)) for s in (step, -step))
        differences = (high - low) / (2 * step)
        scale = float(jnp.max(jnp.abs(differences)))
        np.testing.assert_allclose(forward, differences, rtol=1e-4, atol=1e-5 * scale)

    @pytest.mark.parametrize(
        "units",
        [{"cost": 1e6}, {"angle": 0.01, "time": 60.0, "cost": 1e3, "ceiling": 0.1}],
        ids=str,
    )
    def test_units_do_not_matter(self, units):
        """Relative derivatives are pure numbers."""

        def logarithms(problem):
            found = swung(problem)
            return jnp.log(jnp.stack([found.objective, found.trajectory.final_time]))

        def relative(problem):
            # Along zeros in all but one entry: the program of the test above.
            way = jax.tree.map(jnp.zeros_like, eqx.filter(problem, eqx.is_inexact_array))
            at = lambda p: p.integrals["lift"].bounds.lower  # noqa: E731
            way = eqx.tree_at(at, way, at(problem))
            return eqx.filter_jvp(logarithms, (problem,), (way,))[1]

        np.testing.assert_allclose(relative(swing(**units)), relative(swing()), rtol=1e-8)


class TestShadowPrices:
    """What limits cost, against the derivative of the whole solve."""

    def test_are_derivatives_of_the_objective(self, problem, solution):
        gradient = eqx.filter_grad(lambda p: swung(p, solution.trajectory).objective)
        slopes, prices = gradient(problem), jaxscp.shadow_prices(solution)
        of = prices.of
        pairs = [
            (of("lift"), slopes.integrals["lift"].bounds.lower),
            (of("u[0]", "upper limit"), slopes.control.upper[0]),
            (of("u[0]", "lower limit"), slopes.control.lower[0]),
            (of("final time", "upper limit"), slopes.final_time.upper),
            (of("x[0]", "upper limit"), slopes.state.upper[0]),
            (of("ceiling"), -slopes.path_constraints["ceiling"].speed),
        ]
        for node, end in (("first", "initial_state"), ("last", "final_state")):
            ends = getattr(slopes, end)
            for index in range(2):
                both = ends.lower[index] + ends.upper[index]
                pairs.append((of(f"x[{index}]", f"{node} value"), both))
        for price, slope in pairs:
            assert float(price) == pytest.approx(float(slope), rel=1e-7, abs=1e-9)
        assert float(of("lift")) > 1e-3
        assert float(of("ceiling")) > 1e-3
        assert float(of("u[0]", "upper limit")) < -1e-3


class SpeedLimit(eqx.Module):
    speed: jax.Array

    def __call__(self, t, x, u):
        return x[1:] - self.speed


@pytest.mark.slow
def test_a_peak_between_the_nodes():
    """It moves with the limit, and with it the derivatives of the peak."""
    between = Discretization(hold=FirstOrderHold(), between=1)

    def flown(limit):
        problem = textbook.minimum_energy_double_integrator(1.3, 0.9)
        speed = {"speed": SpeedLimit(limit)}
        problem = eqx.tree_at(lambda p: p.path_constraints, problem, speed)
        solution = jaxscp.solve(problem, None, SHARP, nodes=8, discretization=between)
        return solution.objective, solution.trajectory.controls, solution.multipliers

    limit = jnp.asarray(2.1)
    (_, _, multipliers), found = jax.jvp(flown, (limit,), (jnp.ones(()),))
    assert float(jnp.max(multipliers.path_between["speed"])) > 1e-3
    step = 1e-4
    pairs = zip(flown(limit + step)[:2], flown(limit - step)[:2], strict=True)
    for slope, (high, low) in zip(found, pairs, strict=False):
        np.testing.assert_allclose(slope, (high - low) / (2 * step), rtol=1e-5, atol=1e-5)
