"""Routes around buildings: which there are, and which is the shortest."""

import itertools

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from numpy.testing import assert_allclose

from jaxscp._routes import Routes
from jaxscp.models import Cylinders

MOST = 8
START, GOAL = np.array([0.0, 0.0, 10.0]), np.array([1000.0, 0.0, 50.0])
around = eqx.filter_jit(Routes.around)


def routes(places, centers, radii):
    """Those that exist, with a margin of one and a half."""
    buildings = Cylinders(centers, radii)
    found = around(jnp.asarray(places), buildings, jnp.asarray(1.5), MOST)
    count = int(np.isfinite(found.lengths).sum())
    assert np.isinf(found.lengths[count:]).all()
    return np.asarray(found.places)[:count], np.asarray(found.lengths)[:count]


def test_routes_are_the_shortest_of_all_there_are():
    """Four buildings on the way: eight of the sixteen ways past them."""
    centers = [[600.0, 10.0], [200.0, -15.0], [850.0, 5.0], [400.0, 20.0]]
    radii = [40.0, 30.0, 20.0, 50.0]
    places, lengths = routes([START, GOAL], centers, radii)
    every = {}
    in_order = sorted(zip(centers, radii, strict=True))
    for sides in itertools.product((1, -1), repeat=4):
        corners = [
            (x, y + side * 1.5 * radius)
            for side, ((x, y), radius) in zip(sides, in_order, strict=True)
        ]
        way = np.array([START[:2], *corners, GOAL[:2]])
        every[sides] = np.linalg.norm(np.diff(way, axis=0), axis=1).sum()
    shortest = sorted(every, key=every.get)[:MOST]
    assert_allclose(lengths, [every[sides] for sides in shortest], rtol=1e-12)
    offsets = np.array([y for (_, y), _ in in_order])
    found = np.sign(places[:, 1:, 1] - offsets)
    np.testing.assert_array_equal(found, np.array(shortest))


def test_a_building_beside_the_way_makes_no_route():
    places, _ = routes([START, GOAL], [[200.0, 5.0], [500.0, 300.0]], [40.0, 40.0])
    # What is passed there lies on the way itself.
    assert_allclose(places[:, 2, 1], 0.0, atol=1e-9)
    assert sorted(places[:, 1, 1]) == [-55.0, 65.0]
    none, _ = routes([START, GOAL], [[200.0, 80.0], [500.0, 300.0]], [40.0, 40.0])
    assert len(none) == 1


def test_routes_of_two_legs():
    """A building on each: four ways, and both places to visit on all of them."""
    corner = np.array([1000.0, 1000.0, 30.0])
    centers = [[500.0, -10.0], [1010.0, 500.0]]
    places, lengths = routes([START, [1000.0, 0.0, 20.0], corner], centers, [40.0, 40.0])
    assert len(places) == 4
    assert_allclose(places[:, 3], np.tile([1000.0, 0.0, 20.0], (4, 1)))
    ways = []
    for y, x in itertools.product((50.0, -70.0), (1070.0, 950.0)):
        way = np.array([[0, 0], [500, y], [1000, 0], [x, 500], [1000, 1000]])
        ways.append(np.linalg.norm(np.diff(way, axis=0), axis=1).sum())
    assert_allclose(lengths, sorted(ways), rtol=1e-12)


def test_many_buildings_are_passed_all_on_one_side():
    centers = [[100.0 * (k + 1), 10.0 * (-1) ** k] for k in range(9)]
    places, _ = routes([START, GOAL], centers, [20.0] * 9)
    sides = np.sign(places[:, 1:, 1] - np.array(centers)[:, 1])
    assert {tuple(row) for row in sides} == {(1.0,) * 9, (-1.0,) * 9}
