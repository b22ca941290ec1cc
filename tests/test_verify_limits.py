"""The limits that `verify` finds broken, on trajectories known by hand."""

import math

import jax.numpy as jnp
import numpy as np
import pytest
from by_hand import constant_acceleration, motion

from jaxscp import (
    Bounds,
    Integral,
    OptimalControlProblem,
    Trajectory,
    verify,
)


def rising_and_falling() -> tuple[OptimalControlProblem, Trajectory]:
    """Thrown up at 2 m/s under -1 m/s^2: the top, 2 m, lies at 2 s, between nodes."""
    problem = motion(
        initial_state=Bounds.exactly(jnp.array([0.0, 2.0])),
        path_constraints={"ceiling": lambda t, x, u: x[:1] - 1.95},
        units={"position": "m", "velocity": "m/s", "ceiling": "m"},
    )
    return problem, constant_acceleration(-1.0, 2.0, nodes=4)


def test_a_breach_between_nodes_is_found_there_alone():
    problem, trajectory = rising_and_falling()
    # Nodes at 4/3 s and 8/3 s: 16/9 m, below the ceiling.
    result = verify(problem, trajectory, samples=101)
    assert result.verified
    assert result.node_violations == {}
    assert set(result.violations) == {"ceiling"}
    ceiling = result.violations["ceiling"]
    assert ceiling.value == pytest.approx(0.05, abs=1e-10)
    assert ceiling.time == pytest.approx(2.0, abs=1e-10)
    assert ceiling.unit == "m"
    assert "ceiling broken by 0.05 m at 2.000 s" in str(result)
    assert not verify(problem, trajectory, samples=101, between=True).verified


def test_a_state_limit_between_nodes():
    _, trajectory = rising_and_falling()
    problem = motion(
        initial_state=Bounds.exactly(jnp.array([0.0, 2.0])),
        state=Bounds(jnp.array([-1.0, -5.0]), jnp.array([1.9, 5.0])),
    )
    result = verify(problem, trajectory, samples=11)
    assert result.node_violations == {}
    assert result.violations["position"].value == pytest.approx(0.1, abs=1e-10)
    assert result.violations["position"].time == pytest.approx(2.0)


def test_limits_at_nodes_are_named_with_unit_and_time():
    problem = motion(
        state=Bounds(jnp.array([-1.0, -10.0]), jnp.array([20.0, 6.0])),
        control=Bounds(-jnp.ones(1), jnp.array([1.5])),
        initial_state=Bounds.exactly(jnp.array([0.0, 0.5])),
        final_state=Bounds(jnp.array([17.0, -jnp.inf]), jnp.array([18.0, jnp.inf])),
        final_time=Bounds(1.0, 3.5),
        path_constraints={
            "walls": lambda t, x, u: jnp.stack([x[0] - 12.0, -x[0], x[1] - 7.0])
        },
        units={"walls": "m", "velocity": "m/s", "acceleration": "m/s^2"},
    )
    result = verify(problem, constant_acceleration())
    assert not result.verified
    found = {
        name: (violation.value, violation.unit, violation.time)
        for name, violation in result.node_violations.items()
    }
    assert found == {
        "velocity": (pytest.approx(2.0), "m/s", 4.0),
        "acceleration": (pytest.approx(0.5), "m/s^2", 0.0),
        "walls[0]": (pytest.approx(4.0), "m", 4.0),
        "walls[2]": (pytest.approx(1.0), "m", 4.0),
        "initial velocity": (pytest.approx(0.5), "m/s", 0.0),
        "final position": (pytest.approx(1.0), "", 4.0),
        "final_time": (pytest.approx(0.5), "s", 4.0),
    }
    assert set(result.violations) == set(found)


def test_a_breach_below_the_tolerance_is_none():
    def limited(top):
        return motion(state=Bounds(jnp.array([-4.0, -9.0]), jnp.array([top, 9.0])))

    trajectory = constant_acceleration()
    assert verify(limited(16.0 - 1.9e-3), trajectory).verified
    assert not verify(limited(16.0 - 2.1e-3), trajectory).verified
    assert verify(limited(16.0 - 2.1e-3), trajectory, tolerance=2e-4).verified


def with_integrals(lower_of_time_squared: float) -> OptimalControlProblem:
    """Integrals known by hand, their names not in alphabetical order."""
    return motion(
        running_cost=lambda t, x, u: jnp.exp(-t),
        terminal_cost=lambda t_f, x_f: 10 * t_f + x_f[1],
        integrals={
            "time squared": Integral(
                lambda t, x, u: t**2, Bounds.at_least(lower_of_time_squared)
            ),
            "distance": Integral(lambda t, x, u: x[1], Bounds(0.0, 20.0)),
        },
        units={"time squared": "s^3", "distance": "m"},
    )


def test_integrals_and_costs_of_known_functions():
    result = verify(with_integrals(21.0), constant_acceleration(), samples=5)
    assert result.integrals == {
        "time squared": pytest.approx(64 / 3, rel=1e-10),
        "distance": pytest.approx(16.0, rel=1e-10),
    }
    running = 1 - math.exp(-4.0)
    assert result.objective == pytest.approx(running + 40.0 + 8.0, rel=1e-10)
    assert result.verified
    dense = result.dense
    assert dense.times.shape == (8 * 5,)
    np.testing.assert_allclose(dense.states[:, 0], dense.times**2, atol=1e-9)
    np.testing.assert_allclose(dense.integrands["time squared"], dense.times**2)
    np.testing.assert_allclose(
        dense.accumulated["time squared"], dense.times**3 / 3, atol=1e-9
    )


def test_an_integral_short_of_its_limit():
    # 99.99 percent of what is required will do.
    assert verify(with_integrals(64 / 3 * 1.00009), constant_acceleration()).verified
    result = verify(with_integrals(64 / 3 + 1.0), constant_acceleration())
    assert not result.verified
    short = result.node_violations["time squared"]
    assert short.value == pytest.approx(1.0, abs=1e-8)
    assert (short.unit, short.time) == ("s^3", 4.0)
    assert result.violations == result.node_violations


def test_a_non_finite_path_constraint_is_an_infinite_breach():
    problem = motion(path_constraints={"root": lambda t, x, u: jnp.sqrt(x[:1] - 1) - 9})
    result = verify(problem, constant_acceleration())
    assert not result.verified
    assert result.node_violations["root"].value == math.inf
    assert result.node_violations["root"].time == 0.0


def test_a_path_constraint_named_like_a_state():
    problem = motion(
        state=Bounds(-99.0 * jnp.ones(2), jnp.array([10.0, 99.0])),
        path_constraints={"position": lambda t, x, u: x[:1] - 12.0},
    )
    found = verify(problem, constant_acceleration()).node_violations
    assert found["position"].value == pytest.approx(6.0)
    assert found["path position"].value == pytest.approx(4.0)
