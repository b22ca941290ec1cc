"""Peaks between the nodes, against closed forms, SciPy's flow and differences."""

import itertools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from by_hand import constant_acceleration, motion
from hypothesis import given, strategies as st
from jax.flatten_util import ravel_pytree
from numpy.testing import assert_allclose
from scipy.integrate import solve_ivp

from jaxscp import (
    Bounds,
    Discretization,
    FirstOrderHold,
    OptimalControlProblem,
    ZeroOrderHold,
)
from jaxscp._peaks import Watch, derivatives, largest
from jaxscp._transcription import Transcription, Variables

INF = np.inf
ZERO_ORDER, FIRST_ORDER = ZeroOrderHold(), FirstOrderHold()
every_hold = pytest.mark.parametrize(
    "hold", [ZERO_ORDER, FIRST_ORDER], ids=("zero-order", "first-order")
)
FRACTIONS = np.array([0.0, 0.2, 0.45, 0.7, 1.0])
FINAL_TIME, PARTS = 8.0, 2
# Shares of an interval: no peak is looked for next to its nodes.
ENDS = (0.02, 0.98)
# How high a throw is that turns 2 / 3 s later, at an interval's last look.
BESIDE = 2.0 - 0.5 * (2 / 3 + 4 / 3 * ENDS[0]) ** 2


def swing(t, x, u, xp=jnp):
    """A pendulum with a drag that grows with time."""
    return xp.stack([x[1], u[0] * xp.cos(x[0]) - xp.sin(x[0]) - 0.1 * t * x[1]])


def guard(t, x, u, xp=jnp):
    return xp.stack([x[0] * u[0] - t, xp.sin(x[1]) + 0.3 * t * x[0] * u[0]])


def problem_of(state=None, **others) -> OptimalControlProblem:
    state = Bounds([-INF, -9.0], [4.0, 8.0]) if state is None else state
    return OptimalControlProblem(
        swing, state=state, control=Bounds.free(1), final_time=Bounds(1.0, 9.0), **others
    )


def transcribed(hold) -> Transcription:
    problem = problem_of(path_constraints={"guard": guard})
    discretization = Discretization(hold, between=PARTS)
    return Transcription(problem, discretization, jnp.asarray(FRACTIONS))


def point(transcription) -> Variables:
    """One where each quantity has a peak that is inside of its part."""
    draw = np.random.default_rng(9).normal
    states, controls = draw(size=(5, 2)), draw(size=(transcription.control_nodes, 1))
    return Variables(jnp.asarray(states), jnp.asarray(controls), jnp.array(FINAL_TIME))


@eqx.filter_jit
def peaks(transcription, variables, substeps):
    return transcription.evaluate(variables, substeps).between


@eqx.filter_jit
def largest_of(function, ends, size):
    return largest(function, ends, size)


def test_the_largest_value_of_each_entry():
    def function(shares):
        curves = [
            -((shares - 0.37) ** 2),
            jnp.sin(3.0 * shares + 0.2),
            jnp.exp(shares),
            -shares,
            (shares - 0.6) ** 2,
            -jnp.exp(-((shares - 0.1) ** 2)),
        ]
        return jnp.stack([curve[k] for k, curve in enumerate(curves)])

    found = largest_of(function, jnp.array([0.1, 0.9]), 6)
    # The last three are largest at an end: one falls, two are lowest within.
    expected = [0.37, (np.pi / 2 - 0.2) / 3, 0.9, 0.1, 0.1, 0.9]
    assert_allclose(found, expected, atol=1e-8)


def test_first_and_second_derivatives():
    shares = jnp.array([0.3, 0.8, -0.1])
    slope, bend = derivatives(lambda shares: jnp.sin(2.0 * shares), shares)
    assert_allclose(slope, 2.0 * np.cos(2.0 * shares), rtol=1e-14)
    assert_allclose(bend, -4.0 * np.sin(2.0 * shares), rtol=1e-14)


def parabola(shape, shares):
    top, bend = shape
    return -bend * (shares - top) ** 2


@given(
    st.floats(-1.0, 2.0), st.floats(1e-6, 1e6), st.floats(0.0, 0.9), st.floats(0.01, 0.1)
)
def test_a_parabola_is_largest_at_its_top_or_the_nearest_end(top, bend, low, width):
    ends = jnp.array([low, low + width])
    found = largest_of(eqx.Partial(parabola, jnp.array([top, bend])), ends, 1)
    assert_allclose(found, [np.clip(top, *ends)], atol=1e-12)


def test_what_is_watched():
    """Limits that do not exist are not; lower ones come first, path constraints last."""
    problem = problem_of(
        Bounds([-INF, -9.0], [5.0, INF]),
        path_constraints={"guard": guard, "first": lambda t, x, u: x[0] - 1.0},
    )
    watch = Watch.of(problem)
    assert (watch.lower, watch.upper, watch.path) == ((1,), (0,), 3)
    assert (watch.limits, watch.size) == (2, 5)
    np.testing.assert_array_equal(watch.entries, [1, 0])
    # The second state at -10 is one below, the first at 3 is two within.
    assert_allclose(watch.excess(problem, jnp.array([-10.0, 3.0])), [1.0, -2.0])
    assert Watch.of(problem_of(Bounds.exactly([0.0, 1.0]))).lower == (0, 1)


def test_without_limits_there_are_no_peaks():
    discretization = Discretization(between=3)
    transcription = Transcription(
        problem_of(Bounds.free(2)), discretization, jnp.asarray(FRACTIONS)
    )
    assert transcription.watch.size == 0
    assert peaks(transcription, point(transcription), jnp.asarray(6)).shape == (4, 0)


