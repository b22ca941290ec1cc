"""`verify` against trajectories known by hand, none of them solved by the library."""

import ast
import inspect
import math
from pathlib import Path

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from by_hand import constant_acceleration, motion, shifted

from jaxscp import (
    AbstractHold,
    Bounds,
    FirstOrderHold,
    OptimalControlProblem,
    Trajectory,
    Verification,
    ZeroOrderHold,
    verify,
)


@pytest.mark.parametrize("hold", [None, ZeroOrderHold(), FirstOrderHold()])
def test_an_exact_trajectory_passes(hold):
    problem = motion(running_cost=lambda t, x, u: u @ u)
    result = verify(problem, constant_acceleration(), hold=hold)
    assert result.verified
    assert result.violations == {}
    assert result.interval_errors.shape == (8, 2)
    np.testing.assert_allclose(result.interval_errors, 0, atol=1e-12)
    np.testing.assert_allclose(result.flight_error, 0, atol=1e-12)
    assert result.objective == pytest.approx(2.0**2 * 4.0, rel=1e-12)


def test_uneven_nodes():
    fractions = jnp.array([0.0, 0.03, 0.5, 0.9, 1.0])
    t = 4.0 * fractions
    states = jnp.stack([t**2, 2 * t], axis=1)
    trajectory = Trajectory(fractions, states, jnp.full((5, 1), 2.0), jnp.asarray(4.0))
    result = verify(motion(), trajectory)
    np.testing.assert_allclose(result.interval_errors, 0, atol=1e-12)
    assert verify(motion(), shifted(trajectory, 3, 0, 0.1)).worst_interval[0] in {2, 3}


def test_a_shifted_node_is_found_with_its_amount():
    result = verify(motion(), shifted(constant_acceleration(), 3, 0, 0.01))
    assert not result.verified
    assert result.violations == {}
    expected = np.zeros((8, 2))
    expected[2:4, 0] = 0.01  # arrives 0.01 short, and leaves 0.01 too far on
    np.testing.assert_allclose(result.interval_errors, expected, atol=1e-12)
    # The whole flight starts from the first node: the shift does not reach it.
    np.testing.assert_allclose(result.flight_error, 0, atol=1e-12)
    # Rounding decides which of the two is the worst.
    interval, entry = result.worst_interval
    assert interval in {2, 3}
    assert entry == 0
    where = f"after interval {interval}, from {0.5 * interval:.3f} s"
    assert f"position 0.01 m off {where}" in str(result)


def test_interval_tolerance_is_relative_to_the_motion():
    # 16 m are covered: 1e-4 of it is 1.6 mm.
    assert verify(motion(), shifted(constant_acceleration(), 3, 0, 1.5e-3)).verified
    nearby = shifted(constant_acceleration(), 3, 0, 1.7e-3)
    assert not verify(motion(), nearby).verified
    assert verify(motion(), nearby, interval_tolerance=1e-3).verified


@pytest.mark.parametrize("reach", [1e2, 1e4, 1e7])
def test_limits_far_out_allow_no_more(reach):
    problem = motion(state=Bounds([-reach, -reach], [reach, reach]))
    assert verify(problem, shifted(constant_acceleration(), 3, 0, 1.5e-3)).verified
    nearby = shifted(constant_acceleration(), 3, 0, 1.7e-3)
    assert not verify(problem, nearby).verified


@pytest.mark.parametrize("reach", [1e2, 1e4, 1e7])
def test_a_limit_counts_however_far_out_the_other_is(reach):
    ceiling = motion(state=Bounds([-reach, -jnp.inf], [15.9, jnp.inf]))
    # It arrives at 16 m.
    assert "position" in verify(ceiling, constant_acceleration()).violations


def test_noise_in_a_resting_state_is_no_motion():
    coasting = constant_acceleration(acceleration=0.0, velocity=1.0)
    problem = motion(initial_state=Bounds.free(2))
    assert verify(problem, shifted(coasting, 3, 1, 1e-9)).verified
    assert not verify(problem, shifted(coasting, 3, 1, 1e-4)).verified


def test_the_holds_differ_as_they_should():
    # u(t) = t as a ramp gives v = t^2 / 2; as a staircase on n intervals of width h,
    # left ends only, it lacks h / 2 of every second.
    fractions = jnp.linspace(0.0, 1.0, 5)
    t = 2.0 * fractions
    states = jnp.stack([t**3 / 6, t**2 / 2], axis=1)
    ramp = Trajectory(fractions, states, t[:, None], jnp.asarray(2.0))
    problem = motion(final_time=Bounds.exactly(2.0))
    linear = verify(problem, ramp, hold=FirstOrderHold())
    np.testing.assert_allclose(linear.interval_errors, 0, atol=1e-12)
    held = verify(problem, ramp, hold=ZeroOrderHold())
    np.testing.assert_allclose(held.interval_errors[:, 1], 0.5 * 0.5**2, atol=1e-12)
    np.testing.assert_allclose(held.flight_error[1], 2.0 * 0.25, atol=1e-12)
    assert linear.verified
    assert not held.verified
    # A held control is constant along its interval, a linear one is not.
    assert np.unique(held.dense.controls).size == 4
    np.testing.assert_allclose(linear.dense.controls[:, 0], linear.dense.times)


def test_a_held_control_after_the_last_node_counts_for_nothing():
    trajectory = constant_acceleration()
    controls = trajectory.controls.at[-1].set(99.0)
    changed = eqx.tree_at(lambda trajectory: trajectory.controls, trajectory, controls)
    assert verify(motion(), changed).verified
    result = verify(motion(), changed, hold=FirstOrderHold())
    assert result.node_violations["acceleration"].value == pytest.approx(96.0)


