"""Convex models and subproblems against dense references assembled another way."""

import dataclasses
import functools
import itertools
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import piqp
import pytest
from hypothesis import given, strategies as st
from jax.flatten_util import ravel_pytree
from numpy.testing import assert_allclose
from scipy.linalg import block_diag

from jaxscp import Bounds, FirstOrderHold, OptimalControlProblem, ZeroOrderHold
from jaxscp._assembly import subproblem_solver
from jaxscp._discretization import Discretization, Quadrature
from jaxscp._layout import Layout, Structure
from jaxscp._model import (
    Model,
    PerConstraint,
    convex_model,
    largest_buffer,
    penalized_cost,
    violations,
    worst_violation,
)
from jaxscp._problem import Integral
from jaxscp._qp import PIQP
from jaxscp._scaling import Scaling, automatic_scaling
from jaxscp._subproblem import SubproblemSolution, solve_subproblem, step_limits
from jaxscp._subproblem_data import Limits, Outline, Prices, SubproblemData
from jaxscp._transcription import Residuals, Transcription, Variables

INF = np.inf
NODES, INTERVALS = 6, 5
FRACTIONS = np.array([0.0, 0.15, 0.35, 0.5, 0.8, 1.0])
DISCRETIZATIONS = {
    "zero-order": Discretization(ZeroOrderHold()),
    "first-order": Discretization(FirstOrderHold()),
    "trapezoid": Discretization(ZeroOrderHold(), Quadrature.TRAPEZOID),
    "first-order-trapezoid": Discretization(FirstOrderHold(), Quadrature.TRAPEZOID),
}
every_discretization = pytest.mark.parametrize("name", DISCRETIZATIONS)
# Between them they have every block of the Jacobians.
every_block = pytest.mark.parametrize("name", ["zero-order", "first-order", "trapezoid"])


class Scaled(eqx.Module):
    """A function of the states in other units, times a factor an entry."""

    function: object = eqx.field(static=True)
    units: jax.Array
    factor: jax.Array

    def __call__(self, t, x, u):
        return self.factor * self.function(t, x / self.units, u)


def pushed(t, x, u):
    """A point in a plane, in a wind that is a control nobody may choose."""
    return jnp.stack([x[2], x[3], u[0], u[1] + u[2]])


def acceleration_squared(t, x, u):
    return u[0] ** 2 + u[1] ** 2


def around_the_disc(t, x, u):
    return 0.33 - (x[0] - 2.0) ** 2 - (x[1] - 0.2) ** 2


def in_the_arena(t, x, u):
    return 0.1 * (x[0] ** 2 + x[1] ** 2) - 4.0 + 0.01 * t * u[0]


def signal(t, x, u):
    return 1.0 / (1.0 + (x[0] - 1.0) ** 2 + (x[1] - 2.0) ** 2)


def drift(t, x, u):
    return x[1]


class TwiceTheTime(eqx.Module):
    factor: jax.Array

    def __call__(self, t, x):
        return self.factor * 2.0 * t


def problem_of(
    longest=8.0, drifted=2.8, unit=(1.0,) * 4, cost=1.0, wide=1.0
) -> OptimalControlProblem:
    """From rest past a disc, with as much signal and drift as asked for.

    - `longest`: flight time allowed [s]. `drifted`: drift asked for [m s].
    - `unit`: what a state's numbers are times.
    - `cost`: what the cost is times. `wide`: what the limits are times.
    """
    unit = jnp.asarray(unit)

    def bounds(lower, upper):
        return Bounds(unit * jnp.array(lower), unit * jnp.array(upper))

    def function(of_state, factor=1.0):
        return Scaled(of_state, unit, jnp.asarray(factor))

    limit, wind = wide * jnp.array([0.33, 0.8, 0.0]), jnp.array([0.0, 0.0, 0.2])
    return OptimalControlProblem(
        function(pushed, unit),
        state=bounds([-9.0, -9.0, -INF, -2.0], [9.0, 9.0, INF, 2.0]),
        control=Bounds(wind - limit, wind + limit, fixed=(False, False, True)),
        initial_state=bounds([0.0, 0.0, 0.0, -1.0], [0.0, 0.0, 0.0, 1.0]),
        final_state=bounds([4.0, 0.2, -INF, -INF], [4.0, 0.45, INF, INF]),
        final_time=Bounds(2.0, longest),
        running_cost=function(acceleration_squared, jnp.asarray(cost)),
        terminal_cost=TwiceTheTime(jnp.asarray(cost)),
        path_constraints={
            "arena": function(in_the_arena),
            "disc": function(around_the_disc),
        },
        integrals={
            "drift": Integral(function(drift), Bounds.exactly(drifted)),
            "signal": Integral(function(signal), Bounds.at_least(1.2)),
        },
    )


