"""Solutions of convex subproblems against dense references assembled another way."""

import dataclasses
import itertools

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
    predict,
    prepare,
    prices_of,
    problem_of,
    solve,
    solver_and_numbers,
    structure_of,
    to_the_host,
    transcribed,
)
from random_models import random_limits, random_model
from scipy.linalg import block_diag

from jaxscp._constraints import violations, worst_violation
from jaxscp._damping import Damping
from jaxscp._merit import ExactPenalty
from jaxscp._qp import PIQP
from jaxscp._subproblem import SubproblemSolution, solve_subproblem
from jaxscp._subproblem_data import Prices
from jaxscp._transcription import Variables

# Multipliers magnify what the default tolerance leaves.
PRECISE = PIQP(finest=1e-10)


def solved(
    parts: Parts, prices: Prices, name="zero-order", proximal=2.0, **options
) -> SubproblemSolution:
    damping = damping_of(parts.model, proximal)
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
    idle = values < buffers @ needed - 1e-5
    assert_allclose(multipliers[idle], 0.0, atol=10.0 * atol)


@pytest.mark.parametrize("name", ["zero-order", "first-order", "trapezoid"])
def test_the_best_step(name):
    parts, prices, damping = parts_of(name), prices_of(), damping_of(parts_of(name).model)
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


def drawn_subproblem(name: str, seed: int, limit=1e4):
    """With curvature and damping of every kind, and path constraints at their price."""
    parts = Parts(None, random_model(name, seed), random_limits(structure_of(name), seed))
    dear = prices_of(name, virtual=1e4, limit=limit, integral=1e4)
    path = np.random.default_rng(seed).uniform(1.0, 30.0, dear.path.shape)
    prices = dataclasses.replace(dear, path=jnp.asarray(path))
    return parts, prices, held_damping_of(parts.model, seed)


def solve_drawn(name: str, parts, prices, damping, **options) -> SubproblemSolution:
    structure = structure_of(name, **options)
    return solve(structure, PRECISE, parts.model, damping, prices, parts.limits)


@pytest.mark.parametrize(
    ("name", "seed"),
    [
        ("zero-order-between", 2),
        ("zero-order-between", 10),
        ("first-order-between", 0),
        ("first-order-between", 6),
        ("first-order-trapezoid", 0),
        ("first-order-trapezoid", 1),
    ],
)
def test_the_best_step_of_any_convex_model(name, seed):
    parts, prices, damping = drawn_subproblem(name, seed)
    solution = solve_drawn(name, parts, prices, damping)
    assert bool(solution.effort.solved)
    assert int(solution.effort.solves) == 1
    assert_allclose(flat(solution.step), optimum(parts, prices, damping), atol=1e-6)
    check_optimality(parts, prices, damping, solution)
    if "between" in name:
        # Peaks of limits and of path constraints, some with a buffer and some without.
        limits, path = peaks_of(solution.multipliers)
        assert np.max(limits) > 1.0
        assert np.max(path) > 1.0
        pushes = solution.multipliers.path[:-1] + np.sum(path, axis=1)
        at_price = pushes > prices.path[:-1] - 1e-3
        assert 0 < np.sum(at_price) < at_price.size
        assert np.max(peaks_of(predict(parts.model, solution.step))[0]) < 1e-6


def test_a_node_shares_its_buffers_with_the_interval_behind():
    name = "first-order-between"
    parts, prices, damping = drawn_subproblem(name, 0)
    multipliers = solve_drawn(name, parts, prices, damping).multipliers
    at_nodes, (_, peaks) = multipliers.path[:-1], peaks_of(multipliers)
    both = (at_nodes > 1e-3) & (peaks[:, 0] > 1e-3)
    assert np.any(both)
    assert_allclose((at_nodes + peaks[:, 0])[both], prices.path[:-1][both])


