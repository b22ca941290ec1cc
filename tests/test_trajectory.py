"""Time grids and guesses."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, strategies as st
from numpy import array

from jaxscp._bounds import Bounds
from jaxscp._problem import OptimalControlProblem
from jaxscp._trajectory import (
    Trajectory,
    straight_line,
    through_waypoints,
    time_grid,
)


def plane(**changes) -> OptimalControlProblem:
    """A point in a plane, [m], moved by its velocity, [m/s]."""
    settings = {
        "state": Bounds.free(2),
        "control": Bounds(jnp.array([-1.0, 0.5]), jnp.array([1.0, 2.0])),
        "initial_state": Bounds.exactly(jnp.array([0.0, 1.0])),
        "final_state": Bounds.exactly(jnp.array([8.0, 5.0])),
        "final_time": Bounds(2.0, 6.0),
    }
    return OptimalControlProblem(lambda t, x, u: u, **(settings | changes))


def test_an_even_grid():
    np.testing.assert_allclose(time_grid(5), [0, 0.25, 0.5, 0.75, 1])
    np.testing.assert_allclose(time_grid(np.int64(2)), [0, 1])


@given(st.lists(st.floats(1e-3, 1e3), min_size=1, max_size=20))
def test_an_uneven_grid_is_kept(widths):
    fractions = np.concatenate([[0.0], np.cumsum(widths) / np.sum(widths)])
    np.testing.assert_array_equal(time_grid(fractions), fractions)


@pytest.mark.parametrize(
    ("nodes", "message"),
    [
        (1, "nodes=1: a grid needs at least 2 nodes"),
        (-3, "nodes=-3"),
        (array([0.0]), r"nodes has shape \(1,\)"),
        (array([[0.0, 1.0]]), r"nodes has shape \(1, 2\)"),
        (5.0, "nodes=5.0: give a whole number, or a vector of fractions"),
        (array([0.0, 0.6, 0.5, 1.0]), "fractions must rise"),
        (array([0.0, 0.5, 0.5, 1.0]), "must rise"),
        (array([0.1, 0.5, 1.0]), "must rise"),
        (array([0.0, 5.0, 10.0]), "divide by the last"),
        (array([0.0, np.nan, 1.0]), "must rise"),
    ],
)
def test_bad_grids(nodes, message):
    with pytest.raises(ValueError, match=message) as error:
        time_grid(nodes)
    assert "\n" not in str(error.value)


def test_times_scale_with_the_flight_time():
    trajectory = Trajectory(
        jnp.array([0.0, 0.2, 1.0]), jnp.zeros((3, 2)), jnp.zeros((3, 1)), jnp.array(5.0)
    )
    np.testing.assert_allclose(trajectory.times, [0, 1, 5])
    assert trajectory.nodes == 3


def test_a_straight_line():
    guess = straight_line(plane(), 5)
    np.testing.assert_allclose(guess.states[:, 0], [0, 2, 4, 6, 8])
    np.testing.assert_allclose(guess.states[:, 1], [1, 2, 3, 4, 5])
    assert guess.final_time == 4.0  # the middle of its range
    # No control, or the limit nearest to none.
    np.testing.assert_allclose(guess.controls, np.tile([0.0, 0.5], (5, 1)))


def test_a_straight_line_on_an_uneven_grid():
    fractions = jnp.array([0.0, 0.1, 0.7, 1.0])
    guess = straight_line(plane(), fractions, final_time=3.0)
    np.testing.assert_allclose(guess.states[:, 0], 8 * fractions)
    np.testing.assert_allclose(guess.times, 3 * fractions)


@pytest.mark.parametrize(
    ("initial", "final", "first", "last"),
    [
        # An open end takes the value of the other one, or zero.
        (Bounds.exactly(array([2.0, 3.0])), Bounds.free(2), [2, 3], [2, 3]),
        (Bounds.free(2), Bounds.exactly(array([2.0, 3.0])), [2, 3], [2, 3]),
        (Bounds.free(2), Bounds.free(2), [0, 0], [0, 0]),
        # A range its middle, a half-open one its finite end.
        (
            Bounds(array([0.0, 1.0]), array([4.0, 3.0])),
            Bounds.at_least(array([6.0, 7.0])),
            [2, 2],
            [6, 7],
        ),
        (Bounds.at_most(array([1.0, 2.0])), Bounds.free(2), [1, 2], [1, 2]),
    ],
)
def test_a_straight_line_between_open_ends(initial, final, first, last):
    guess = straight_line(plane(initial_state=initial, final_state=final), 3)
    np.testing.assert_allclose(guess.states[0], first)
    np.testing.assert_allclose(guess.states[-1], last)


def test_guessed_controls():
    kept = straight_line(plane(), 3, control=array([0.3, 0.7]))
    np.testing.assert_allclose(kept.controls, np.tile([0.3, 0.7], (3, 1)))
    varied = straight_line(plane(), 3, control=array([[0.0, 1.0], [1.0, 2.0]]))
    np.testing.assert_allclose(varied.controls, [[0, 1], [0.5, 1.5], [1, 2]])


def test_waypoints_share_the_time_by_length():
    # Largest distances 4 m and 3 m: the legs are 1 and 1 of them, hence equally long.
    points = array([[0.0, 0.0], [4.0, 0.0], [4.0, 3.0]])
    guess = through_waypoints(plane(), points, nodes=5, final_time=10.0)
    np.testing.assert_allclose(
        guess.states, [[0, 0], [2, 0], [4, 0], [4, 1.5], [4, 3]], atol=1e-12
    )


def test_loitering_at_waypoints():
    points = array([[0.0, 1.0], [4.0, 1.0], [8.0, 1.0]])
    guess = through_waypoints(
        plane(), points, nodes=11, final_time=10.0, loiter=[1.0, 3.0, 2.0]
    )
    # Two legs of 2 s each: 1 to 3 s and 6 to 8 s.
    np.testing.assert_allclose(
        guess.states[:, 0], [0, 0, 2, 4, 4, 4, 4, 6, 8, 8, 8], atol=1e-12
    )
    np.testing.assert_allclose(guess.states[:, 1], 1.0)


def test_coinciding_waypoints():
    guess = through_waypoints(plane(), np.ones((3, 2)), nodes=4, final_time=1.0)
    np.testing.assert_allclose(guess.states, 1.0)


waypoints = st.lists(
    st.tuples(st.floats(-100, 100), st.floats(-100, 100)), min_size=4, max_size=4
)


@given(waypoints, st.floats(0.1, 100.0))
def test_a_guess_keeps_its_ends_and_its_hull(points, final_time):
    points = array(points)
    guess = through_waypoints(plane(), points, nodes=23, final_time=final_time)
    states = np.asarray(guess.states)
    np.testing.assert_allclose(states[0], points[0], atol=1e-9)
    np.testing.assert_allclose(states[-1], points[-1], atol=1e-9)
    assert np.all(states >= points.min(axis=0) - 1e-9)
    assert np.all(states <= points.max(axis=0) + 1e-9)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"waypoints": array([[0.0, 0.0]])}, r"waypoints has shape \(1, 2\)"),
        (
            {"waypoints": array([[0.0], [1.0]])},
            r"waypoints has shape \(2, 1\): .* 2 entries",
        ),
        ({"loiter": [1.0]}, r"loiter has shape \(1,\)"),
        ({"loiter": [3.0, 1.0]}, "more than the flight time of 4 s"),
        ({"control": array([1.0])}, r"control has shape \(1,\): .* 2 entries"),
        ({"control": np.zeros((3, 2))}, r"control has shape \(3, 2\)"),
        ({"nodes": 1}, "nodes=1"),
    ],
)
def test_bad_guesses(settings, message):
    settings = {"waypoints": array([[0.0, 0.0], [1.0, 1.0]])} | settings
    with pytest.raises(ValueError, match=message) as error:
        through_waypoints(plane(), **settings)
    assert "\n" not in str(error.value)


def test_an_open_flight_time_must_be_guessed():
    problem = plane(final_time=Bounds.at_least(1.0))
    with pytest.raises(ValueError, match="give the guess a flight time"):
        straight_line(problem)
    assert straight_line(problem, final_time=7.0).final_time == 7.0


def test_a_guess_is_differentiable():
    def last(goal):
        problem = plane(final_state=Bounds.exactly(goal))
        return straight_line(problem, 5, final_time=3.0).states[2, 0]

    np.testing.assert_allclose(jax.grad(last)(jnp.array([8.0, 5.0])), [0.5, 0.0])


def test_a_guess_under_jit_is_the_same():
    eager = straight_line(plane(), 7)
    jitted = eqx.filter_jit(lambda problem: straight_line(problem, 7))(plane())
    for left, right in zip(jax.tree.leaves(eager), jax.tree.leaves(jitted), strict=True):
        np.testing.assert_allclose(left, right, rtol=1e-14)