def transcribed(problem, name="zero-order") -> Transcription:
    return Transcription(problem, DISCRETIZATIONS[name], jnp.asarray(FRACTIONS))


def flown(transcription, unit=(1.0,) * 4) -> Variables:
    """A curved line within the limits, so that no derivative vanishes by chance."""
    s = FRACTIONS
    states = np.stack([4 * s, 0.4 * s + 0.3 * np.sin(3 * s), 1 + s, 0.5 - s], axis=1)
    states[0, :3], states[-1, 1] = 0.0, 0.4
    controls = np.stack([0.3 - 0.2 * s, 0.2 * np.cos(s), 0.2 + 0 * s], axis=1)
    return Variables(
        jnp.asarray(states * unit),
        jnp.asarray(controls[: transcription.control_nodes]),
        jnp.asarray(4.0),
    )


class Parts(NamedTuple):
    scaling: Scaling
    model: Model
    limits: Limits


@eqx.filter_jit
def prepare(transcription, variables, multipliers) -> Parts:
    """The convex model around a point."""
    residuals, derivatives = transcription.linearize(variables, jnp.asarray(4))
    scaling = automatic_scaling(transcription, variables)
    model = convex_model(
        transcription,
        scaling,
        variables,
        scaling.residuals(residuals),
        scaling.derivatives(derivatives),
        multipliers,
    )
    return Parts(scaling, model, step_limits(transcription, scaling, variables))


def multipliers_of(arena=0.3, disc=0.3, drift=-0.2, signal=-0.2) -> PerConstraint:
    return PerConstraint(
        jnp.zeros((INTERVALS, 4)),
        jnp.asarray(np.tile([arena, disc], (NODES, 1))),
        jnp.asarray([drift, signal]),
    )


@functools.cache
def parts_of(name="zero-order", **changes) -> Parts:
    transcription = transcribed(problem_of(**changes), name)
    return prepare(transcription, flown(transcription), multipliers_of())


@functools.cache
def structure_of(name="zero-order", **options) -> Structure:
    return Structure.of(transcribed(problem_of(), name), **options)


def solver_and_numbers(structure, settings, parts, prices):
    """The host's solver, and the vector it is given."""
    data = SubproblemData.of(parts.model, prices, parts.limits)
    leaves = [np.ravel(leaf) for leaf in jax.tree.leaves(data)]
    solver = subproblem_solver(structure, settings, Outline.of(data))
    return solver, np.concatenate(leaves)


def prices_of(proximal=2.0, virtual=1e3, path=1e3, integral=1e3, radius=0.0) -> Prices:
    return Prices(
        proximal=jnp.asarray(proximal),
        virtual_control=jnp.asarray(np.full((INTERVALS, 4), virtual)),
        path=jnp.asarray(np.full((NODES, 2), path)),
        integral=jnp.asarray(np.full(2, integral)),
        radius=jnp.asarray(radius),
        precision=jnp.asarray(0.0),
    )


# Multipliers magnify what the default tolerance leaves.
PRECISE = PIQP(finest=1e-10)
solve = eqx.filter_jit(solve_subproblem)
predict = eqx.filter_jit(Model.predict)


class Dense(NamedTuple):
    """The model over the flattened step, states first and time last.

    Each constraint is a pair: rows and what they add to, as `predict` has it.
    """

    H: np.ndarray
    g: np.ndarray
    defects: tuple[np.ndarray, np.ndarray]
    path: tuple[np.ndarray, np.ndarray]
    totals: tuple[np.ndarray, np.ndarray]
    lower: np.ndarray
    upper: np.ndarray


