"""`GuessPlan`: how a mission's guess is flown."""

import itertools

import equinox as eqx
import jax
import jax.numpy as jnp

from ._trajectory import Trajectory
from ._types import Array, Float, Scalar
from .models._parameters import Numbers, optional_parameter, parameter
from .models.channel import Channel
from .models.obstacles import Cylinders

# 2^8 ways to pass eight buildings.
_MOST_ENUMERATED = 8


class GuessPlan(eqx.Module):
    """How a mission's guess is flown. It changes where a solve starts, nothing else.

    A flight with data visits the ground station and waits there: far from it the rate
    and its slope vanish, so a straight line gives a solver no hint of where to go.

    **Arguments:**

    - `cruise_speed`: mean speed between the places where it rests [m/s].
    - `acceleration`: with which it gets up to speed and down again, on ways too short
        for that mean speed [m/s^2].
    - `loiter_height`: height above the ground station at which it waits [m], unless
        the mission's altitude floor is higher.
    - `transit_share`: share of the nodes outside the wait, above 0 and at most 0.99.
        A long wait leaves few of evenly spaced nodes to the transits, where all the
        motion is. None spaces them evenly, as the paper does.
    - `detour_margin`: how far beside a building's axis a leg through it is led, in safe
        distances.
    """

    cruise_speed: Scalar
    acceleration: Scalar
    loiter_height: Scalar
    transit_share: Scalar | None
    detour_margin: Scalar

    def __init__(
        self,
        cruise_speed: Numbers = 28.5,
        acceleration: Numbers = 5.0,
        loiter_height: Numbers = 30.0,
        transit_share: Numbers | None = None,
        detour_margin: Numbers = 1.5,
    ):
        self.cruise_speed = parameter(
            "GuessPlan.cruise_speed", cruise_speed, above=0.0, unit="m/s"
        )
        self.acceleration = parameter(
            "GuessPlan.acceleration", acceleration, above=0.0, unit="m/s^2"
        )
        self.loiter_height = parameter(
            "GuessPlan.loiter_height", loiter_height, above=0.0, unit="m"
        )
        self.detour_margin = parameter(
            "GuessPlan.detour_margin", detour_margin, at_least=1.0
        )
        self.transit_share = optional_parameter(
            "GuessPlan.transit_share", transit_share, above=0.0, at_most=0.99
        )

    def loiter_place(
        self, channel: Channel, altitude_floor: Scalar | None
    ) -> Float[Array, "3"]:
        """Where to wait while data are transferred [m]."""
        place = channel.ground_station.at[2].add(self.loiter_height)
        return place if altitude_floor is None else place.at[2].max(altitude_floor)

    def detours(
        self,
        here: Float[Array, "3"],
        there: Float[Array, "3"],
        obstacles: Cylinders,
    ) -> Float[Array, "b 3"]:
        """One place to pass for each building, in the order they come up on a leg.

        Buildings in the way are passed on those sides that make the leg shortest. For
        those that are not, the place lies on the leg itself, so that the number of
        places never depends on the numbers.
        """
        count = obstacles.count
        if count == 0:
            return jnp.zeros((0, 3))
        way = there - here
        length = jnp.maximum(jnp.linalg.norm(way[:2]), 1e-9)
        along = way[:2] / length
        left = jnp.stack([-along[1], along[0]])
        gaps = obstacles.centers - here[None, :2]
        share = jnp.clip(gaps @ along / length, 0.0, 1.0)
        order = jnp.argsort(share)
        share, offset = share[order], (gaps @ left)[order]
        kept = self.detour_margin * obstacles.safe_distances[order]
        blocked = (jnp.abs(offset) < kept) & (share > 0.0) & (share < 1.0)
        # Every way to choose sides; beyond a few buildings, all left or all right.
        choices = (
            itertools.product((1.0, -1.0), repeat=count)
            if count <= _MOST_ENUMERATED
            else ((1.0,) * count, (-1.0,) * count)
        )
        sides = jnp.array(list(choices))
        aside = jnp.where(blocked[None], offset[None] + sides * kept[None], 0.0)
        ends = ((0, 0), (1, 1))
        steps = jnp.diff(jnp.pad(share * length, (1, 1)).at[-1].set(length))
        turns = jnp.diff(jnp.pad(aside, ends), axis=1)
        shortest = jnp.argmin(jnp.sum(jnp.hypot(steps[None], turns), axis=1))
        places = here[None] + share[:, None] * way[None]
        return places.at[:, :2].add(aside[shortest][:, None] * left[None])

    def schedule(
        self,
        route: Float[Array, "k n"],
        waiting: int | None,
        channel: Channel,
        data_required: Scalar | None,
        final_time_range: Float[Array, "2"],
    ) -> tuple[Float[Array, " k"], Float[Array, " k"]]:
        """Seconds on the way to each place of a route, and seconds there.

        **Arguments:**

        - `route`: states to visit, start and goal included.
        - `waiting`: which of them is the place to wait, if data are required.
        """
        places = route[:, :3]
        lengths = jnp.linalg.norm(jnp.diff(places, axis=0), axis=1)
        legs = jnp.concatenate([jnp.zeros(1), self._seconds(lengths, waiting)])
        moving = jnp.sum(legs)
        shortest, longest = final_time_range
        if waiting is None or data_required is None:
            wait = jnp.zeros(())
            total = jnp.clip(moving, shortest, longest)
        else:
            sent = sum(
                _sent(channel, here, there, leg)
                for here, there, leg in zip(
                    places[:-1], places[1:], legs[1:], strict=True
                )
            )
            missing = jnp.maximum(data_required - sent, 0.0)
            total = jnp.clip(
                moving + missing / channel.rate(places[waiting]), shortest, longest
            )
            wait = jnp.maximum(total - moving, 0.0)
        stays = jnp.zeros_like(legs)
        if waiting is not None:
            stays = stays.at[waiting].set(wait)
        return legs * (total - wait) / jnp.where(moving > 0, moving, 1.0), stays

    def _seconds(
        self, lengths: Float[Array, " l"], waiting: int | None
    ) -> Float[Array, " l"]:
        """How long each leg takes, not faster than from rest to rest.

        From a guess that is too fast for the limits a solve may not find back.
        """
        seconds = []
        for part in jnp.split(lengths, [] if waiting is None else [waiting]):
            # Half the way speeding up, half slowing down.
            mean = 0.5 * jnp.sqrt(self.acceleration * jnp.sum(part))
            speed = jnp.minimum(self.cruise_speed, mean)
            seconds.append(part / jnp.where(speed > 0.0, speed, 1.0))
        return jnp.concatenate(seconds)

    @eqx.filter_jit
    def fly(
        self,
        route: Float[Array, "k n"],
        legs: Float[Array, " k"],
        stays: Float[Array, " k"],
        fractions: Float[Array, " N"],
        control: Float[Array, " m"],
    ) -> Trajectory:
        """The flight along a route as scheduled, under a constant control."""
        arrivals = jnp.cumsum(legs + stays) - stays
        knots = jnp.stack([arrivals, arrivals + stays], axis=1).ravel()
        total = jnp.sum(legs) + jnp.sum(stays)
        held = jnp.repeat(route, 2, axis=0)
        follow = jax.vmap(jnp.interp, in_axes=(None, None, 1), out_axes=1)
        return Trajectory(
            fractions=fractions,
            states=follow(total * fractions, knots, held),
            controls=jnp.broadcast_to(control, (fractions.size, control.size)),
            final_time=total,
        )

    @eqx.filter_jit
    def grid(
        self,
        legs: Float[Array, " k"],
        stays: Float[Array, " k"],
        even: Float[Array, " N"],
    ) -> Float[Array, " N"]:
        """Evenly spaced node fractions, redistributed as `transit_share` says."""
        if self.transit_share is None:
            return even
        moving, waiting = jnp.sum(legs), jnp.sum(stays)
        # A short wait gets no more nodes than its time asks for.
        share = jnp.maximum(self.transit_share, moving / (moving + waiting))
        # Each part of the flight in seconds, and in its share of the nodes.
        parts = jnp.stack([legs, stays], axis=1).ravel()
        shares = jnp.stack(
            [
                share * legs / jnp.where(moving > 0, moving, 1.0),
                (1 - share) * stays / jnp.where(waiting > 0, waiting, 1.0),
            ],
            axis=1,
        ).ravel()
        seconds = jnp.cumsum(parts)
        nodes = jnp.cumsum(shares)
        return jnp.interp(even, nodes / nodes[-1], seconds / seconds[-1])


def _sent(
    channel: Channel, here: Float[Array, "3"], there: Float[Array, "3"], time: Scalar
) -> Scalar:
    """Data transferred on a straight leg [bit]."""
    way = jnp.linspace(0.0, 1.0, 101)
    return channel.throughput(way * time, here[None] + jnp.outer(way, there - here))