def test_time_dependent_dynamics_see_the_time():
    def pushed(t, x, u):
        return jnp.stack([jnp.cos(t)])

    problem = OptimalControlProblem(
        pushed,
        state=Bounds.free(1),
        control=Bounds.free(1),
        final_time=Bounds.exactly(3.0),
    )
    fractions = jnp.linspace(0.0, 1.0, 7)
    states = jnp.sin(3.0 * fractions)[:, None]
    trajectory = Trajectory(fractions, states, jnp.zeros((7, 1)), jnp.asarray(3.0))
    result = verify(problem, trajectory)
    assert result.verified
    np.testing.assert_allclose(result.interval_errors, 0, atol=1e-11)


def test_an_unstable_flight_strays_but_its_intervals_hold():
    def unstable(t, x, u):
        return 40.0 * x + u

    problem = OptimalControlProblem(
        unstable,
        state=Bounds(-jnp.ones(1), jnp.ones(1)),
        control=Bounds.free(1),
        final_time=Bounds.exactly(2.0),
    )
    fractions = jnp.linspace(0.0, 1.0, 101)
    # x = exp(-t) needs u = -41 x; held, it is off a little, and 40/s amplifies that.
    states = jnp.exp(-2.0 * fractions)[:, None]
    step = 0.02
    growth = math.exp(40.0 * step)
    # The constant control that leads exactly from node to node.
    held = 40.0 * (states[1:] - growth * states[:-1]) / (growth - 1)
    controls = jnp.concatenate([held, held[-1:]]) * (1 + 1e-9)
    trajectory = Trajectory(fractions, states, controls, jnp.asarray(2.0))
    result = verify(problem, trajectory)
    assert result.verified
    assert result.flight_error is None
    assert "strays from the nodes" in str(result)


def falls_apart_after(limit):
    def dynamics(t, x, u):
        return jnp.stack([x[1], u[0] / jnp.where(x[0] < limit, 1.0, 0.0)])

    return dynamics


def test_non_finite_dynamics_are_reported_and_not_verified():
    problem = motion()
    problem = eqx.tree_at(lambda p: p.dynamics, problem, falls_apart_after(9.5))
    # 9.5 m is passed after 3.08 s, in the seventh interval of half a second each.
    result = verify(problem, constant_acceleration())
    assert not result.verified
    finite = np.all(np.isfinite(result.interval_errors), axis=1)
    np.testing.assert_array_equal(finite, [True] * 6 + [False] * 2)
    np.testing.assert_allclose(result.interval_errors[:6], 0, atol=1e-12)
    assert result.flight_error is None
    assert result.worst_interval[0] == 6
    assert math.isnan(result.objective)
    assert "nan" in str(result)


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_a_non_finite_node_is_not_verified(value):
    result = verify(motion(), shifted(constant_acceleration(), 3, 0, value))
    assert not result.verified
    finite = np.all(np.isfinite(result.interval_errors), axis=1)
    np.testing.assert_array_equal(finite, [True] * 2 + [False] * 2 + [True] * 4)
    # Where it is, but for the whole flight, which never comes by.
    assert result.worst_interval[0] == 2


class UnknownHold(AbstractHold):
    def control_nodes(self, nodes):
        return nodes

    def interpolate(self, left, right, fraction):
        return right


@pytest.mark.parametrize(
    ("change", "settings", "message"),
    [
        (lambda t: t.states, {}, r"states has shape \(9, 3\): .* \(9, 2\)"),
        (lambda t: t.controls, {}, r"controls has shape \(9, 2\): .* \(9, 1\)"),
        (None, {"samples": 1}, "samples=1"),
        (None, {"hold": UnknownHold()}, "hold=UnknownHold.*ZeroOrderHold"),
    ],
)
def test_bad_input(change, settings, message):
    trajectory = constant_acceleration()
    if change is not None:
        wide = jnp.pad(change(trajectory), ((0, 0), (0, 1)))
        trajectory = eqx.tree_at(change, trajectory, wide)
    with pytest.raises(ValueError, match=message):
        verify(motion(), trajectory, **settings)


@pytest.mark.parametrize("final_time", [0.0, -1.0, math.nan, math.inf])
def test_bad_final_time(final_time):
    trajectory = eqx.tree_at(
        lambda t: t.final_time, constant_acceleration(), jnp.asarray(final_time)
    )
    with pytest.raises(ValueError, match="final_time="):
        verify(motion(), trajectory)


def test_a_new_parameter_value_compiles_nothing():
    traces = []

    class Drag(eqx.Module):
        coefficient: jnp.ndarray

        def __call__(self, t, x, u):
            traces.append(None)
            return jnp.stack([x[1], u[0] - self.coefficient * x[1]])

    for value in (0.0, 0.5, 1.0):
        problem = motion()
        drag = Drag(jnp.asarray(value))
        problem = eqx.tree_at(lambda p: p.dynamics, problem, drag)
        result = verify(problem, constant_acceleration())
        assert result.verified == (value == 0.0)
        if value == 0.0:
            first = len(traces)
    assert len(traces) == first


def test_it_shares_no_code_with_the_discretization():
    forbidden = {"_discretization", "_transcription", "_hold"}
    package = Path(inspect.getfile(Verification)).parent
    seen, waiting = set(), ["verify"]
    while waiting:
        name = waiting.pop()
        seen.add(name)
        tree = ast.parse((package / f"{name}.py").read_text())
        for node in ast.walk(tree):
            if isinstance(node, ast.ImportFrom) and node.level:
                found = {node.module} if node.module else {a.name for a in node.names}
                waiting.extend(found - seen)
    assert seen.isdisjoint(forbidden)