@eqx.filter_jit
def _expanded(model, nothing):
    flat, unravel = ravel_pytree(nothing)

    def values(s):
        after = model.predict(unravel(s))
        return after.objective, after.defects.ravel(), after.path.ravel(), after.totals

    hessian = jax.hessian(lambda s: values(s)[0])(flat)
    return hessian, jax.jacfwd(values)(flat), values(flat)


def dense(parts: Parts) -> Dense:
    limits = parts.limits
    nothing = Variables(
        jnp.zeros(limits.state[0].shape),
        jnp.zeros(limits.control[0].shape),
        jnp.zeros(()),
    )
    hessian, slopes, values = jax.tree.map(np.asarray, _expanded(parts.model, nothing))
    lower, upper = (
        np.concatenate([np.ravel(kind[side]) for kind in limits_of_variables(limits)])
        for side in (0, 1)
    )
    constraints = zip(slopes[1:], values[1:], strict=True)
    return Dense(hessian, slopes[0], *constraints, lower, upper)


def limits_of_variables(limits: Limits):
    return limits.state, limits.control, limits.time


def flat(states, controls, time) -> np.ndarray:
    return np.concatenate([np.ravel(part) for part in (states, controls, time)])


def step_of(solution: SubproblemSolution) -> np.ndarray:
    step = solution.step
    return flat(step.states, step.controls, step.final_time)


def curved(told: Dense, proximal: float) -> np.ndarray:
    """Hessian of a subproblem: the squared step averages over nodes, time at each."""
    weights = np.full(told.g.size, proximal / NODES)
    weights[-1] = proximal
    return told.H + np.diag(weights)


def box(told: Dense):
    """Masks of the entries fixed, limited below and limited above."""
    fixed = told.lower == told.upper
    return fixed, np.isfinite(told.lower) & ~fixed, np.isfinite(told.upper) & ~fixed


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


def optimum(parts: Parts, prices: Prices, radius: float | None = None) -> np.ndarray:
    """The best step of the exact penalty, by a dense QP over step and violations."""
    told, limits = dense(parts), parts.limits.integral
    (D, d), (G, g), (T, t) = told.defects, told.path, told.totals
    drift, signal = t[0] - limits[0][0], limits[0][1] - t[1]
    # Each violation is no less than any of its rows, and than zero.
    rows = np.concatenate([D, -D, G, T[:1], -T[:1], -T[1:]])
    known = np.concatenate([d, -d, g, [drift, -drift, signal]])
    count = [d.size, g.size, 1, 1]
    defect, path, first, second = np.split(np.eye(sum(count)), np.cumsum(count)[:-1])
    slack = np.concatenate([defect, defect, path, first, first, second])
    if radius is not None:
        ball = np.array(list(sums_of_signed_entries(INTERVALS)))
        rows, known = (
            np.concatenate([rows, ball]),
            np.append(known, 0 * ball[:, 0] - radius),
        )
        slack = np.concatenate([slack, np.zeros((len(ball), slack.shape[1]))])
    size, extra = told.g.size, slack.shape[1]
    fixed, low, high = box(told)
    solver = piqp.DenseSolver()
    solver.settings.eps_abs = solver.settings.eps_duality_gap_abs = 1e-10
    solver.setup(
        block_diag(curved(told, float(prices.proximal)), np.zeros((extra, extra))),
        np.concatenate([told.g, *map(np.ravel, price_parts(prices))]),
        np.eye(size, size + extra)[fixed],
        told.lower[fixed],
        np.concatenate([rows, -slack], axis=1),
        None,
        -known,
        np.concatenate([np.where(low, told.lower, -INF), np.zeros(extra)]),
        np.concatenate([np.where(high, told.upper, INF), np.full(extra, INF)]),
    )
    assert solver.solve() == piqp.PIQP_SOLVED
    return solver.result.x[:size]


def price_parts(prices: Prices):
    return prices.virtual_control, prices.path, prices.integral