def flown(trajectory, lower, upper, between, substeps) -> np.ndarray:
    """Peaks of a flight as it is, whatever limits say of its nodes; parts in rows."""
    problem = motion(state=Bounds([lower, -INF], [upper, INF]))
    transcription = Transcription(
        problem, Discretization(between=between), trajectory.fractions
    )
    variables = Variables(
        trajectory.states, trajectory.controls[:-1], trajectory.final_time
    )
    found = peaks(transcription, variables, jnp.asarray(substeps))
    return found.reshape(-1, transcription.watch.size)


@pytest.mark.parametrize(
    ("nodes", "heights"),
    [
        (2, [2.0]),
        # Next to a node the last fiftieth, here of 2 s, is left out.
        (3, [2.0 - 0.5 * (2 * ENDS[0]) ** 2] * 2),
        # Of three intervals, 4 / 3 s each, the top is within the second.
        (4, [BESIDE, 2.0, BESIDE]),
    ],
)
def test_a_throw_is_highest_at_its_top(nodes, heights):
    """Thrown up at 2 m/s under -1 m/s^2: the top, 2 m, is reached after 2 of 4 s."""
    throw = constant_acceleration(-1.0, velocity=2.0, nodes=nodes)
    found = flown(throw, -INF, 1.5, between=1, substeps=3)
    # Exact, but for rounding, for a motion of order two.
    assert_allclose(found[:, 0], np.array(heights) - 1.5, atol=1e-12)


@pytest.mark.parametrize(
    ("substeps", "joints"), [(8, (0.25, 0.5, 0.75)), (10, (0.3, 0.5, 0.8))], ids=str
)
def test_parts_split_the_interval_where_a_step_ends(substeps, joints):
    """What rises is largest where a part ends, what falls where it begins."""
    flight = constant_acceleration(0.0, velocity=1.0, duration=1.0, nodes=2)
    lower, upper = flown(flight, -5.0, 7.0, between=4, substeps=substeps).T
    assert_allclose(lower, -5.0 - np.array([ENDS[0], *joints]), atol=1e-12)
    assert_allclose(upper, np.array([*joints, ENDS[1]]) - 7.0, atol=1e-12)


def sampled(transcription, variables) -> tuple[np.ndarray, np.ndarray]:
    """The largest of many samples of what is watched, and whether it lies within."""
    x, u = (
        np.asarray(variables.states),
        np.asarray(transcription.nodal_controls(variables)),
    )
    times, rows = FINAL_TIME * FRACTIONS, []
    for k, (begin, end) in enumerate(itertools.pairwise(times)):
        linear = transcription.discretization.hold == FIRST_ORDER
        rise = (u[k + 1] - u[k]) / (end - begin) if linear else np.zeros(1)

        def control(t, begin=begin, start=u[k], rise=rise):
            return start[:, None] + rise[:, None] * (t - begin)

        def rate(t, x, control=control):
            return swing(t, x, control(t)[:, 0], np)

        precise = {"method": "DOP853", "rtol": 1e-11, "atol": 1e-11}
        flow = solve_ivp(rate, (begin, end), x[k], dense_output=True, **precise).sol
        for low, high in itertools.pairwise((ENDS[0], 0.5, ENDS[1])):
            t = begin + (end - begin) * np.linspace(low, high, 10_001)
            states = flow(t)
            limits = [-9.0 - states[1], states[0] - 4.0, states[1] - 8.0]
            watched = [*limits, *guard(t, states, control(t), np)]
            rows.append(np.array(watched))
    best = np.argmax(rows, axis=2)
    within = (best > 0) & (best < 10_000)
    return np.max(rows, axis=2).reshape(4, -1), within.reshape(4, -1)


@every_hold
def test_peaks_are_those_of_the_flow(hold):
    """To the order of the steps, four, between their ends as well."""
    transcription = transcribed(hold)
    variables = point(transcription)
    (exact, within), counts = sampled(transcription, variables), np.array([24, 48, 96])
    assert np.all(np.any(within.reshape(-1, 5), axis=0))
    errors = [
        np.abs(peaks(transcription, variables, jnp.asarray(count)) - exact)
        for count in counts
    ]
    worst = np.max(errors, axis=(1, 2))
    order = -np.polyfit(np.log(counts), np.log(worst), 1)[0]
    assert 3.6 < order < 4.6, worst
    assert worst[-1] < 1e-6


@every_hold
def test_derivatives_of_the_peaks(hold):
    """By central differences along every variable, relative to the largest of a row."""
    transcription, substeps = transcribed(hold), jnp.asarray(12)
    variables = point(transcription)
    flat, unravel = ravel_pytree(variables)
    steps = 1e-5 * jnp.eye(flat.size)

    @jax.jit
    def told(variables, steps):
        residuals, derivatives = transcription.linearize(variables, substeps)

        def along(step):
            moved = unravel(step)
            controls = transcription.nodal_controls(moved)
            jacobian = derivatives.intervals.between
            return jacobian.apply(moved.states, controls, moved.final_time)

        return residuals.between, jax.vmap(along, out_axes=-1)(steps)

    seen = jax.vmap(
        lambda step: peaks(transcription, unravel(flat + step), substeps), out_axes=-1
    )
    value, change = told(variables, steps)
    row = np.abs(change).max(axis=-1, keepdims=True)
    assert np.all(row > 0)
    difference = 0.5 * (seen(steps) - seen(-steps))
    assert_allclose(difference / row, change / row, rtol=1e-6, atol=1e-6)
    assert_allclose(value, peaks(transcription, variables, substeps), rtol=1e-12)
