"""`GuessPlan`: how a mission's guess is flown."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp

from ._compiler import compiled_quickly
from ._routes import Routes
from ._trajectory import Trajectory
from ._types import Array, Float, Scalar
from .models._parameters import Numbers, optional_parameter, parameter
from .models.channel import Channel
from .models.obstacles import Cylinders

# Each costs a solve; these are all the ways past three buildings.
MOST_ROUTES = 8


class Flight(NamedTuple):
    """States to visit, start and goal included, and when.

    - `legs`, `stays`: seconds on the way to each of them, and seconds there.
    """

    route: Float[Array, "k 12"]
    legs: Float[Array, " k"]
    stays: Float[Array, " k"]


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

    def flights(
        self,
        places: Float[Array, "j 3"],
        obstacles: Cylinders,
        channel: Channel,
        data_required: Scalar | None,
        final_time_range: Float[Array, "2"],
    ) -> tuple[Float[Array, " r"], tuple[Flight, ...]]:
        """The flights on every side of the buildings in the way, shortest first.

        Before them their lengths [m], infinite for those that do not exist: so many are
        made whatever the numbers.

        **Arguments:**

        - `places`: start, where to wait if data are required, and goal.
        """
        routes = Routes.around(places, obstacles, self.detour_margin, MOST_ROUTES)
        waiting = None if data_required is None else 1 + obstacles.count
        # Schedules only make guesses and a scale: no derivative passes through them, and
        # at a leg of no length there is none.
        plan, sending = jax.lax.stop_gradient(
            (self, (channel, data_required, final_time_range))
        )

        def flight(passed):
            route = jax.vmap(at_rest)(jnp.concatenate([passed, places[-1:]]))
            still = jax.lax.stop_gradient(route)
            return Flight(route, *plan.schedule(still, waiting, *sending))

        rows = zip(*jax.vmap(flight)(routes.places), strict=True)
        return routes.lengths, tuple(Flight(*row) for row in rows)

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
        # On a way of no length every leg takes as long as another.
        legs = jnp.where(moving > 0, legs, jnp.ones_like(legs).at[0].set(0.0))
        return legs * (total - wait) / jnp.sum(legs), stays

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

    @compiled_quickly
    def fly(
        self,
        flight: Flight,
        fractions: Float[Array, " N"],
        control: Float[Array, " m"],
    ) -> Trajectory:
        """A flight's states at the nodes, under a constant control."""
        route, legs, stays = flight
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

    @compiled_quickly
    def grid(self, flight: Flight, even: Float[Array, " N"]) -> Float[Array, " N"]:
        """Evenly spaced node fractions, redistributed as `transit_share` says."""
        _, legs, stays = flight
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


def at_rest(position: Float[Array, "3"]) -> Float[Array, "12"]:
    """The quadrotor's state level and still at a position."""
    return jnp.concatenate([position, jnp.zeros(9)])


def _sent(
    channel: Channel, here: Float[Array, "3"], there: Float[Array, "3"], time: Scalar
) -> Scalar:
    """Data transferred on a straight leg [bit]."""
    way = jnp.linspace(0.0, 1.0, 101)
    return channel.throughput(way * time, here[None] + jnp.outer(way, there - here))