def check_optimality(
    parts: Parts, prices: Prices, solution: SubproblemSolution, atol=1e-6
):
    """The conditions of Karush, Kuhn and Tucker for the exact penalty."""
    told, s = dense(parts), step_of(solution)
    (D, d), (G, g), (T, t) = told.defects, told.path, told.totals
    multipliers, limits = solution.multipliers, parts.limits.integral
    y, w = np.ravel(multipliers.dynamics), np.ravel(multipliers.path)
    mu, bound = (
        np.asarray(multipliers.integral),
        flat(solution.state, solution.control, solution.final_time),
    )
    slope = curved(told, float(prices.proximal)) @ s + told.g
    slope = slope + D.T @ y + G.T @ w + T.T @ mu + bound
    assert_allclose(slope, 0.0, atol=atol)
    fixed, low, high = box(told)
    assert_allclose(s[fixed], told.lower[fixed], atol=atol)
    assert np.all(s[low] >= told.lower[low] - atol)
    assert np.all(s[high] <= told.upper[high] + atol)
    pushes_down, pushes_up = ~fixed & (bound > 1e-4), ~fixed & (bound < -1e-4)
    assert_allclose(s[pushes_down], told.upper[pushes_down], atol=atol)
    assert_allclose(s[pushes_up], told.lower[pushes_up], atol=atol)
    # A multiplier is a subgradient of its priced violation.
    virtual, buffer, integral = map(np.ravel, price_parts(prices))
    drift = T[0] @ s + t[0] - limits[0][0]
    signal = limits[0][1] - T[1] @ s - t[1]
    for value, multiplier, price, least in (
        (D @ s + d, y, virtual, -virtual),
        (G @ s + g, w, buffer, 0 * buffer),
        (drift[None], mu[:1], integral[:1], -integral[:1]),
        (signal[None], -mu[1:], integral[1:], 0 * integral[1:]),
    ):
        assert np.all(multiplier >= least - atol)
        assert np.all(multiplier <= price + atol)
        above, below = value > 1e-5, value < -1e-5
        assert_allclose(multiplier[above], price[above], atol=atol)
        assert_allclose(multiplier[below], least[below], atol=atol)


@every_block
def test_the_best_step(name):
    parts, prices = parts_of(name), prices_of()
    solution = solve(structure_of(name), PRECISE, parts.model, prices, parts.limits)
    assert bool(solution.effort.solved)
    assert not bool(solution.effort.infeasible)
    assert int(solution.effort.solves) == 1
    assert_allclose(step_of(solution), optimum(parts, prices), atol=1e-6)
    check_optimality(parts, prices, solution)
    after = predict(parts.model, solution.step)
    limits = parts.limits.integral
    assert worst_violation(after, limits) < 1e-6
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


@every_block
def test_the_assembled_rows_are_the_models(name):
    parts, prices = parts_of(name), prices_of(proximal=3.0)
    solver, numbers = solver_and_numbers(structure_of(name), PRECISE, parts, prices)
    qp, layout = solver.assemble(numbers), solver.layout
    draw = np.random.default_rng(3).normal
    step = Variables(
        jnp.asarray(draw(size=layout.states.shape)),
        jnp.asarray(draw(size=layout.controls.shape)),
        jnp.asarray(draw()),
    )
    after, nowhere = jax.tree.map(
        np.asarray,
        (
            predict(parts.model, step),
            predict(parts.model, jax.tree.map(jnp.zeros_like, step)),
        ),
    )
    z = np.zeros(layout.columns)
    z[layout.states], z[layout.controls] = step.states, step.controls
    z[layout.time] = step.final_time
    z[layout.totals[1:]] = np.cumsum(after.increments[:, :-1], axis=0)
    z[layout.buffers], z[layout.integral_buffers] = 0.25, [[0.5], [0.125]]
    # The last total leans on its buffers: above the sum by one, below it by the other.
    z[layout.totals[-1]] += 0.5 - 0.125
    left, told = qp.A @ z - qp.b, dense(parts)
    assert_allclose(left[:20], after.defects.ravel(), atol=1e-12)
    assert_allclose(left[20:30], 0.0, atol=1e-12)
    fixed = box(told)[0]
    flown = flat(step.states, step.controls, step.final_time)
    lag = np.append((flown - told.lower)[fixed], z[layout.totals[-1, 0]])
    lag[-1] -= parts.limits.integral[0][0]
    assert_allclose(left[30:], lag, atol=1e-12)
    assert_allclose(qp.G @ z - qp.h, after.path.ravel() - 0.25, atol=1e-12)
    cost = z @ qp.c + z @ qp.P @ z - 0.5 * z**2 @ qp.P.diagonal()
    rent = 0.25 * np.sum(prices.path) + 0.625 * np.sum(prices.integral)
    proximal = 0.5 * flown @ (curved(told, 3.0) - told.H) @ flown
    assert_allclose(
        cost, after.objective - nowhere.objective + proximal + rent, rtol=1e-9
    )