def test_limits_between_nodes_have_buffers_where_dynamics_have():
    # Limits that cannot be met, and some that cost more to meet than not.
    for seed, limit, options in ((3, 1e3, {}), (4, 20.0, {"relaxed": True})):
        name = "zero-order-between"
        parts, prices, damping = drawn_subproblem(name, seed, limit)
        solution = solve_drawn(name, parts, prices, damping, **options)
        assert bool(solution.effort.relaxed)
        assert_allclose(flat(solution.step), optimum(parts, prices, damping), atol=1e-5)
        check_optimality(parts, prices, damping, solution, atol=1e-5)
        pushes = np.sum(peaks_of(solution.multipliers)[0], axis=1)
        assert_allclose(np.max(pushes), limit)
        assert np.max(peaks_of(predict(parts.model, solution.step))[0]) > 1e-3


@pytest.mark.parametrize(("drifted", "price"), [(2.8, 3.0), (-20.0, 3.0)])
def test_cheap_buffers_are_used(drifted, price):
    parts, prices = parts_of(drifted=drifted), prices_of(path=20.0, integral=price)
    solution, damping = solved(parts, prices), damping_of(parts.model)
    assert int(solution.effort.solves) == 1
    assert_allclose(flat(solution.step), optimum(parts, prices, damping), atol=1e-6)
    check_optimality(parts, prices, damping, solution)
    after, limits = predict(parts.model, solution.step), parts.limits.integral
    broken = violations(after, limits)
    assert np.max(broken.dynamics) < 1e-7
    assert np.max(broken.path) > 1e-4
    # Too much of the drift, or too little of the signal.
    drift, signal = np.asarray(after.totals - limits[0])
    if drifted < 0.0:
        assert drift > 1e-3
    else:
        assert signal < -1e-4


def test_dynamics_that_cannot_be_met_are_relaxed():
    # Too little time for so weak a drive.
    parts, prices = parts_of(longest=4.1), prices_of()
    solution, damping = solved(parts, prices), damping_of(parts.model)
    assert bool(solution.effort.solved)
    assert not bool(solution.effort.infeasible)
    assert bool(solution.effort.relaxed)
    assert int(solution.effort.solves) == 2
    assert_allclose(flat(solution.step), optimum(parts, prices, damping), atol=1e-5)
    check_optimality(parts, prices, damping, solution, atol=1e-5)
    # What remains of the defects is the virtual control.
    relaxed = structure_of(relaxed=True)
    data = to_the_host(parts.model, damping, prices, parts.limits)
    solver, numbers = solver_and_numbers(relaxed, PRECISE, data)
    answer, effort = solver(numbers)
    less, more = answer.z[solver.layout.virtual]
    remaining = predict(parts.model, solution.step).defects
    assert np.max(np.abs(remaining)) > 1e-3
    assert_allclose(more - less, remaining, atol=1e-6)
    assert effort[0] == 1.0


def test_dynamics_that_cannot_be_met_may_have_to_be():
    solution = solved(parts_of(longest=4.1), prices_of(relax=0.0))
    assert not bool(solution.effort.solved)
    assert bool(solution.effort.infeasible)
    assert not bool(solution.effort.relaxed)
    assert int(solution.effort.solves) == 1


@pytest.mark.parametrize("radius", [0.3, 1.0])
def test_the_ball(radius):
    parts, prices = parts_of(), prices_of(virtual=20.0, radius=radius)
    solution = solved(parts, prices, relaxed=True, ball=True)
    assert bool(solution.effort.solved)
    assert int(solution.effort.solves) == 1
    step = solution.step
    norms = np.max(np.abs(step.states), axis=1) + np.abs(step.final_time)
    norms[:-1] += np.max(np.abs(step.controls), axis=1)
    assert np.all(norms <= radius + 1e-6), norms
    assert np.max(norms) == pytest.approx(radius, abs=1e-6)
    expected = optimum(parts, prices, damping_of(parts.model), radius)
    assert_allclose(flat(step), expected, atol=1e-6)


