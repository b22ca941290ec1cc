"""The numbers of a subproblem's QP, row by row, and the solvers kept for them."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import piqp
import pytest
from numpy.testing import assert_allclose
from past_a_disc import (
    DISCRETIZATIONS,
    INTERVALS,
    LIMITS,
    PATH,
    damped,
    damping_of,
    dense,
    drawn,
    ends_of,
    every_discretization,
    flat,
    held_damping_of,
    predict,
    prices_of,
    problem_of,
    solve,
    solver_and_numbers,
    structure_of,
    to_the_host,
    transcribed,
)
from random_models import random_limits, random_model

from jaxscp._layout import Layout, Structure
from jaxscp._qp import PIQP
from jaxscp._transcription import Variables


def random_data(structure: Structure, name: str, seed=0, damping=held_damping_of):
    model, limits = random_model(name, seed), random_limits(structure, seed, wide=80.0)
    draw = np.random.default_rng(seed).exponential
    prices = drawn(draw, prices_of(name))
    return model, damping(model), prices, limits


def random_step(layout: Layout, draw) -> Variables:
    states, controls = draw(size=layout.states.shape), draw(size=layout.controls.shape)
    return Variables(jnp.asarray(states), jnp.asarray(controls), jnp.asarray(draw()))


@pytest.mark.parametrize("relaxed", [False, True])
@every_discretization
def test_the_assembled_rows_are_the_models(name, relaxed):
    structure = structure_of(name, relaxed=relaxed)
    model, damping, prices, limits = random_data(structure, name)
    data = to_the_host(model, damping, prices, limits)
    solver, numbers = solver_and_numbers(structure, PIQP(), data)
    qp, layout = solver.assemble(numbers), solver.layout
    draw = np.random.default_rng(3).normal
    step = random_step(layout, draw)
    after = jax.tree.map(np.asarray, predict(model, step))
    # Virtual variables have whatever value the draw gives them.
    z = draw(size=layout.columns)
    z[layout.states], z[layout.controls] = step.states, step.controls
    z[layout.time] = step.final_time
    sums, lean = np.cumsum(after.increments[:, :-1], axis=0), z[layout.integral_buffers]
    z[layout.totals[1:]] = sums
    # The last total leans on its buffers: above the sum by one, below it by the other.
    z[layout.totals[-1]] += lean[0] - lean[1]
    buffers, virtual, spare = (
        z[places] if relaxed or places is layout.buffers else np.zeros(places.shape)
        for places in (layout.buffers, layout.virtual, layout.limit_buffers)
    )

    left = qp.A @ z - qp.b
    defects = after.defects + virtual[0] - virtual[1]
    assert_allclose(left[:20], defects.ravel(), atol=1e-12)
    assert_allclose(left[20:30], 0.0, atol=1e-12)
    lower, upper = ends_of(limits)
    fixed, flown = lower == upper, flat(step)
    lag = np.append((flown - lower)[fixed], z[layout.totals[-1, 0]])
    lag[-1] -= limits.integral[0][0]
    assert_allclose(left[30:], lag, atol=1e-12)

    parts = structure.parts
    peaks = after.between.reshape(INTERVALS, parts, LIMITS + PATH).copy()
    peaks[:, :, LIMITS:] -= buffers[:-1, None]
    if parts:
        peaks[:, :, :LIMITS] -= spare[:, None]
    above = np.append(after.path - buffers, peaks)
    assert_allclose(qp.G @ z - qp.h, above, atol=1e-12)

    # The squares of the integrals count on the totals less their buffers.
    pull = np.asarray(damping.integral)
    others = dataclasses.replace(damping, integral=jnp.zeros_like(damping.integral))
    told, totals = damped(dense(model), others), z[layout.totals[-1]]
    prices = jax.tree.map(np.asarray, prices)
    expected = 0.5 * flown @ told.H @ flown + told.g @ flown
    expected += pull @ (0.5 * totals**2 - np.asarray(damping.target) * totals)
    expected += np.sum(prices.path * buffers) + np.sum(prices.integral * lean)
    expected += np.sum(prices.virtual_control * virtual)
    expected += np.sum(prices.limit * spare) if relaxed else 0.0
    cost = z @ qp.c + z @ qp.P @ z - 0.5 * z**2 @ qp.P.diagonal()
    assert_allclose(cost, expected, rtol=1e-10)


@pytest.mark.parametrize("options", [{}, {"relaxed": True}, {"ball": True}], ids=str)
@pytest.mark.parametrize("name", ["zero-order", "first-order-between"])
def test_the_limits_of_every_column(name, options):
    structure = structure_of(name, **options)
    data = to_the_host(*random_data(structure, name))
    solver, numbers = solver_and_numbers(structure, PIQP(), data)
    qp, layout = solver.assemble(numbers), solver.layout
    places = [*np.ravel(layout.states), *np.ravel(layout.controls), layout.time]
    lower, upper = ends_of(data.limits)
    fixed = lower == upper
    assert_allclose(qp.lower[places], np.where(fixed, -np.inf, lower))
    assert_allclose(qp.upper[places], np.where(fixed, np.inf, upper))
    drift, signal = layout.totals[-1]
    assert_allclose(qp.lower[[drift, signal]], [-np.inf, data.limits.integral[0][1]])
    assert_allclose(qp.upper[[drift, signal]], [np.inf, data.limits.integral[1][1]])
    # Earlier totals are free, and what is virtual is never negative.
    earlier = np.ravel(layout.totals[1:-1])
    assert np.all(np.isneginf(qp.lower[earlier]))
    virtual = np.setdiff1d(range(layout.columns), [*places, *earlier, drift, signal])
    assert_allclose(qp.lower[virtual], 0.0)
    assert np.all(np.isposinf(qp.upper[[*virtual, *earlier]]))


@pytest.mark.parametrize(("price", "relaxed"), [(1e-3, True), (1e6, False)])
def test_virtual_control_is_taken_where_the_dynamics_cost_far_more(price, relaxed):
    structure = structure_of()
    model, damping, prices, limits = random_data(structure, "zero-order")
    virtual = jnp.full_like(prices.virtual_control, price)
    prices = dataclasses.replace(prices, virtual_control=virtual, relax=jnp.ones(()))
    arguments = (PIQP(), model, damping, prices, limits)
    solution = solve(structure, *arguments)
    assert bool(solution.effort.solved)
    assert bool(solution.effort.relaxed) is relaxed
    broken = predict(model, solution.step).defects
    assert (float(jnp.max(jnp.abs(broken))) > 1e-3) is relaxed


def test_a_pattern_is_set_up_once(monkeypatch):
    structure = structure_of()

    def data(seed, proximal):
        model, damping, prices, limits = random_data(
            structure, "zero-order", seed, lambda model: damping_of(model, proximal)
        )
        return model, damping, dataclasses.replace(prices, relax=jnp.zeros(())), limits

    several = [data(0, 2.0), data(0, 7.0), data(1, 2.0)]
    fresh = [solve(structure, PIQP(), *each) for each in several]
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
    for each, expected in zip(several, fresh, strict=True):
        solution = solve(structure, settings, *each)
        assert bool(solution.effort.solved)
        assert_allclose(flat(solution.step), flat(expected.step), atol=1e-5)
    assert calls == ["setup", "update", "update"]
    travels = to_the_host(*several[-1])
    again = Structure.of(transcribed(problem_of(wide=1.5)))
    solver, numbers = solver_and_numbers(structure, settings, travels)
    same, _ = solver_and_numbers(again, PIQP(finest=2e-8), travels)
    assert same is solver
    assert solver.assemble(numbers) is solver.assemble(numbers)


def test_other_blocks_are_another_structure():
    """Solvers are kept by structure: one of another pattern would spoil the numbers. On
    the host they are found by its text, the same in every process.
    """
    every = list(map(structure_of, DISCRETIZATIONS))
    assert len(set(every)) == len(set(map(repr, every))) == len(DISCRETIZATIONS)
    assert not any(" at 0x" in repr(each) for each in every)


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
        places += [*np.ravel(layout.virtual), *np.ravel(layout.limit_buffers)]
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