@pytest.mark.parametrize(("drifted", "price"), [(2.8, 3.0), (-20.0, 3.0)])
def test_cheap_buffers_are_used(drifted, price):
    parts, prices = parts_of(drifted=drifted), prices_of(path=20.0, integral=price)
    solution = solve(structure_of(), PRECISE, parts.model, prices, parts.limits)
    assert int(solution.effort.solves) == 1
    assert_allclose(step_of(solution), optimum(parts, prices), atol=1e-6)
    check_optimality(parts, prices, solution)
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
    solution = solve(structure_of(), PRECISE, parts.model, prices, parts.limits)
    assert bool(solution.effort.solved)
    assert not bool(solution.effort.infeasible)
    assert int(solution.effort.solves) == 2
    assert_allclose(step_of(solution), optimum(parts, prices), atol=1e-5)
    check_optimality(parts, prices, solution, atol=1e-5)
    # What remains of the defects is the virtual control.
    relaxed = structure_of(relaxed=True)
    solver, numbers = solver_and_numbers(relaxed, PRECISE, parts, prices)
    answer, effort = solver(numbers)
    less, more = answer.z[solver.layout.virtual]
    remaining = predict(parts.model, solution.step).defects
    assert np.max(np.abs(remaining)) > 1e-3
    assert_allclose(more - less, remaining, atol=1e-6)
    assert effort[0] == 1.0


@pytest.mark.parametrize("radius", [0.3, 1.0])
def test_the_ball(radius):
    structure = structure_of(relaxed=True, ball=True)
    parts, prices = parts_of(), prices_of(virtual=20.0, radius=radius)
    solution = solve(structure, PRECISE, parts.model, prices, parts.limits)
    assert bool(solution.effort.solved)
    assert int(solution.effort.solves) == 1
    step = solution.step
    norms = np.max(np.abs(step.states), axis=1) + np.abs(step.final_time)
    norms[:-1] += np.max(np.abs(step.controls), axis=1)
    assert np.all(norms <= radius + 1e-6), norms
    assert np.max(norms) == pytest.approx(radius, abs=1e-6)
    assert_allclose(step_of(solution), optimum(parts, prices, radius), atol=1e-6)


def test_a_wide_ball_and_dear_virtual_control_change_nothing():
    parts, prices = parts_of(), prices_of(radius=1e3)
    plain = solve(structure_of(), PRECISE, parts.model, prices, parts.limits)
    for options in ({"relaxed": True}, {"ball": True}, {"relaxed": True, "ball": True}):
        structure = structure_of(**options)
        other = solve(structure, PRECISE, parts.model, prices, parts.limits)
        assert_allclose(step_of(other), step_of(plain), atol=1e-6)
        check_optimality(parts, prices, other, atol=1e-5)


def test_broken_numbers_are_not_solved():
    parts = parts_of()
    prices = dataclasses.replace(prices_of(), proximal=jnp.asarray(np.nan))
    solution = solve(structure_of(), PRECISE, parts.model, prices, parts.limits)
    assert not bool(solution.effort.solved)
    assert not bool(solution.effort.infeasible)
    assert np.all(np.isnan(step_of(solution)))


