"""Scales: where they come from, and that units leave no trace."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose
from past_a_disc import (
    FRACTIONS,
    INTERVALS,
    NODES,
    all_equal,
    drawn,
    drift,
    flown,
    multipliers_of,
    parts_of,
    prepare,
    problem_of,
    pushed,
    quick_jit,
    transcribed,
)
from random_models import random_model, random_scaling

from jaxscp import Bounds, OptimalControlProblem
from jaxscp._peaks import PEAK_TOLERANCE
from jaxscp._per_constraint import PerConstraint
from jaxscp._problem import Integral
from jaxscp._scaling import Scaling, automatic_scaling
from jaxscp._transcription import Variables


@quick_jit
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


def nothing_else_changed(prepared, name):
    """All other scales are the same, and so is the scaled problem."""
    (scaling, model, limits), base = prepared, parts_of()
    same = dataclasses.replace(scaling, **{name: getattr(base.scaling, name)})
    all_equal(same, base.scaling, rtol=1e-12)
    all_equal((model, limits), (base.model, base.limits), rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("factor", [1e6, 1e-6])
def test_a_cost_in_other_units(factor):
    problem = problem_of(cost=factor)
    transcription = transcribed(problem)
    prepared = prepare(transcription, flown(transcription), multipliers_of(transcription))
    scaling, base = prepared[0], parts_of()
    assert_allclose(scaling.objective, factor * base.scaling.objective, rtol=1e-12)
    nothing_else_changed(prepared, "objective")


def test_states_in_other_units():
    unit = np.array([1e3, 1.0, 1e-2, 57.3])
    transcription = transcribed(problem_of(unit=tuple(unit)))
    there = flown(transcription, unit)
    prepared = prepare(transcription, there, multipliers_of(transcription))
    scaling, base = prepared[0], parts_of()
    assert_allclose(scaling.state, unit * base.scaling.state, rtol=1e-12)
    nothing_else_changed(prepared, "state")


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


def test_a_slope_that_all_but_vanishes_at_the_guess_is_no_size():
    problem = OptimalControlProblem(
        lambda t, x, u: u,
        state=Bounds([-3.0], [3.0]),
        control=Bounds([-0.5], [0.5]),
        initial_state=Bounds.exactly([0.0]),
        final_state=Bounds.exactly([0.0]),
        final_time=Bounds.exactly(1.0),
        running_cost=lambda t, x, u: u @ u,
        path_constraints={
            # Flat at the guess; of a smoothed norm, curved as at no other place; steep;
            # not defined three ranges away.
            "squared": lambda t, x, u: x[0] ** 2 - 1.0,
            "norm": lambda t, x, u: jnp.sqrt(x[0] ** 2 + 1e-12) + u[0],
            "steep": lambda t, x, u: 2.0 * u[0] + 0.1 * u[0] ** 2,
            "root": lambda t, x, u: jnp.sqrt(1.0 + x[0]),
        },
    )
    rest = Variables(jnp.full((NODES, 1), 1e-9), jnp.zeros((INTERVALS, 1)), jnp.ones(()))
    scaling = scaling_of(transcribed(problem), rest)
    # Sorted by name. That of the norm is its control's 0.5 and 1e-3 of its state's range.
    assert_allclose(scaling.path, [0.503, 1.5, 9.0, 1.0], rtol=1e-6)


def test_multipliers_are_worth_the_same():
    """What the Lagrangian adds to the cost, in other units."""
    name, draw = "first-order-between", np.random.default_rng(1).normal
    transcription = transcribed(problem_of(), name)
    residuals = random_model(name, 0).residuals
    multipliers = drawn(draw, transcription.no_multipliers)

    def added(multipliers, residuals):
        of = residuals
        values = PerConstraint(of.defects, of.path, of.between, of.totals)
        return sum(map(jnp.vdot, *map(jax.tree.leaves, (multipliers, values))))

    scaling = random_scaling(transcription)
    nothing = scaling.residuals(jax.tree.map(jnp.zeros_like, residuals))
    # A peak may exceed its limit a little.
    assert_allclose(nothing.between, -PEAK_TOLERANCE)
    scaled = added(multipliers, scaling.residuals(residuals))
    scaled -= added(multipliers, nothing)
    own = added(scaling.physical(multipliers), residuals)
    assert_allclose(scaled, own / scaling.objective, rtol=1e-12)
