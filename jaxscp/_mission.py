"""`Mission`: a flight of the paper's kind, in its own terms."""

import json
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ._bounds import Bounds
from ._compiler import compiled_quickly
from ._flight_state import (
    ALTITUDE,
    CONTROL_UNITS,
    STATE_SCALES,
    STATE_UNITS,
    TILTS,
    UNITS,
    limited,
)
from ._guess_plan import MOST_ROUTES, Flight, GuessPlan, at_rest
from ._problem import Integral, OptimalControlProblem
from ._records import from_dict, to_dict
from ._trajectory import Trajectory, time_grid
from ._types import Array, ArrayLike, Float, Scalar, is_concrete
from .models._parameters import Numbers, optional_parameter, parameter
from .models.channel import Channel
from .models.limits import Limits
from .models.obstacles import Cylinders
from .models.quadrotor import Quadrotor
from .models.systems import control_energy


class Mission(eqx.Module):
    """A quadrotor's flight from rest to rest, of least control energy (paper, eq. 5).

    Every number is a parameter: `missions.replace` changes it, `equinox.filter_grad`
    takes derivatives by it, and a new value compiles nothing unless it alters which
    requirements exist.

    **Arguments:**

    - `name`, `summary`: what it is called, and a line about it.
    - `vehicle`, `channel`, `obstacles`, `limits`: its models.
    - `start`, `goal`: positions, shape (3,) [m], at rest and level with yaw 0.
    - `altitude_floor`: lowest altitude [m], None for no floor.
    - `data_required`: to be transferred on the way [bit], None for no requirement.
    - `final_time_range`: shortest and longest flight time, shape (2,) [s].
    - `plan`: how the guess is flown.

    **Raises:** `ValueError` if the start or goal lies inside a building or below the
    floor, or the thrust does not carry the weight.
    """

    name: str = eqx.field(static=True)
    summary: str = eqx.field(static=True)
    vehicle: Quadrotor
    channel: Channel
    obstacles: Cylinders
    limits: Limits
    start: Float[Array, "3"]
    goal: Float[Array, "3"]
    altitude_floor: Scalar | None
    data_required: Scalar | None
    final_time_range: Float[Array, "2"]
    plan: GuessPlan

    def __init__(
        self,
        name: str,
        summary: str = "",
        *,
        vehicle: Quadrotor,
        channel: Channel,
        obstacles: Cylinders,
        limits: Limits,
        start: Numbers,
        goal: Numbers,
        altitude_floor: Numbers | None = None,
        data_required: Numbers | None = None,
        final_time_range: Numbers = (1.0, 2000.0),
        plan: GuessPlan,
    ):
        self.name, self.summary = name, summary
        self.vehicle, self.channel = vehicle, channel
        self.obstacles, self.limits, self.plan = obstacles, limits, plan
        self.start = parameter("Mission.start", start, shape=(3,), unit="m")
        self.goal = parameter("Mission.goal", goal, shape=(3,), unit="m")
        self.altitude_floor = optional_parameter(
            "Mission.altitude_floor", altitude_floor, unit="m"
        )
        self.data_required = optional_parameter(
            "Mission.data_required", data_required, above=0.0, unit="bit"
        )
        self.final_time_range = parameter(
            "Mission.final_time_range",
            final_time_range,
            shape=(2,),
            above=0.0,
            unit="s",
        )

    def __check_init__(self):
        if not is_concrete(self):
            return
        for end in ("start", "goal"):
            _check_place(self, end)
        weight = float(self.vehicle.hover_thrust)
        if float(self.limits.thrust) <= weight:
            raise ValueError(
                f"limits.thrust={float(self.limits.thrust):g} N does not carry the "
                f"vehicle's weight of {weight:g} N: raise it, or lower vehicle.mass."
            )
        shortest, longest = np.asarray(self.final_time_range)
        if shortest > longest:
            raise ValueError(
                f"final_time_range=[{shortest:g}, {longest:g}] s: give the shortest "
                "flight time first."
            )

    def problem(self) -> OptimalControlProblem:
        """The optimal control problem (paper, eq. 5).

        State and control as in [`jaxscp.models.Quadrotor`][]; the path constraint
        "buildings" [m] and the integral "data" [bit] where the mission has them.
        """
        figures = _figures(self)
        integrals = {}
        if self.data_required is not None:
            enough = Bounds.at_least(
                self.data_required, scale=jax.lax.stop_gradient(self.data_required)
            )
            integrals["data"] = Integral(self.channel, enough)
        return OptimalControlProblem(
            self.vehicle,
            state=Bounds(
                *figures.state,
                scale=STATE_SCALES,
                fixed=(False,) * 12,
                limited=limited(self.altitude_floor is not None),
            ),
            control=Bounds(*figures.control, fixed=(False,) * 4),
            initial_state=Bounds.exactly(figures.ends[0]),
            final_state=Bounds.exactly(figures.ends[1]),
            final_time=Bounds(*figures.final_time, scale=figures.expected_time),
            running_cost=control_energy,
            path_constraints=(
                {"buildings": self.obstacles} if self.obstacles.count else {}
            ),
            integrals=integrals,
            state_names=tuple(STATE_UNITS),
            control_names=tuple(CONTROL_UNITS),
            units=UNITS,
        )

    def guess(self, nodes: int | ArrayLike = 100) -> Trajectory:
        """Where a solve may start, as `plan` says: hover thrust along straight legs.

        Without data or buildings it is the paper's straight line. Legs lead beside the
        buildings in their way, on the sides that make them shortest. With data it visits
        the ground station and waits there until the transfer is complete.

        **Arguments:**

        - `nodes`: their number, spaced as `plan.transit_share` says, or their fractions
            of the flight time.
        """
        return self._flights(nodes, 1)[0]

    def guesses(self, nodes: int | ArrayLike = 100) -> tuple[Trajectory, ...]:
        """Guesses on every side of the buildings in the way of a leg, shortest first.

        The first is [`Mission.guess`][], and the only one where no building is in the
        way, or where the mission's numbers are traced: which buildings are is not known
        then. There are at most eight, all on the first one's time grid.

        **Arguments:**

        - `nodes`: as in [`Mission.guess`][].
        """
        return self._flights(nodes, MOST_ROUTES)

    def _flights(self, nodes: int | ArrayLike, most: int) -> tuple[Trajectory, ...]:
        figures, fractions = _figures(self), time_grid(nodes)
        if isinstance(nodes, (int, np.integer)):
            fractions = self.plan.grid(figures.flights[0], fractions)
        known = is_concrete(figures.lengths)
        count = int(np.isfinite(figures.lengths).sum()) if known else 1
        return tuple(
            self.plan.fly(flight, fractions, figures.hover)
            for flight in figures.flights[: min(count, most)]
        )

    def to_json(self) -> str:
        """The mission as JSON text; `from_json` gives the same numbers again."""
        return json.dumps(to_dict(self), allow_nan=False)

    @classmethod
    def from_json(cls, text: str) -> "Mission":
        """The mission that `to_json` wrote.

        **Raises:** `ValueError` naming the entry that is missing, unknown or not valid.
        """
        return from_dict(cls, json.loads(text))


