"""Buildings: clearances by hand, and slopes that exist everywhere."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import example, given, strategies as st
from numpy.testing import assert_allclose

from jaxscp.models import Cylinders

BUILDINGS = Cylinders([[190.0, 200.0], [420.0, 400.0]], [40.0, 30.0])
coordinate = st.floats(-1000.0, 1000.0)


def test_clearance_by_hand():
    # 3-4-5: 50 m from the first axis; the second is at (-200, -160) from there.
    clearance = BUILDINGS.clearance(jnp.array([220.0, 240.0, 55.0]))
    assert_allclose(clearance, [10.0, np.hypot(200.0, 160.0) - 30.0], atol=1e-6)


@given(st.floats(-3.0, 3.0), st.floats(0.0, 500.0))
def test_clearance_is_zero_exactly_at_the_safe_distance(heading, safe):
    place = safe * np.array([np.cos(heading), np.sin(heading)])
    cylinder = Cylinders([[0.0, 0.0]], [safe])
    assert_allclose(cylinder.clearance(jnp.asarray(place)), [0.0], atol=1e-12)


@given(coordinate, coordinate, coordinate)
@example(190.0, 200.0, 0.0)
def test_constraint_is_positive_within_and_negative_outside(x, y, z):
    state = jnp.zeros(12).at[:3].set(jnp.array([x, y, z]))
    values = BUILDINGS(jnp.zeros(()), state, jnp.zeros(4))
    inside = np.hypot(x - np.array([190, 420]), y - np.array([200, 400]))
    assert values.shape == (2,)
    assert_allclose(values, [40.0, 30.0] - inside, atol=1e-3)


@jax.jit
def slopes(place):
    forward = jax.jacfwd(BUILDINGS.clearance)(place)
    return forward, jax.jacrev(BUILDINGS.clearance)(place)


@jax.jit
def curvature(place):
    return jax.hessian(BUILDINGS.clearance)(place)


@given(coordinate, coordinate)
@example(190.0, 200.0)
@example(420.0, 400.0)
@example(190.0 + 1e-12, 200.0)
def test_derivatives_are_finite_and_slopes_at_most_one(x, y):
    place = jnp.array([x, y])
    for slope in slopes(place):
        assert np.isfinite(slope).all()
        assert (np.linalg.norm(slope, axis=1) <= 1 + 1e-12).all()
    assert np.isfinite(curvature(place)).all()


@given(coordinate, coordinate)
def test_tangent_half_planes_never_cut_into_a_circle(x, y):
    # The clearance is convex: what its linearization allows is truly allowed.
    here, there = jnp.array([x, y]), jnp.array([205.0, 222.0])
    value, (slope, _) = BUILDINGS.clearance(here), slopes(here)
    linear = value + slope @ (there - here)
    assert (np.asarray(linear) <= np.asarray(BUILDINGS.clearance(there)) + 1e-9).all()


def test_there_may_be_no_building():
    for none in (Cylinders(), Cylinders([], [])):
        assert none.count == 0
        assert none.clearance(jnp.zeros(3)).shape == (0,)
        assert none(jnp.zeros(()), jnp.zeros(12), jnp.zeros(4)).shape == (0,)


@pytest.mark.parametrize(
    ("centers", "distances", "message"),
    [
        ([[1.0, 2.0]], [1.0, 2.0], "safe_distances has 2 entries for 1 centers"),
        ([[1.0, 2.0, 3.0]], [1.0], r"centers has shape \(1, 3\): give a list of rows"),
        ([[1.0, np.nan]], [1.0], r"centers\[0\]\[1\]=nan"),
        ([[1.0, 2.0]], [-4.0], r"safe_distances\[0\]=-4: give .* at least 0"),
    ],
)
def test_impossible_buildings_are_refused(centers, distances, message):
    with pytest.raises(ValueError, match=message):
        Cylinders(centers, distances)
