"""What an optimum's derivatives are worth, where the answer is known in closed form."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

import jaxscp
from jaxscp import Discretization, FirstOrderHold, textbook

pytestmark = pytest.mark.slow

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
        problem = eqx.tree_at(lambda p: p.control.upper, problem, jnp.array([upper]))
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