class _Figures(NamedTuple):
    """A mission's numbers, arranged as its problem and its guess need them."""

    state: tuple[Array, Array]
    control: tuple[Array, Array]
    final_time: tuple[Scalar, Scalar]
    ends: tuple[Float[Array, "12"], Float[Array, "12"]]
    hover: Float[Array, "4"]
    lengths: Float[Array, " r"]
    flights: tuple[Flight, ...]
    expected_time: Scalar


# In one piece: each of these small operations, alone, would be compiled by itself.
@compiled_quickly
def _figures(mission: Mission) -> _Figures:
    floor = -jnp.inf if mission.altitude_floor is None else mission.altitude_floor
    tilt = mission.limits.tilt
    lower = jnp.full(12, -jnp.inf).at[ALTITUDE].set(floor).at[TILTS].set(-tilt)
    upper = jnp.full(12, jnp.inf).at[TILTS].set(tilt)
    most = jnp.concatenate([mission.limits.thrust[None], mission.limits.torque])
    places = [mission.start, mission.goal]
    if mission.data_required is not None:
        wait = mission.plan.loiter_place(mission.channel, mission.altitude_floor)
        places.insert(1, wait)
    lengths, flights = mission.plan.flights(
        jnp.stack(places),
        mission.obstacles,
        *(mission.channel, mission.data_required, mission.final_time_range),
    )
    return _Figures(
        state=(lower, upper),
        control=(-most.at[0].set(0.0), most),
        final_time=tuple(mission.final_time_range),
        ends=(at_rest(mission.start), at_rest(mission.goal)),
        hover=mission.vehicle.hover_control,
        lengths=lengths,
        flights=flights,
        # That of the shortest.
        expected_time=jnp.sum(flights[0].legs) + jnp.sum(flights[0].stays),
    )


def _check_place(mission: Mission, end: str):
    """An end of the flight must be a place where the vehicle may be."""
    place = np.asarray(getattr(mission, end))
    floor = mission.altitude_floor
    if floor is not None and place[2] < float(floor):
        raise ValueError(
            f"{end}[2]={place[2]:g} m lies below altitude_floor={float(floor):g} m: "
            f"raise {end}, or lower the floor."
        )
    centers = np.asarray(mission.obstacles.centers)
    distances = np.hypot(*(place[:2] - centers).T)
    for index, safe in enumerate(np.asarray(mission.obstacles.safe_distances)):
        if distances[index] < safe:
            raise ValueError(
                f"{end}={place.tolist()} lies {distances[index]:g} m from "
                f"obstacles.centers[{index}]={centers[index].tolist()}, within its "
                f"safe distance of {safe:g} m: move {end}, or lower "
                f"obstacles.safe_distances[{index}]."
            )
