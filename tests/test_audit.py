"""Derivatives audited: right ones pass, and a wrong one does not."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxscp
from jaxscp import textbook


class Dragged(eqx.Module):
    """A double integrator with drag."""

    drag: jax.Array

    def __call__(self, t, x, u):
        return jnp.stack([x[1], u[0] - self.drag * x[1]])


@pytest.fixture
def dragged():
    problem = textbook.minimum_time_double_integrator(1.3, 0.9)
    # Of a weak type, as without `float`, the first solve would be compiled for itself.
    drag = Dragged(jnp.asarray(0.1, float))
    return eqx.tree_at(lambda p: p.dynamics, problem, drag)


@pytest.mark.slow
def test_every_parameter_of_a_problem(dragged):
    """With an even number of intervals a control would be weakly active: no kink here."""
    audit = jaxscp.audit_gradient(dragged, nodes=8)
    names = [row.name for row in audit.rows]
    assert names == [
        "dynamics.drag",
        "control.lower",
        "control.upper",
        "initial_state.value",
        "final_state.value",
        "final_time.lower",
        "final_time.upper",
    ]
    assert audit.passed, str(audit)
    for row in audit.rows[:5]:
        assert abs(row.implicit) > row.noise
        assert row.envelope == pytest.approx(row.implicit, rel=1e-7)
    assert str(audit).count("pass") == 7


def test_a_lost_derivative_fails(dragged):
    def lost(solution):
        return jax.lax.stop_gradient(solution.trajectory.final_time)

    steps = (1e-1, 1e-2)
    audit = jaxscp.audit_gradient(dragged, lost, ["dynamics"], nodes=8, steps=steps)
    (row,) = audit.rows
    assert row.implicit == 0.0
    assert not audit.passed
    assert "FAIL" in str(audit)


def test_an_unknown_name():
    problem = textbook.minimum_energy_double_integrator()
    with pytest.raises(ValueError, match=r"wrt=\['mass'\]: no parameter.*final_time.val"):
        jaxscp.audit_gradient(problem, wrt=["mass"], nodes=8)


def test_an_unknown_quantity():
    problem = textbook.minimum_energy_double_integrator()
    with pytest.raises(ValueError, match=r"of='energy': choose 'objective' or 'final_t"):
        jaxscp.audit_gradient(problem, "energy", nodes=8)


def test_solves_that_fail_fail_their_row_alone(dragged):
    """Limits that cross leave no problem to solve."""
    seen = []
    audit = jaxscp.audit_gradient(
        dragged,
        wrt=["final_state", "dynamics"],
        nodes=8,
        steps=(60.0, 50.0),
        progress=seen.append,
    )
    assert [row.name for row in seen] == ["dynamics.drag", "final_state.value"]
    assert not seen[1].passed
    assert np.isnan(seen[1].difference)
    assert "nan" in str(audit)


def test_a_step_that_fails_is_passed_over(dragged):
    steps = (60.0, 1e-2)
    audit = jaxscp.audit_gradient(dragged, wrt=["final_state"], nodes=8, steps=steps)
    assert audit.passed
    assert audit.rows[0].step == 1e-2
