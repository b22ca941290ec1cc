"""Solutions of convex subproblems against dense references assembled another way."""

import dataclasses
import itertools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import piqp
import pytest
from hypothesis import given, strategies as st
from numpy.testing import assert_allclose
from past_a_disc import (
    INF,
    INTERVALS,
    LIMITS,
    NODES,
    PATH,
    Dense,
    Parts,
    damped,
    damping_of,
    dense,
    ends_of,
    flat,
    flown,
    held_damping_of,
    multipliers_of,
    of_limits,
    parts_of,
    prepare,
    prices_of,
    problem_of,
    structure_of,
    transcribed,
)
from scipy.linalg import block_diag

from jaxscp._assembly import subproblem_solver
from jaxscp._constraints import penalized_cost, violations, worst_violation
from jaxscp._damping import Damping
from jaxscp._model import Model
from jaxscp._qp import PIQP
from jaxscp._subproblem import SubproblemSolution, solve_subproblem
from jaxscp._subproblem_data import Outline, Prices, SubproblemData
from jaxscp._transcription import Variables

# Multipliers magnify what the default tolerance leaves.
PRECISE = PIQP(finest=1e-10)
solve = eqx.filter_jit(solve_subproblem)
predict = eqx.filter_jit(Model.predict)
# Of what there is to rest on between the nodes, with so much drift something is active.
BETWEEN = {
    "zero-order-between": {"ceiling": 1.0, "drifted": 3.6},
    "first-order-between": {"ceiling": 1.1, "drifted": 3.6},
}


def solved(
    parts: Parts, prices: Prices, name="zero-order", proximal=2.0, **options
) -> SubproblemSolution:
    damping = damping_of(parts, proximal)
    structure = structure_of(name, **options)
    return solve(structure, PRECISE, parts.model, damping, prices, parts.limits)


def box(parts: Parts):
    """Masks of the step's entries fixed, limited below and limited above."""
    lower, upper = ends_of(parts.limits)
    fixed = lower == upper
    return fixed, np.isfinite(lower) & ~fixed, np.isfinite(upper) & ~fixed


def sums_of_signed_entries(nodes_with_control: int):
    """Rows over a step: one signed entry of each kind at a node, and the time.

    A sum of infinity norms is within a radius if and only if all of these are.
    """
    entries = NODES * 4 + nodes_with_control * 3 + 1
    for k in range(NODES):
        kinds = [range(4 * k, 4 * k + 4)]
        if k < nodes_with_control:
            first = NODES * 4 + 3 * k
            kinds.append(range(first, first + 3))
        for chosen in itertools.product(*kinds):
            places = [*chosen, entries - 1]
            for signs in itertools.product([1.0, -1.0], repeat=len(places)):
                row = np.zeros(entries)
                row[places] = signs
                yield row


def leaning(peaks: int, limits: int) -> np.ndarray:
    """Which buffer each row leans on: path constraints at nodes, then peaks between.

    A row each, and a column for each buffer: those of path constraints, which a node
    shares with the interval behind it, then those of an interval's limits of the state.
    """
    parts = peaks // (INTERVALS * (LIMITS + PATH))
    entries, each = np.eye(LIMITS + PATH), np.ones((parts, 1))
    of_path = np.kron(np.eye(INTERVALS, NODES), np.kron(each, entries[:, LIMITS:]))
    of_limits = np.kron(np.eye(INTERVALS), np.kron(each, entries[:, :limits]))
    at_nodes = np.eye(NODES * PATH, NODES * PATH + INTERVALS * limits)
    return np.concatenate([at_nodes, np.concatenate([of_path, of_limits], axis=1)])


