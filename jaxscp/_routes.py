"""`Routes`: ways around the buildings between places to visit."""

import functools
import itertools

import equinox as eqx
import jax.numpy as jnp

from ._types import Array, Float, Scalar
from .models.obstacles import Cylinders

# 2^8 ways to pass eight buildings.
_MOST_ENUMERATED = 8


class Routes(eqx.Module):
    """Ways through the same places, shortest first.

    The number of rows never depends on numbers: a row without a route to go with it is
    infinitely long.

    - `places`: what each route passes, its start included and its goal not [m].
    - `lengths`: over the ground [m].
    """

    places: Float[Array, "r k 3"]
    lengths: Float[Array, " r"]

    @classmethod
    def around(
        cls,
        places: Float[Array, "j 3"],
        obstacles: Cylinders,
        margin: Scalar,
        most: int,
    ) -> "Routes":
        """The `most` shortest routes that differ in the sides on which they pass.

        **Arguments:**

        - `places`: to visit, start and goal included [m].
        - `margin`: how far beside a building's axis it is passed, in safe distances.
        """
        legs = [
            _of_a_leg(here, there, obstacles, margin)._shortest(most)
            for here, there in itertools.pairwise(places)
        ]
        return functools.reduce(lambda first, then: first._then(then, most), legs)

    def _then(self, other: "Routes", most: int) -> "Routes":
        """Each of these routes, followed by each of the others."""
        mine, its = self.lengths.size, other.lengths.size
        places = [
            jnp.repeat(self.places, its, axis=0),
            jnp.tile(other.places, (mine, 1, 1)),
        ]
        lengths = self.lengths[:, None] + other.lengths[None]
        return Routes(jnp.concatenate(places, axis=1), lengths.ravel())._shortest(most)

    def _shortest(self, most: int) -> "Routes":
        order = jnp.argsort(self.lengths)[:most]
        return Routes(self.places[order], self.lengths[order])


def _of_a_leg(
    here: Float[Array, "3"],
    there: Float[Array, "3"],
    obstacles: Cylinders,
    margin: Scalar,
) -> Routes:
    """Every way along one leg: where it starts, and a place to pass for each building.

    Buildings come in the order they come up. For those not in the way the place lies on
    the leg itself, so that the number of places never depends on numbers.
    """
    count = obstacles.count
    way = there - here
    length = jnp.maximum(jnp.linalg.norm(way[:2]), 1e-9)
    along = way[:2] / length
    left = jnp.stack([-along[1], along[0]])
    gaps = obstacles.centers - here[None, :2]
    share = jnp.clip(gaps @ along / length, 0.0, 1.0)
    order = jnp.argsort(share)
    share, offset = share[order], (gaps @ left)[order]
    kept = margin * obstacles.safe_distances[order]
    blocked = (jnp.abs(offset) < kept) & (share > 0.0) & (share < 1.0)
    aside = jnp.where(blocked[None], offset[None] + _sides(count) * kept[None], 0.0)
    steps = jnp.diff(jnp.pad(share * length, (1, 1)).at[-1].set(length))
    turns = jnp.diff(jnp.pad(aside, ((0, 0), (1, 1))), axis=1)
    lengths = jnp.sum(jnp.hypot(steps[None], turns), axis=1)
    # Sides of a building that is not in the way make no other route.
    same = jnp.all(aside[:, None] == aside[None], axis=2)
    again = jnp.any(jnp.tril(same, -1), axis=1)
    passed = (here[None] + share[:, None] * way[None])[None]
    passed = jnp.tile(passed, (aside.shape[0], 1, 1))
    passed = passed.at[..., :2].add(aside[..., None] * left[None, None])
    start = jnp.tile(here[None, None], (aside.shape[0], 1, 1))
    return Routes(
        jnp.concatenate([start, passed], axis=1), jnp.where(again, jnp.inf, lengths)
    )


def _sides(count: int) -> Float[Array, "c b"]:
    """Every way to choose left, 1, or right, -1; beyond a few, all left or all right."""
    choices = (
        itertools.product((1.0, -1.0), repeat=count)
        if count <= _MOST_ENUMERATED
        else ((1.0,) * count, (-1.0,) * count)
    )
    return jnp.array(list(choices))