def test_a_wide_ball_and_dear_virtual_control_change_nothing():
    parts, prices = parts_of(), prices_of(radius=1e3)
    plain = solved(parts, prices)
    for options in ({"relaxed": True}, {"ball": True}, {"relaxed": True, "ball": True}):
        other = solved(parts, prices, **options)
        assert_allclose(flat(other.step), flat(plain.step), atol=1e-6)
        check_optimality(parts, prices, damping_of(parts.model), other, atol=1e-5)


def test_broken_numbers_are_not_solved():
    solution = solved(parts_of(), prices_of(), proximal=np.nan)
    assert not bool(solution.effort.solved)
    assert not bool(solution.effort.infeasible)
    assert np.all(np.isnan(flat(solution.step)))


def test_a_subproblem_not_solved_yet_has_the_shapes_of_one_solved():
    name = "zero-order-between"
    solution = solve_drawn(name, *drawn_subproblem(name, 10))
    nothing = SubproblemSolution.none(structure_of(name))
    assert jax.tree.structure(nothing) == jax.tree.structure(solution)
    for none, some in zip(*map(jax.tree.leaves, (nothing, solution)), strict=True):
        assert (none.shape, none.dtype) == (some.shape, some.dtype)
    assert np.all(flat(nothing.step) == 0.0)


def test_eager_compiled_and_batched():
    parts, prices, structure = parts_of(), prices_of(), structure_of()

    def answer(proximal):
        damping = damping_of(parts.model, proximal)
        args = (structure, PRECISE, parts.model, damping, prices, parts.limits)
        return solve_subproblem(*args)

    weights = jnp.array([0.5, 2.0, 8.0])
    compiled, batch = jax.jit(answer), jax.jit(jax.vmap(answer))(weights)
    alone = compiled(weights[1])
    assert_allclose(flat(answer(weights[1]).step), flat(alone.step), atol=1e-12)
    for index, weight in enumerate(weights):
        alone = compiled(weight)
        for name in ("step", "multipliers", "state", "control", "final_time"):
            for one, all_of_them in zip(
                jax.tree.leaves(getattr(alone, name)),
                jax.tree.leaves(getattr(batch, name)),
                strict=True,
            ):
                assert_allclose(all_of_them[index], one, atol=1e-12)
    assert np.max(np.abs(batch.step.states[0] - batch.step.states[2])) > 1e-3


@given(seed=st.integers(0, 2**32 - 1))
def test_a_predicted_reduction_is_never_negative(seed):
    """Of the penalized cost, if no weight is less than its multiplier."""
    draw = np.random.default_rng(seed)
    transcription = transcribed(problem_of())
    there = flown(transcription)
    there = Variables(
        there.states.at[1:-1].add(0.3 * draw.normal(size=(4, 4))),
        there.controls + 0.1 * draw.uniform(size=(5, 3)) * np.array([0.0, 1.0, 0.0]),
        there.final_time + draw.uniform(-1.0, 3.0),
    )
    multipliers = multipliers_of(transcription, *draw.normal(size=4))
    parts = prepare(transcription, there, multipliers)
    proximal = 10 ** draw.uniform(-2, 3)
    virtual, path, integral = 10 ** draw.uniform(0.0, 4.0, size=3)
    prices = prices_of(virtual=virtual, path=path, integral=integral)
    solution = solved(parts, prices, proximal=proximal)
    assert bool(solution.effort.solved)
    weights = jax.tree.map(
        lambda leaf: np.abs(leaf) * (1.0 + draw.exponential()) + draw.exponential(),
        solution.multipliers,
    )
    limits, model = parts.limits.integral, parts.model
    merit = ExactPenalty(weights)
    before = merit.cost(model.residuals, limits)
    after = merit.cost(predict(model, solution.step), limits)
    assert after <= before + 1e-6 * (1.0 + abs(before))
