"""What an optimum's derivatives are worth, where the answer is known."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree
from swing import swing_at_its_limit

import jaxscp
from jaxscp import Discretization, FirstOrderHold, textbook
from jaxscp._kkt import conditions
from jaxscp._regularity import regularity

LINEAR = Discretization(hold=FirstOrderHold())


class TestBrysonDenham:
    """At most l from the start: felt below l = 1/4, and just not at it."""

    @staticmethod
    def report(limit):
        problem = textbook.bryson_denham(limit)
        solution = jaxscp.solve(problem, nodes=9, discretization=LINEAR)
        # The position's limit alone.
        return jaxscp.sensitivity_report(problem, solution, {"state.upper": [1.0, 0.0]})

    def test_a_regular_optimum(self):
        """The multiplier, 48 (1 - 4 l), vanishes at l = 1/4."""
        report = self.report(0.2)
        assert report.regular, str(report)
        touch = next(each for each in report.active if each.limit.name == "position")
        assert (touch.limit.limit, touch.limit.node) == ("upper limit", 4)
        assert touch.multiplier == pytest.approx(48 * (1 - 4 * 0.2), rel=1e-6)
        for answer in (report.ahead, report.behind):
            assert float(answer.rates.objective) == pytest.approx(-9.6, rel=1e-6)
        assert report.ahead.reach == pytest.approx(0.05, rel=1e-6)
        assert report.ahead.next_limit == touch.limit
        assert "position, upper limit: 4" in str(report)

    def test_where_the_limit_is_only_just_met(self):
        """A wider one changes nothing; a tighter one, to first order, the controls:
        u = -8 (1 - 3 l) + 24 (1 - 4 l) t before it is met.
        """
        report = self.report(0.25)
        assert not report.regular
        (weak,) = report.weakly_active
        assert str(weak.limit) == "position, upper limit, at node 4 (0.5 s)"
        assert report.doubts == ("Weakly active: position, upper limit: 4.",)
        assert report.nearest == weak
        assert report.margin < 1e-9
        ahead, behind = (
            answer.rates.trajectory.controls[:, 0]
            for answer in (report.ahead, report.behind)
        )
        np.testing.assert_allclose(ahead, 0.0, atol=1e-8)
        early = 24 - 96 * np.linspace(0, 0.5, 5)
        expected = np.concatenate([early, early[-2::-1]])
        np.testing.assert_allclose(behind, expected, atol=1e-6)


class TestMinimumTime:
    """With an even number of intervals both limits meet at the switch: one too many."""

    @staticmethod
    def solved(upper):
        problem = textbook.minimum_time_double_integrator(1.3, 0.9)
        problem = eqx.tree_at(lambda p: p.control.upper, problem, jnp.full(1, upper))
        return problem, jaxscp.solve(problem, nodes=7)

    def test_both_derivatives(self):
        """The limits before and behind the switch depend on each other: one takes over
        the other's multiplier.
        """
        problem, solution = self.solved(0.9)
        report = jaxscp.sensitivity_report(problem, solution, {"control.upper": 1.0})
        assert not report.regular
        ahead, behind = (
            float(answer.rates.trajectory.final_time)
            for answer in (report.ahead, report.behind)
        )
        assert abs(ahead - behind) > 0.4
        step, time = 1e-4, float(solution.objective)
        for slope, way in ((ahead, step), (behind, -step)):
            moved = float(self.solved(0.9 + way)[1].objective)
            assert slope == pytest.approx((moved - time) / way, rel=1e-3)

    def test_a_direction_without_a_kink(self):
        """Both limits together: the time is 2 sqrt(d / a)."""
        problem, solution = self.solved(0.9)
        report = jaxscp.sensitivity_report(
            problem, solution, {"control.upper": 1.0, "control.lower": -1.0}
        )
        slope = -np.sqrt(1.3 / 0.9**3)
        for answer in (report.ahead, report.behind):
            found = float(answer.rates.trajectory.final_time)
            assert found == pytest.approx(slope, rel=1e-6)


@pytest.fixture(scope="module")
def swung():
    problem = swing_at_its_limit()
    return problem, jaxscp.solve(problem, nodes=15)


class TestOfEverything:
    """Against the whole matrix of the conditions, and other ways to the same numbers."""

    @staticmethod
    def matrix(transcription, optimum):
        flat, unravel = ravel_pytree(optimum.point)

        def left(flat):
            found = conditions(transcription, optimum, unravel(flat))
            return ravel_pytree(found)[0]

        return np.asarray(jax.jacfwd(left)(flat))

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
            found = jaxscp.solve(problem, solution.trajectory)
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