def test_eager_compiled_and_batched():
    parts, structure = parts_of(), structure_of()

    def answer(proximal):
        prices = dataclasses.replace(prices_of(), proximal=proximal)
        return solve_subproblem(structure, PRECISE, parts.model, prices, parts.limits)

    weights = jnp.array([0.5, 2.0, 8.0])
    compiled, batch = jax.jit(answer), jax.jit(jax.vmap(answer))(weights)
    assert_allclose(
        step_of(answer(weights[1])), step_of(compiled(weights[1])), atol=1e-12
    )
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


def test_a_pattern_is_set_up_once(monkeypatch):
    calls = []

    class Counting(piqp.SparseSolver):
        def setup(self, *arguments):
            calls.append("setup")
            return super().setup(*arguments)

        def update(self, *arguments):
            calls.append("update")
            return super().update(*arguments)

    monkeypatch.setattr(piqp, "SparseSolver", Counting)
    settings = PIQP(finest=2e-8)  # no other test's solver
    for parts, prices in (
        (parts_of(), prices_of()),
        (parts_of(), prices_of(proximal=7.0)),
        (parts_of(wide=1.5), prices_of()),
    ):
        solution = solve(structure_of(), settings, parts.model, prices, parts.limits)
        fresh = solve(structure_of(), PRECISE, parts.model, prices, parts.limits)
        assert_allclose(step_of(solution), step_of(fresh), atol=1e-5)
    assert calls == ["setup", "update", "update"]
    again = Structure.of(transcribed(problem_of(wide=1.5)))
    solver, numbers = solver_and_numbers(structure_of(), settings, parts, prices)
    same, _ = solver_and_numbers(again, PIQP(finest=2e-8), parts, prices)
    assert same is solver
    assert solver.assemble(numbers) is solver.assemble(numbers)


def test_other_blocks_are_another_structure():
    """Solvers are kept by structure: one of another pattern would spoil the numbers."""
    assert len({structure_of(name) for name in DISCRETIZATIONS}) == 4


@pytest.mark.parametrize("options", [{}, {"relaxed": True}, {"ball": True}], ids=str)
@every_discretization
def test_every_column_has_one_meaning(name, options):
    layout = Layout(structure_of(name, **options))
    places = [
        *np.ravel(layout.states),
        *np.ravel(layout.controls),
        layout.time,
        *np.ravel(layout.totals[1:]),
        *np.ravel(layout.buffers),
        *np.ravel(layout.integral_buffers),
    ]
    if "relaxed" in options:
        places += [*np.ravel(layout.virtual)]
    if "ball" in options:
        places += [*np.ravel(layout.norms), layout.time_norm]
    places = np.array(places)
    assert sorted(places[places >= 0]) == list(range(layout.columns))
    # Node by node, and last of all what every node sees.
    for k in range(INTERVALS):
        here = np.concatenate([layout.states[k], layout.controls[k], layout.buffers[k]])
        assert layout.states[k].min() == here.min()
        assert layout.states[k + 1].min() > here.max()
    assert layout.time > max(layout.states.max(), layout.integral_buffers.max())


@given(st.integers(0, 2**32 - 1))
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
    parts = prepare(transcription, there, multipliers_of(*draw.normal(size=4)))
    prices = prices_of(10 ** draw.uniform(-2, 3), *10 ** draw.uniform(0.0, 4.0, size=3))
    solution = solve(structure_of(), PRECISE, parts.model, prices, parts.limits)
    assert bool(solution.effort.solved)
    weights = jax.tree.map(
        lambda leaf: np.abs(leaf) * (1.0 + draw.exponential()) + draw.exponential(),
        solution.multipliers,
    )
    limits, model = parts.limits.integral, parts.model
    before = penalized_cost(model.residuals, limits, weights)
    after = penalized_cost(predict(model, solution.step), limits, weights)
    assert after <= before + 1e-6 * (1.0 + abs(before))


def all_equal(left, right, **tolerance):
    for one, other in zip(jax.tree.leaves(left), jax.tree.leaves(right), strict=True):
        assert_allclose(one, other, **tolerance)


