"""The recursion along the dynamics against the whole system of equations."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, strategies as st
from numpy.testing import assert_allclose
from past_a_disc import INTERVALS, NODES, Dense, dense, flat, quick_jit, still
from random_models import M, N, Q, random_model
from scipy.linalg import null_space

from jaxscp._model import Model, cost_gradient
from jaxscp._riccati import Factors, Forced, factorize, solve
from jaxscp._stages import Chain
from jaxscp._transcription import Variables

# With held controls, with those at both ends, and with integrals by nodal values.
every_chain = pytest.mark.parametrize(
    "name", ["zero-order", "first-order", "trapezoid", "first-order-trapezoid"]
)
seeds = st.integers(0, 2**32 - 1)


class Task(NamedTuple):
    """A model whose cost sees the totals of the integrals, some variables forced.

    - `second`, `first`: derivatives of the cost by the totals.
    - `told`, `target`: masks of the variables that are forced, and what they are.
    """

    model: Model
    second: jax.Array
    first: jax.Array
    told: Variables
    target: Variables


def task_of(name: str, seed: int, share: float, convexity=12.0) -> Task:
    """**Arguments:** `share`: of variables that are forced where they may be."""
    model, draw = random_model(name, seed, convexity), np.random.default_rng(seed)
    shapes = still(model)
    target = jax.tree.map(lambda leaf: jnp.asarray(draw.normal(size=leaf.shape)), shapes)
    told = jax.tree.map(
        lambda leaf: jnp.asarray(1.0 * (draw.random(leaf.shape) < share)), shapes
    )
    # Of the states only those at the first node.
    told = Variables(told.states.at[1:].set(0.0), told.controls, told.final_time)
    second, first = 10 ** draw.uniform(-1.0, 3.0, Q), draw.normal(size=Q)
    return Task(model, jnp.asarray(second), jnp.asarray(first), told, target)


def forced(task: Task) -> Forced:
    """The first node has the first control if the right end of an interval has one."""
    own = int(task.told.controls.shape[0] == NODES)

    def begin(values: Variables, totals):
        controls = values.controls[:own].ravel()
        parts = (values.states[0], controls, totals, values.final_time[None])
        return jnp.concatenate(parts)

    return Forced(
        (begin(task.told, jnp.ones(Q)), begin(task.target, jnp.zeros(Q))),
        (task.told.controls[own:], task.target.controls[own:]),
    )


@quick_jit
def answer(task: Task) -> tuple[Factors, tuple[jax.Array, jax.Array, jax.Array]]:
    """Factors of the matrices alone, and what they make of the right-hand sides."""
    model, told = task.model, forced(task)
    free = task.told.controls.shape[0]
    chain = Chain(model.derivatives, model.curvature, free)
    matrices = chain.matrices(task.second)
    gradient = cost_gradient(model.derivatives)
    vectors = chain.vectors(model.residuals, gradient, task.first)
    factors = factorize(matrices, told)
    return factors, solve(matrices, vectors, told, factors)


def written_out(task: Task) -> tuple[Dense, np.ndarray]:
    """The whole cost in dense matrices, and the rows of the forced entries."""
    told = dense(task.model)
    T, t = told.totals
    second, first = np.asarray(task.second), np.asarray(task.first)
    H = told.H + T.T @ (second[:, None] * T)
    g = told.g + T.T @ (second * t + first)
    return told._replace(H=H, g=g), np.eye(g.size)[flat(task.told) > 0.0]


def optimum(task: Task) -> tuple[np.ndarray, np.ndarray]:
    """The step and the multipliers of its dynamics, from all conditions at once."""
    told, E = written_out(task)
    (D, d), e = told.defects, E @ flat(task.target)
    rows = np.concatenate([D, E])
    system = np.block([[told.H, rows.T], [rows, np.zeros((len(rows), len(rows)))]])
    found = np.linalg.solve(system, np.concatenate([-told.g, -d, e]))
    return found[: told.g.size], found[told.g.size :][: d.size]


def close(found, expected, precision=1e-8):
    size = np.max(np.abs(expected), initial=1.0)
    assert_allclose(found, expected, rtol=0.0, atol=precision * size)


@every_chain
@given(seed=seeds, share=st.sampled_from([0.0, 0.5, 1.0]))
def test_the_recursion_solves_the_whole_system(name, seed, share):
    task = task_of(name, seed, share)
    _, (y, decisions, costates) = answer(task)
    s, multipliers = optimum(task)
    controls = decisions
    if len(controls) < len(task.told.controls):
        controls = jnp.concatenate([y[:1, N : N + M], decisions])
    close(flat(Variables(y[:, :N], controls, y[0, -1])), s)
    assert_allclose(y[:, -1], y[0, -1], rtol=1e-12)
    T, t = dense(task.model).totals
    sums = slice(-1 - Q, -1)
    close(y[-1, sums], T @ s + t)
    # The price of a total is the same all along the way.
    prices = np.asarray(task.second * (T @ s + t) + task.first)
    close(costates[:, sums], np.tile(prices, (INTERVALS, 1)))
    # A defect moves the node behind it, and what an interval owes to its right end.
    moved = np.array(costates[:, :N])
    growth, tail = task.model.derivatives.intervals.increments, task.model.curvature.tail
    if growth.right_state is not None:
        moved += np.einsum("kqn,q->kn", growth.right_state[:, :Q], prices)
    if tail is not None:
        moved[-1] += tail.T @ controls[-1]
    close(-moved, multipliers.reshape(moved.shape))


@every_chain
@given(seed=seeds, convexity=st.floats(-4.0, 12.0))
def test_only_convexity_along_the_dynamics_counts(name, seed, convexity):
    task = task_of(name, seed, 0.3, convexity)
    factors, _ = answer(task)
    told, E = written_out(task)
    along = null_space(np.concatenate([told.defects[0], E]))
    least = np.linalg.eigvalsh(along.T @ told.H @ along)[0]
    assert (factors.convexity > 0.0) == (least > 0.0)


@every_chain
def test_what_is_forced_needs_no_convexity(name):
    task = task_of(name, 0, 1.0, convexity=-50.0)
    factors, (y, _, _) = answer(task)
    assert factors.convexity > 0.0
    close(np.ravel(y[:, :N]), optimum(task)[0][: NODES * N])


def test_the_flight_time_must_be_convex_where_it_is_free():
    """It never changes: its curvature shows at the first node only."""
    task = task_of("zero-order", 0, 0.0)
    bent = eqx.tree_at(lambda task: task.model.curvature.corner, task, jnp.array(-1e6))
    factors, _ = answer(bent)
    assert factors.convexity < 0.0
    told = eqx.tree_at(lambda task: task.told.final_time, bent, jnp.ones(()))
    factors, _ = answer(told)
    assert factors.convexity > 0.0
