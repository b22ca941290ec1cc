"""What an optimum's derivatives are worth, and that all ways to them agree."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree
from swing import swing_at_its_limit, swung as solved

import jaxscp
from jaxscp._kkt import conditions
from jaxscp._regularity import regularity


@pytest.fixture(scope="module")
def swung():
    problem = swing_at_its_limit()
    return problem, solved(problem)


class TestOfEverything:
    """Against the whole matrix of the conditions, and other ways to the same numbers."""

    @staticmethod
    def matrix(transcription, optimum):
        flat, unravel = ravel_pytree(optimum.point)

        def left(flat):
            found = conditions(transcription, optimum, unravel(flat))
            return ravel_pytree(found)[0]

        # One by one its operations would each be compiled: 500 of them.
        return np.asarray(jax.jit(jax.jacfwd(left))(flat))

    def test_condition_and_inertia(self, swung):
        problem, solution = swung
        optimum = solution.optimum
        matrix = self.matrix(solution.transcription, optimum)
        values = np.linalg.eigvalsh(0.5 * (matrix + matrix.T))
        report = jaxscp.sensitivity_report(problem, solution)
        condition = np.max(np.abs(values)) / np.min(np.abs(values))
        assert 0.5 * condition < report.condition < 1.001 * condition
        # As many negative ones as there are multipliers: a strict minimum.
        point = optimum.point
        multipliers = ravel_pytree((point.multipliers, point.limits))[0]
        assert np.sum(values < 0) == multipliers.size
        assert report.convexity > 0
        assert report.regular, str(report)

    def test_a_maximum_is_none(self, swung):
        """Where effort pays the same point is no minimum."""
        _, solution = swung
        transcription, optimum = solution.transcription, solution.optimum
        paid = eqx.tree_at(
            lambda t: t.problem.running_cost.unit, transcription, -jnp.ones(())
        )
        assert float(regularity(paid, optimum).convexity) < 0

    def test_the_limits_bear_their_prices(self, swung):
        problem, solution = swung
        report, prices = (
            jaxscp.sensitivity_report(problem, solution),
            jaxscp.shadow_prices(solution),
        )
        for name, limit, sign in (
            ("u[0]", "upper limit", -1),
            ("u[0]", "lower limit", 1),
            ("ceiling", "margin", 1),
            ("lift", "lower limit", 1),
        ):
            felt = sum(
                each.multiplier
                for each in report.active
                if (each.limit.name, each.limit.limit) == (name, limit)
            )
            price = float(prices.of(name, limit))
            assert felt * sign == pytest.approx(price, rel=1e-6, abs=1e-6)

    def test_rates_are_derivatives(self, swung):
        problem, solution = swung
        changes = {"dynamics.angle": 0.1, "control": [0.2], "final_state": [0.1, 0.0]}
        report = jaxscp.sensitivity_report(problem, solution, changes)

        def of(problem):
            found = solved(problem, solution.trajectory)
            return found.objective, found.trajectory.states, found.multipliers

        way = jax.tree.map(jnp.zeros_like, eqx.filter(problem, eqx.is_inexact_array))
        way = eqx.tree_at(
            lambda p: (
                p.dynamics.angle,
                *(p.control.lower, p.control.upper),
                *(p.final_state.lower, p.final_state.upper),
            ),
            way,
            (jnp.asarray(0.1), *[jnp.full(1, 0.2)] * 2, *[jnp.array([0.1, 0.0])] * 2),
        )
        _, expected = eqx.filter_jvp(of, (problem,), (way,))
        for answer in (report.ahead, report.behind):
            rates = answer.rates
            found = (rates.objective, rates.trajectory.states, rates.multipliers)
            for one, other in zip(*map(jax.tree.leaves, (found, expected)), strict=True):
                np.testing.assert_allclose(one, other, rtol=1e-7, atol=1e-8)
        assert report.ahead.reach > 0 > report.behind.reach


class TestRefusals:
    @pytest.mark.parametrize(
        ("direction", "message"),
        [
            ({"mass": 1.0}, r"mass: no such entry; valid ones are .*control\.upper"),
            ({"control": [1.0, 2.0]}, r"control has shape \(1,\), its change \(2,\)"),
        ],
    )
    def test_a_direction_that_is_none(self, swung, direction, message):
        with pytest.raises(ValueError, match=message):
            jaxscp.sensitivity_report(*swung, direction)

    def test_a_solution_that_is_not_polished(self, swung):
        problem, solution = swung
        rough = eqx.tree_at(lambda s: s.status, solution, jaxscp.Status.converged_roughly)
        with pytest.raises(ValueError, match="derivatives need a solution of ProximalSC"):
            jaxscp.sensitivity_report(problem, rough)