@every_block
def test_the_model_is_the_problem_to_first_order(name):
    transcription, parts = transcribed(problem_of(), name), parts_of(name)
    there = flown(transcription)
    zero, unravel = ravel_pytree(jax.tree.map(np.zeros_like, there))

    @functools.partial(eqx.filter_vmap, in_axes=(None, None, 0))
    def both(transcription, parts, shift):
        step = unravel(shift)
        moved = transcription.evaluate(parts.scaling.move(there, step), jnp.asarray(4))
        return parts.scaling.residuals(moved), parts.model.predict(step)

    far = 1e-5 * np.eye(zero.size)
    shifts = jnp.asarray(np.concatenate([0.0 * far[:1], far, -far]))
    around = jax.tree.map(np.asarray, eqx.filter_jit(both)(transcription, parts, shifts))
    all_equal(*(jax.tree.map(lambda leaf: leaf[0], each) for each in around), rtol=1e-12)
    truth, model = (
        jax.tree.map(
            lambda leaf: (leaf[1 : 1 + zero.size] - leaf[1 + zero.size :]) / 2e-5, each
        )
        for each in around
    )
    all_equal(truth, model, rtol=1e-6, atol=1e-8)


def test_the_hessian_is_the_curvature_made_convex():
    transcription, there = transcribed(problem_of()), flown(transcribed(problem_of()))
    arena, disc = 30.0, 2.0
    multipliers = multipliers_of(arena, disc, drift=5.0, signal=0.0)
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
    multipliers = multipliers_of(0.0, disc, drift=5.0, signal=0.0)
    _, model, _ = prepare(transcription, there, multipliers)
    assert_allclose(model.curvature.blocks[:, :4, :4], 0.0, atol=1e-12)


@given(st.integers(0, 2**32 - 1))
def test_the_hessian_is_convex(seed):
    draw = np.random.default_rng(seed)
    transcription = transcribed(problem_of())
    multipliers = multipliers_of(*10.0 * draw.normal(size=4))
    hessian = np.asarray(
        prepare(transcription, flown(transcription), multipliers)[1].curvature.blocks
    )
    assert_allclose(hessian, np.swapaxes(hessian, 1, 2), atol=1e-12)
    assert np.linalg.eigvalsh(hessian).min() > -1e-12 * np.abs(hessian).max()


def test_limits_of_a_step():
    parts, there = parts_of(), flown(transcribed(problem_of()))
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
        # Totals 3, 0.5 and 2; the last column is the cost's.
        increments=jnp.array([[1.0, 0.25, 4.0, 9.0], [2.0, 0.25, -2.0, 9.0]]),
    )
    limits = jnp.array([0.0, 1.5, -1.0]), jnp.array([2.75, INF, 3.0])
    broken = violations(residuals, limits)
    assert_allclose(broken.dynamics, [[0.5], [0.25]])
    assert_allclose(broken.path, [[0.0], [0.75], [0.0]])
    assert_allclose(broken.integral, [0.25, 1.0, 0.0])
    assert largest_buffer(broken) == 1.0
    assert worst_violation(residuals, limits) == 1.0
    weights = PerConstraint(
        jnp.array([[10.0], [20.0]]), jnp.full((3, 1), 4.0), jnp.array([1.0, 2.0, 3.0])
    )
    # 7 + (5 + 5) + 3 + (0.25 + 2)
    assert_allclose(penalized_cost(residuals, limits, weights), 22.25)
    worst = dataclasses.replace(residuals, defects=jnp.array([[0.5], [-4.0]]))
    assert worst_violation(worst, limits) == 4.0


@eqx.filter_jit
def scaling_of(transcription, guess) -> Scaling:
    return automatic_scaling(transcription, guess)


