"""`linearize`, against closed forms and other ways to the same."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.linalg import expm
from test_validation import compilations

import jaxscp
from jaxscp import Bounds, Discretization, FirstOrderHold, Integral, OptimalControlProblem

A = np.array([[0.1, 1.0], [-2.0, -0.3]])
B = np.array([[0.0], [2.0]])
FRACTIONS = jnp.array([0.0, 0.2, 0.3, 0.7, 1.0])
TIME = 1.5


def linear(t, x, u):
    return jnp.asarray(A) @ x + jnp.asarray(B) @ u


PROBLEM = OptimalControlProblem(
    linear,
    running_cost=lambda t, x, u: u @ u,
    state=Bounds.free(2),
    control=Bounds.free(1),
    final_time=Bounds(0.5, 9.0),
    integrals={"way": Integral(lambda t, x, u: x[0], Bounds.at_least(0.0, scale=1.0))},
)


@pytest.fixture(scope="module")
def trajectory():
    draw = np.random.default_rng(1)
    states, controls = (jnp.asarray(draw.normal(size=(5, size))) for size in (2, 1))
    return jaxscp.Trajectory(FRACTIONS, states, controls, jnp.asarray(TIME))


def exponential(seconds):
    """Of the linear system with its held control as a state: both matrices at once."""
    whole = expm(seconds * np.block([[A, B], [np.zeros((1, 3))]]))
    return whole[:2, :2], whole[:2, 2:]


def test_a_linear_system_is_its_matrix_exponential(trajectory):
    values, jacobians = jaxscp.linearize(PROBLEM, trajectory, substeps=32)
    found = jacobians.next_state
    for k, width in enumerate(np.diff(FRACTIONS)):
        state, control = exponential(TIME * width)
        x, u = trajectory.states[k], trajectory.controls[k]
        end = state @ x + control @ u
        assert_allclose(found.left_state[k], state, atol=1e-9)
        assert_allclose(found.left_control[k], control, atol=1e-9)
        assert_allclose(values.next_state[k], end, atol=1e-9)
        # The interval ends later by its share of the flight time.
        assert_allclose(found.time[k], width * (A @ end + B @ u), atol=1e-8)


def test_the_cost_of_held_controls_is_exact(trajectory):
    values, jacobians = jaxscp.linearize(PROBLEM, trajectory)
    seconds = TIME * np.diff(FRACTIONS)
    u = np.asarray(trajectory.controls)[:-1]
    assert_allclose(values.increments[:, -1], seconds * u[:, 0] ** 2)
    cost = jacobians.increments.left_control[:, -1]
    assert_allclose(cost, 2.0 * seconds[:, None] * u)


def test_a_first_order_hold_depends_on_both_ends(trajectory):
    hold = Discretization(hold=FirstOrderHold())
    values, jacobians = jaxscp.linearize(PROBLEM, trajectory, hold)
    found = jacobians.next_state
    assert found.right_control is not None
    # A system linear in all but the time: nothing is left of the linearization's error.
    draw = np.random.default_rng(2)
    states, controls = (jnp.asarray(draw.normal(size=(5, size))) for size in (2, 1))
    sums = (trajectory.states + states, trajectory.controls + controls)
    moved = jaxscp.Trajectory(FRACTIONS, *sums, trajectory.final_time)
    there, _ = jaxscp.linearize(PROBLEM, moved, hold)
    change = found.apply(states, controls, jnp.zeros(()))
    assert_allclose(there.next_state - values.next_state, change, atol=1e-12)


def test_it_works_inside_transformations(trajectory):
    def reached(states):
        held = (trajectory.controls, trajectory.final_time)
        moved = jaxscp.Trajectory(FRACTIONS, states, *held)
        return jaxscp.linearize(PROBLEM, moved)[0].next_state

    values, jacobians = jaxscp.linearize(PROBLEM, trajectory)
    assert_allclose(jax.jit(reached)(trajectory.states), values.next_state)
    step = jnp.ones_like(trajectory.states)
    _, change = jax.jvp(reached, (trajectory.states,), (step,))
    assert_allclose(change, jnp.sum(jacobians.next_state.left_state, axis=2))
    both = jax.vmap(reached)(jnp.stack([trajectory.states, trajectory.states + step]))
    assert_allclose(both[1] - both[0], change, atol=1e-12)


def test_what_makes_no_sense_is_refused(trajectory):
    with pytest.raises(ValueError, match="substeps=0: give 1 or more"):
        jaxscp.linearize(PROBLEM, trajectory, substeps=0)
    with pytest.raises(ValueError, match="substeps=3: give 4 or more"):
        jaxscp.linearize(PROBLEM, trajectory, Discretization(between=2), substeps=3)
    short = jaxscp.Trajectory(
        FRACTIONS, trajectory.states[:, :1], trajectory.controls, jnp.asarray(TIME)
    )
    with pytest.raises(ValueError, match=r"trajectory\.states has shape \(5, 1\)"):
        jaxscp.linearize(PROBLEM, short)


# JAX's own are strongly typed, or weakly as Python's are.
@pytest.mark.parametrize("number", [np.float64, jnp.float64, jnp.asarray])
def test_new_numbers_compile_nothing(trajectory, number):
    jaxscp.linearize(PROBLEM, trajectory, substeps=2)
    longer = eqx.tree_at(lambda t: t.final_time, trajectory, number(2.0 * TIME))
    with compilations() as compiled:
        values, _ = jaxscp.linearize(PROBLEM, longer, substeps=3)
    assert not compiled
    assert values.next_state.shape == (4, 2)