def optimum(
    parts: Parts, prices: Prices, damping: Damping, radius: float | None = None
) -> np.ndarray:
    """The best step of the exact penalty, by a dense QP over step and violations."""
    told, limits = damped(dense(parts.model), damping), parts.limits.integral
    (D, d), (G, g), (B, b), (T, t) = told[2:]
    drift, signal = t[0] - limits[0][0], limits[0][1] - t[1]
    # Each violation is no less than any of its rows, and than zero.
    rows = np.concatenate([D, -D, G, B, T[:1], -T[:1], -T[1:]])
    known = np.concatenate([d, -d, g, b, [drift, -drift, signal]])
    slack = block_diag(
        np.tile(np.eye(d.size), (2, 1)),
        leaning(b.size, prices.limit.shape[1]),
        np.ones((2, 1)),
        np.ones((1, 1)),
    )
    if radius is not None:
        ball = np.array(list(sums_of_signed_entries(INTERVALS)))
        rows, known = (
            np.concatenate([rows, ball]),
            np.append(known, 0 * ball[:, 0] - radius),
        )
        slack = np.concatenate([slack, np.zeros((len(ball), slack.shape[1]))])
    size, extra = told.g.size, slack.shape[1]
    fixed, low, high = box(parts)
    lower, upper = ends_of(parts.limits)
    solver = piqp.DenseSolver()
    solver.settings.eps_abs = solver.settings.eps_duality_gap_abs = 1e-10
    solver.setup(
        block_diag(told.H, np.zeros((extra, extra))),
        np.concatenate([told.g, *map(np.ravel, price_parts(prices))]),
        np.eye(size, size + extra)[fixed],
        lower[fixed],
        np.concatenate([rows, -slack], axis=1),
        None,
        -known,
        np.concatenate([np.where(low, lower, -INF), np.zeros(extra)]),
        np.concatenate([np.where(high, upper, INF), np.full(extra, INF)]),
    )
    assert solver.solve() == piqp.PIQP_SOLVED
    return solver.result.x[:size]


def price_parts(prices: Prices):
    return prices.virtual_control, prices.path, prices.limit, prices.integral


def check_optimality(
    parts: Parts,
    prices: Prices,
    damping: Damping,
    solution: SubproblemSolution,
    atol=1e-6,
):
    """The conditions of Karush, Kuhn and Tucker for the exact penalty."""
    told, s = damped(dense(parts.model), damping), flat(solution.step)
    (D, d), (G, g), (B, b), (T, t) = told[2:]
    multipliers, limits = solution.multipliers, parts.limits.integral
    y, w, v = map(np.ravel, (multipliers.dynamics, multipliers.path, multipliers.between))
    mu, bound = np.asarray(multipliers.integral), of_limits(solution)
    slope = told.H @ s + told.g + D.T @ y + G.T @ w + B.T @ v + T.T @ mu + bound
    assert_allclose(slope, 0.0, atol=atol)
    check_limits(parts, s, bound, atol)
    # A multiplier is a subgradient of its priced violation.
    virtual, path, limit, integral = map(np.ravel, price_parts(prices))
    drift = T[0] @ s + t[0] - limits[0][0]
    signal = limits[0][1] - T[1] @ s - t[1]
    for value, multiplier, price, least in (
        (D @ s + d, y, virtual, -virtual),
        (drift[None], mu[:1], integral[:1], -integral[:1]),
        (signal[None], -mu[1:], integral[1:], 0 * integral[1:]),
    ):
        assert np.all(multiplier >= least - atol)
        assert np.all(multiplier <= price + atol)
        above, below = value > 1e-5, value < -1e-5
        assert_allclose(multiplier[above], price[above], atol=atol)
        assert_allclose(multiplier[below], least[below], atol=atol)
    values, pushes = np.append(G @ s + g, B @ s + b), np.append(w, v)
    check_buffers(values, pushes, np.append(path, limit), atol)


def check_limits(parts: Parts, s: np.ndarray, bound: np.ndarray, atol):
    lower, upper = ends_of(parts.limits)
    fixed, low, high = box(parts)
    assert_allclose(s[fixed], lower[fixed], atol=atol)
    assert np.all(s[low] >= lower[low] - atol)
    assert np.all(s[high] <= upper[high] + atol)
    pushes_down, pushes_up = ~fixed & (bound > 1e-4), ~fixed & (bound < -1e-4)
    assert_allclose(s[pushes_down], upper[pushes_down], atol=atol)
    assert_allclose(s[pushes_up], lower[pushes_up], atol=atol)


