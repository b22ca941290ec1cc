"""The quadratic model of the discrete problem, and what it makes of violations."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, strategies as st
from jax.flatten_util import ravel_pytree
from numpy.testing import assert_allclose
from past_a_disc import (
    FRACTIONS,
    INF,
    NODES,
    SUBSTEPS,
    all_equal,
    drawn,
    flown,
    multipliers_of,
    prepare,
    problem_of,
    quick_jit,
    transcribed,
)
from random_models import random_scaling

from jaxscp._constraints import largest_buffer, violations, worst_violation
from jaxscp._curvature import Curvature
from jaxscp._merit import ExactPenalty
from jaxscp._model import Model
from jaxscp._per_constraint import PerConstraint
from jaxscp._transcription import Residuals


@quick_jit
def model_of(transcription, scaling, there) -> Model:
    """Without any curvature."""
    residuals, derivatives = transcription.linearize(there, jnp.asarray(SUBSTEPS))
    blocks = jnp.zeros((NODES, 7, 7))
    flat = Curvature.of_nodes(blocks, 4, two_sided=False, borrows=False)
    return Model(scaling.residuals(residuals), scaling.derivatives(derivatives), flat)


@quick_jit
def both(transcription, scaling, model, there, shifts):
    """What the problem and what the model have after each step."""
    _, unravel = ravel_pytree(there)

    def after(shift):
        step = unravel(shift)
        moved = scaling.move(there, step)
        truth = transcription.evaluate(moved, jnp.asarray(SUBSTEPS))
        return scaling.residuals(truth), model.predict(step)

    return jax.vmap(after)(shifts)


# Between them they have every block of the Jacobians.
@pytest.mark.parametrize("name", ["trapezoid", "first-order-between"])
def test_the_model_is_the_problem_to_first_order(name):
    transcription = transcribed(problem_of(), name)
    there, scaling = flown(transcription), random_scaling(transcription)
    model = model_of(transcription, scaling, there)
    size = ravel_pytree(there)[0].size
    far = 1e-5 * np.eye(size)
    shifts = jnp.asarray(np.concatenate([0.0 * far[:1], far, -far]))
    around = both(transcription, scaling, model, there, shifts)
    around = jax.tree.map(np.asarray, around)
    all_equal(*(jax.tree.map(lambda leaf: leaf[0], each) for each in around), rtol=1e-12)
    truth, told = (
        jax.tree.map(lambda leaf: (leaf[1 : 1 + size] - leaf[1 + size :]) / 2e-5, each)
        for each in around
    )
    all_equal(truth, told, rtol=1e-6, atol=1e-8)


def test_the_hessian_is_the_curvature_made_convex():
    transcription = transcribed(problem_of())
    there, (arena, disc) = flown(transcription), (30.0, 2.0)
    multipliers = multipliers_of(transcription, arena, disc, drift=5.0, signal=0.0)
    scaling, model, _ = prepare(transcription, there, multipliers)
    # Second derivatives by hand: 0.1 r^2 and -r^2 of the positions, u^2 times seconds.
    per_metre = arena * 0.2 / scaling.path[0] - disc * 2.0 / scaling.path[1]
    seconds = 4.0 * np.append(np.diff(FRACTIONS), 0.0)
    for k in range(NODES):
        expected = np.zeros(7)
        expected[:2] = per_metre * scaling.state[:2] ** 2
        expected[4:6] = 2.0 * seconds[k] * scaling.control[:2] ** 2 / scaling.objective
        assert_allclose(model.curvature.blocks[k], np.diag(expected), atol=1e-9)
    assert per_metre > 0.0
    # The disc alone curves the wrong way, and counts no more than nothing.
    multipliers = multipliers_of(transcription, 0.0, disc, drift=5.0, signal=0.0)
    _, model, _ = prepare(transcription, there, multipliers)
    assert_allclose(model.curvature.blocks[:, :4, :4], 0.0, atol=1e-12)


@given(st.integers(0, 2**32 - 1))
def test_the_hessian_is_convex(seed):
    transcription = transcribed(problem_of())
    draw = np.random.default_rng(seed).normal
    multipliers = drawn(lambda size: 10.0 * draw(size=size), transcription.no_multipliers)
    hessian = np.asarray(
        prepare(transcription, flown(transcription), multipliers)[1].curvature.blocks
    )
    assert_allclose(hessian, np.swapaxes(hessian, 1, 2), atol=1e-12)
    assert np.linalg.eigvalsh(hessian).min() > -1e-12 * np.abs(hessian).max()


def test_limits_of_a_step():
    transcription = transcribed(problem_of())
    there, multipliers = flown(transcription), multipliers_of(transcription)
    parts = prepare(transcription, there, multipliers)
    scaling, limits = jax.tree.map(np.asarray, (parts.scaling, parts.limits))
    for side, state, wall, control, time, integral in (
        (
            0,
            [4.0, 0.2, -INF, -2.0],
            [-9, -9, -INF, -2],
            [-0.33, -0.8, 0.2],
            2,
            [2.8, 1.2],
        ),
        (1, [4.0, 0.45, INF, 2.0], [9, 9, INF, 2], [0.33, 0.8, 0.2], 8, [2.8, INF]),
    ):
        states = scaling.state * limits.state[side] + there.states
        assert_allclose(states[-1], state, atol=1e-12)
        assert_allclose(states[0], [0, 0, 0, 2 * side - 1], atol=1e-12)
        assert_allclose(states[1:-1], [wall] * 4, atol=1e-12)
        controls = scaling.control * limits.control[side] + there.controls
        assert_allclose(controls, [control] * 5, atol=1e-12)
        assert_allclose(4.0 + scaling.time * limits.time[side], [time])
        assert_allclose(scaling.integral * limits.integral[side], integral)


def test_the_exact_penalty_by_hand():
    residuals = Residuals(
        objective=jnp.array(7.0),
        defects=jnp.array([[0.5], [-0.25]]),
        path=jnp.array([[-3.0], [0.75], [-0.1]]),
        # One of them of a limit that there is not.
        between=jnp.array([[0.5, -INF], [-2.0, 0.25]]),
        # Totals 3, 0.5 and 2; the last column is the cost's.
        increments=jnp.array([[1.0, 0.25, 4.0, 9.0], [2.0, 0.25, -2.0, 9.0]]),
    )
    limits = jnp.array([0.0, 1.5, -1.0]), jnp.array([2.75, INF, 3.0])
    broken = violations(residuals, limits)
    assert_allclose(broken.dynamics, [[0.5], [0.25]])
    assert_allclose(broken.path, [[0.0], [0.75], [0.0]])
    assert_allclose(broken.between, [[0.5, 0.0], [0.0, 0.25]])
    assert_allclose(broken.integral, [0.25, 1.0, 0.0])
    assert largest_buffer(broken) == 1.0
    assert worst_violation(residuals, limits) == 1.0
    weights = PerConstraint(
        dynamics=jnp.array([[10.0], [20.0]]),
        path=jnp.full((3, 1), 4.0),
        between=jnp.array([[2.0, 9.0], [9.0, 8.0]]),
        integral=jnp.array([1.0, 2.0, 3.0]),
    )
    # 7 + (5 + 5) + 3 + (1 + 2) + (0.25 + 2)
    assert_allclose(ExactPenalty(weights).cost(residuals, limits), 25.25)
    worst = dataclasses.replace(residuals, defects=jnp.array([[0.5], [-4.0]]))
    assert worst_violation(worst, limits) == 4.0
    peak = dataclasses.replace(broken, between=jnp.array([[0.5, 0.0], [1.5, 0.0]]))
    assert largest_buffer(peak) == 1.5
    # The virtual control is no buffer.
    assert largest_buffer(violations(worst, limits)) == 1.0
