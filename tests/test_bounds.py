"""`Bounds`: what is fixed, what is checked, and how derivatives pass through."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, strategies as st
from numpy import array

from jaxscp._bounds import Bounds


def test_limits_are_broadcast_against_each_other():
    bounds = Bounds(0.0, jnp.array([1.0, 2.0]), scale=3.0)
    assert bounds.shape == (2,)
    np.testing.assert_array_equal(bounds.lower, [0.0, 0.0])
    np.testing.assert_array_equal(bounds.upper, [1.0, 2.0])
    np.testing.assert_array_equal(bounds.scale, [3.0, 3.0])


def test_integers_become_floats():
    bounds = Bounds(0, array([1, 2]))
    assert bounds.lower.dtype == bounds.upper.dtype == jnp.float64


@pytest.mark.parametrize(
    ("bounds", "lower", "upper", "fixed"),
    [
        (Bounds(array([0.0, 1.0]), array([0.0, 2.0])), [0, 1], [0, 2], [True, False]),
        (Bounds.exactly(array([3.0, 4.0])), [3, 4], [3, 4], [True, True]),
        (Bounds.exactly(3), 3, 3, True),
        (Bounds.free(2), [-np.inf] * 2, [np.inf] * 2, [False, False]),
        (Bounds.at_least(1.0), 1, np.inf, False),
        (Bounds.at_most(array([1.0])), [-np.inf], [1], [False]),
        (
            Bounds(array([1.0, 1.0]), 1.0, fixed=(True, False)),
            [1, 1],
            [1, 1],
            [True, False],
        ),
    ],
)
def test_what_is_fixed(bounds, lower, upper, fixed):
    np.testing.assert_array_equal(bounds.lower, lower)
    np.testing.assert_array_equal(bounds.upper, upper)
    np.testing.assert_array_equal(bounds.is_fixed, fixed)
    assert bounds.is_fixed.shape == bounds.shape


@pytest.mark.parametrize(
    ("limits", "message"),
    [
        (
            (array([0.0, 2.0]), array([1.0, 1.0])),
            r"lower\[1\]=2 exceeds upper\[1\]=1; swap",
        ),
        ((2.0, 1.0), "lower=2 exceeds upper=1"),
        ((array([0.0, np.nan]), 1.0), "must not be NaN"),
        ((0.0, np.nan), "must not be NaN"),
    ],
)
def test_impossible_limits(limits, message):
    with pytest.raises(ValueError, match=message) as error:
        Bounds(*limits)
    assert "\n" not in str(error.value)


def test_fixed_needs_one_truth_value_an_entry():
    with pytest.raises(ValueError, match="fixed has 1 entries for 2 limits"):
        Bounds(jnp.zeros(2), jnp.ones(2), fixed=(True,))


numbers = st.floats(-1e6, 1e6)


@given(numbers, numbers, numbers)
def test_clipping_is_the_nearest_value_within(first, second, value):
    lower, upper = min(first, second), max(first, second)
    clipped = float(Bounds(lower, upper).clip(jnp.asarray(value)))
    assert clipped == pytest.approx(min(max(value, lower), upper), rel=1e-12, abs=1e-9)


def test_clipping_to_open_limits_changes_nothing():
    values = jnp.array([-1e300, 0.0, 1e300])
    np.testing.assert_array_equal(Bounds.free(3).clip(values), values)


def test_the_derivative_of_a_target_splits_between_both_ends():
    def target(lower, upper):
        return Bounds(lower, upper, fixed=(True,)).target

    by_lower, by_upper = jax.grad(target, argnums=(0, 1))(2.0, 2.0)
    assert by_lower == by_upper == 0.5
    assert jax.grad(lambda value: Bounds.exactly(value).target)(2.0) == 1.0


def test_traced_values_make_bounds():
    @jax.jit
    def targets(value):
        return Bounds.exactly(value).target, Bounds(value, value).target

    np.testing.assert_array_equal(jnp.stack(targets(3.0)), [3.0, 3.0])


def test_new_values_compile_nothing_but_other_fixed_entries_do():
    traces = []

    @eqx.filter_jit
    def width(bounds):
        traces.append(None)
        return bounds.upper - bounds.lower

    width(Bounds(jnp.zeros(2), jnp.ones(2)))
    width(Bounds(jnp.zeros(2), jnp.array([5.0, 7.0])))
    assert len(traces) == 1
    width(Bounds(jnp.zeros(2), jnp.array([0.0, 7.0])))
    assert len(traces) == 2


def test_python_numbers_and_arrays_share_a_compilation():
    traces = []

    @eqx.filter_jit
    def width(bounds):
        traces.append(None)
        return bounds.upper - bounds.lower

    width(Bounds(0.0, 1.0, scale=1.0))
    width(Bounds(jnp.asarray(0.5), np.float64(2.0), scale=jnp.asarray(2.0)))
    assert len(traces) == 1


def test_which_limits_there_are_is_found_from_the_values():
    bounds = Bounds([-np.inf, 0.0], [1.0, np.inf])
    assert bounds.limited == ((False, True), (True, False))


def test_of_traced_limits_all_count_unless_told():
    told = ((False, True), (False, False))
    seen = []

    def trace(lower):
        seen.append(Bounds(lower, jnp.inf).limited)
        seen.append(Bounds(lower, jnp.inf, limited=told).limited)

    jax.eval_shape(trace, jnp.zeros(2))
    assert seen == [((True, True), (True, True)), told]


def test_limits_must_all_be_told():
    with pytest.raises(ValueError, match=r"limited has 2, 1 entries for 2 limits"):
        Bounds(jnp.zeros(2), jnp.ones(2), limited=((True, True), (True,)))


def test_one_after_the_other():
    both = Bounds([0.0, -np.inf], [1.0, 2.0]).followed_by(Bounds.exactly(3.0, scale=5.0))
    np.testing.assert_array_equal(both.lower, [0.0, -np.inf, 3.0])
    np.testing.assert_array_equal(both.upper, [1.0, 2.0, 3.0])
    np.testing.assert_array_equal(both.scale, [np.nan, np.nan, 5.0])
    assert both.fixed == (False, False, True)
    assert both.limited == ((True, False, True), (True, True, True))