def check_buffers(values: np.ndarray, multipliers: np.ndarray, prices: np.ndarray, atol):
    """Rows that share a buffer share its price, if they are what it is needed for."""
    limits = (prices.size - NODES * PATH) // INTERVALS
    buffers = leaning(values.size - NODES * PATH, limits)
    total = buffers.T @ multipliers
    assert np.all(multipliers >= -atol)
    assert np.all(total <= prices + atol)
    needed = np.max(buffers * np.maximum(values, 0.0)[:, None], axis=0)
    assert_allclose(total[needed > 1e-5], prices[needed > 1e-5], atol=atol)
    assert_allclose(multipliers[values < buffers @ needed - 1e-5], 0.0, atol=atol)


@pytest.mark.parametrize("name", ["zero-order", "first-order", "trapezoid"])
def test_the_best_step(name):
    parts, prices, damping = parts_of(name), prices_of(), damping_of(parts_of(name))
    solution = solved(parts, prices, name)
    assert bool(solution.effort.solved)
    assert not bool(solution.effort.infeasible)
    assert not bool(solution.effort.relaxed)
    assert int(solution.effort.solves) == 1
    assert_allclose(flat(solution.step), optimum(parts, prices, damping), atol=1e-6)
    check_optimality(parts, prices, damping, solution)
    after = predict(parts.model, solution.step)
    assert worst_violation(after, parts.limits.integral) < 1e-6
    # The example is worth its name: something of every kind is active, and some is not.
    multipliers = solution.multipliers
    path = np.asarray(multipliers.path)
    assert np.max(path[:, 1]) > 1.0
    assert np.max(path[:, 0]) < 1e-6
    assert float(multipliers.integral[1]) < -1.0
    assert np.max(np.abs(solution.control[:, :2])) > 1e-3
    assert np.max(np.abs(solution.control[:, 2])) > 1e-2  # of the fixed wind
    assert np.max(np.abs(solution.state[1:-1])) < 1e-6
    assert abs(float(solution.final_time)) < 1e-6


def peaks_of(multipliers) -> tuple[np.ndarray, np.ndarray]:
    """Multipliers between the nodes, of the state's limits and of path constraints."""
    by_part = np.reshape(multipliers.between, (INTERVALS, -1, LIMITS + PATH))
    return by_part[:, :, :LIMITS], by_part[:, :, LIMITS:]


@pytest.mark.parametrize("name", BETWEEN)
def test_the_best_step_between_the_nodes(name):
    parts, prices = parts_of(name, **BETWEEN[name]), prices_of(name)
    damping = damping_of(parts)
    solution = solved(parts, prices, name)
    assert bool(solution.effort.solved)
    assert int(solution.effort.solves) == 1
    assert_allclose(flat(solution.step), optimum(parts, prices, damping), atol=1e-6)
    check_optimality(parts, prices, damping, solution, atol=1e-5)
    after = predict(parts.model, solution.step)
    assert worst_violation(after, parts.limits.integral) < 1e-6
    # It flies past the disc between two nodes, and below the ceiling at one or between.
    limits, path = peaks_of(solution.multipliers)
    assert np.max(path[:, :, 1]) > 1.0
    assert np.max(path[:, :, 0]) < 1e-6
    assert np.max(solution.multipliers.path) < 1e-6
    assert np.max(solution.state[1:-1, 1]) > 1.0
    rises = np.max(limits, axis=(0, 1))
    assert (rises[4] > 1.0) == (name == "zero-order-between")
    assert np.max(np.delete(rises, 4)) < 1e-6


def test_what_is_between_nodes_shares_the_buffer_before():
    name = "zero-order-between"
    parts, prices = parts_of(name), prices_of(name, path=20.0)
    damping = damping_of(parts)
    solution = solved(parts, prices, name)
    assert int(solution.effort.solves) == 1
    assert_allclose(flat(solution.step), optimum(parts, prices, damping), atol=1e-6)
    check_optimality(parts, prices, damping, solution)
    # One price for a node and both parts of the interval behind it.
    disc = np.append(solution.multipliers.path[:-1, 1:], peaks_of(solution.multipliers)[1][:, :, 1], axis=1)
    print(disc)