def test_scales_from_the_first_source_that_tells():
    inf, nan = np.inf, np.nan
    problem = OptimalControlProblem(
        lambda t, x, u: x * u[0],
        # As given, from limits, from both ends, from the guess, from nothing.
        state=Bounds(
            np.array([-5.0, -2.0, -inf, 0.0, -inf]),
            np.array([5.0, 4.0, inf, inf, inf]),
            scale=np.array([7.0, nan, nan, nan, nan]),
        ),
        control=Bounds(np.array([0.0, 0.5, -inf]), np.array([10.0, 0.5, inf])),
        initial_state=Bounds.exactly(np.zeros(5)),
        final_state=Bounds(
            np.array([0.0, 0.0, 8.0, -inf, 0.0]), np.array([0.0, 0.0, 8.0, inf, 0.0])
        ),
        final_time=Bounds(1.0, 9.0),
        running_cost=lambda t, x, u: 3.0 * u[0] ** 2,
        path_constraints={"p": lambda t, x, u: 2 * x[0] - x[1] + 3 * u[0] + 0.1 * t},
        integrals={
            name: Integral(lambda t, x, u: x[3], bounds)
            for name, bounds in {
                "a": Bounds.at_least(-3.0),
                "b": Bounds(2.0, 10.0),
                "c": Bounds(-inf, inf),
                "d": Bounds.at_least(3.0, scale=0.1),
                "e": Bounds.exactly(6.0),
            }.items()
        },
    )
    transcription = transcribed(problem)
    states = np.zeros((NODES, 5))
    states[:, 2], states[:, 3] = 8.0 * FRACTIONS, 0.25
    controls = np.tile([0.0, 0.5, 0.0], (INTERVALS, 1))
    guess = Variables(jnp.asarray(states), jnp.asarray(controls), jnp.array(2.0))
    scaling = scaling_of(transcription, guess)
    # The guess keeps to 0.25 where the fixed start has 0: half of that range.
    assert_allclose(scaling.state, [7.0, 3.0, 4.0, 0.125, 1.0])
    assert_allclose(scaling.control, [5.0, 0.5, 1.0])
    assert_allclose(scaling.time, 2.0)
    assert_allclose(scaling.integral, [3.0, 10.0, 0.5, 0.1, 6.0])
    # The largest change of the constraint over all ranges: 2 7 + 3 + 3 5 + 0.1 2.
    assert_allclose(scaling.path, [32.2])
    # No control costs nothing: half of its curvature over the range counts, 2 s 3 5^2.
    assert_allclose(scaling.objective, 150.0)


@pytest.mark.parametrize("factor", [1e6, 1e-6])
def test_a_cost_in_other_units(factor):
    problem = problem_of(cost=factor)
    transcription = transcribed(problem)
    scaling, model, limits = prepare(
        transcription, flown(transcription), multipliers_of()
    )
    base = parts_of()
    assert_allclose(scaling.objective, factor * base.scaling.objective, rtol=1e-12)
    same = dataclasses.replace(scaling, objective=base.scaling.objective)
    all_equal(same, base.scaling, rtol=1e-12)
    all_equal((model, limits), (base.model, base.limits), rtol=1e-9, atol=1e-12)


def test_states_in_other_units():
    unit = np.array([1e3, 1.0, 1e-2, 57.3])
    transcription = transcribed(problem_of(unit=tuple(unit)))
    there = flown(transcription, unit)
    scaling, model, limits = prepare(transcription, there, multipliers_of())
    base = parts_of()
    assert_allclose(scaling.state, unit * base.scaling.state, rtol=1e-12)
    same = dataclasses.replace(scaling, state=base.scaling.state)
    all_equal(same, base.scaling, rtol=1e-12)
    # Nothing of it is left in the scaled problem.
    all_equal((model, limits), (base.model, base.limits), rtol=1e-9, atol=1e-12)


def test_scales_of_nothing_known():
    """Neither limits nor a guess: every scale is positive all the same."""
    problem = OptimalControlProblem(
        pushed,
        state=Bounds.free(4),
        control=Bounds.free(3),
        final_time=Bounds(1.0, 9.0),
        path_constraints={"none": lambda t, x, u: jnp.zeros(2)},
        integrals={"none": Integral(drift, Bounds.at_least(0.0))},
    )
    transcription = transcribed(problem)
    guess = Variables(jnp.zeros((NODES, 4)), jnp.zeros((INTERVALS, 3)), jnp.array(5.0))
    scaling = scaling_of(transcription, guess)
    for field in dataclasses.fields(Scaling):
        expected = 5.0 if field.name == "time" else 1.0
        assert_allclose(getattr(scaling, field.name), expected, err_msg=field.name)
