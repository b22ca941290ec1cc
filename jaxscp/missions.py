"""The paper's missions by name, and changes to them.

    mission = missions.get("urban-30MB-60dB")
    heavier = missions.replace(mission, "vehicle.mass", 3.5)
    solution = missions.solve(heavier)

The paper states b = 60 without a unit. Missions with data exist twice: with b = 60
taken linearly, and with "-60dB" at the end, where it is decibels, b = 1e6.

What the paper leaves open is set here, in the defaults of `Limits`, `Rotors` and
`GuessPlan`, and can be changed: 1 MB = 8e6 bit, g = 9.81 m/s^2, rotors that lift twice
the weight at 600 rad/s, torque limits, and an altitude floor of 10 m where data are
required (without one the optimizer flies into the antenna).
"""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any

import equinox as eqx
import jax.numpy as jnp

from ._continuation import continuation
from ._discretization import Discretization
from ._guess_plan import GuessPlan as GuessPlan
from ._mission import Mission as Mission
from ._proximal import ProximalSCP
from ._records import flat, from_dict, to_dict, with_entries
from ._scp import AbstractSCP
from ._solution import Solution
from ._solve import SolveError, solve as solve_problem
from ._trajectory import Trajectory
from ._types import Array, ArrayLike, is_concrete
from .models.channel import Channel
from .models.limits import Limits
from .models.obstacles import Cylinders
from .models.quadrotor import Quadrotor

BITS_PER_MEGABYTE = 8e6
# b = 60 as decibels, and as it stands.
_SNR_60_DB, _SNR_60 = 1e6, 60.0

# Name to (urban, required data [MB], b).
_MISSIONS = {
    "free-flight": (False, None, _SNR_60),
    "urban-flight": (True, None, _SNR_60),
    "free-space-30MB": (False, 30, _SNR_60),
    "free-space-50MB": (False, 50, _SNR_60),
    "free-space-70MB": (False, 70, _SNR_60),
    "urban-30MB": (True, 30, _SNR_60),
    "free-space-30MB-60dB": (False, 30, _SNR_60_DB),
    "free-space-50MB-60dB": (False, 50, _SNR_60_DB),
    "free-space-70MB-60dB": (False, 70, _SNR_60_DB),
    "urban-30MB-60dB": (True, 30, _SNR_60_DB),
}
# Where limits hold, as parts of each interval watched: a part has room for one peak.
ENFORCED = {"nodes": 0, "between": 2}
# Time grids.
GRIDS = {
    "uniform": Discretization(),
    "free": Discretization(interval_ratio=1.2, longest_interval=1.3),
}
# Of the nodes, where intervals are free and the plan says nothing.
_FREE_TRANSIT_SHARE = 0.2
# Shares of the data required that are asked for in turn where all at once lead nowhere.
_DATA_STEPS = (0.25, 0.5, 0.75, 1.0)
# Not numbers: they say what a mission is called.
_LABELS = ("name", "summary")


def names() -> tuple[str, ...]:
    """Names of all missions."""
    return tuple(_MISSIONS)


def get(name: str) -> Mission:
    """The mission of that name (paper, Section V and Tables I, II).

    **Raises:** `ValueError` for an unknown name, listing those that exist.
    """
    if name not in _MISSIONS:
        raise ValueError(
            f"mission={name!r}: no such mission; choose one of {', '.join(_MISSIONS)}."
        )
    urban, megabytes, snr_constant = _MISSIONS[name]
    return Mission(
        name,
        _summary(urban, megabytes, snr_constant),
        vehicle=Quadrotor(),
        channel=Channel(snr_constant=snr_constant),
        obstacles=_buildings() if urban else Cylinders(),
        limits=Limits(),
        start=(0.0, 0.0, 10.0),
        goal=(500.0, 500.0, 100.0),
        altitude_floor=None if megabytes is None else 10.0,
        data_required=None if megabytes is None else megabytes * BITS_PER_MEGABYTE,
        plan=_plan(megabytes, snr_constant),
    )


def solve(
    mission: Mission,
    method: AbstractSCP = ProximalSCP(),  # noqa: B008  (immutable)
    *,
    guess: Trajectory | None = None,
    enforce: str = "between",
    grid: str = "uniform",
    nodes: int | ArrayLike = 100,
    progress: Callable[[dict], None] | None = None,
    throw: bool = True,
) -> Solution:
    """Solve a mission from its own guesses, and return the best solution.

    They lead past each building in the way on either side, as [`Mission.guesses`][] has
    it. Where none of them leads to convergence and data are required, these rise in
    steps from a quarter, each solved from the one before: the last attempt.
    `Solution.attempts` tells what each led to.

    **Arguments:**

    - `guess`: where to start instead, such as the solution of a similar mission. It has
        nodes of its own, and where it leads nowhere nothing else is tried.
    - `enforce`: "between" holds tilt, floor and buildings within the intervals as well,
        as a flight must; "nodes", as in the paper, at the nodes alone.
    - `grid`: "uniform", as in the paper, spaces the nodes as the guess does; "free" lets
        each interval be up to 1.2 times as long as its neighbours and 1.3 times as long
        as the guess's mean one, and starts with more nodes outside the wait.
    - `nodes`: as in [`Mission.guesses`][].
    - `method`, `progress`, `throw`: as in [`jaxscp.solve`][].

    **Raises:** what [`jaxscp.solve`][] raises; `ValueError` for another `enforce`
    or `grid`.
    """
    check_settings(enforce, grid)
    starts = guesses(mission, nodes, grid=grid) if guess is None else (guess,)
    settings: dict[str, Any] = {
        "method": method,
        "discretization": dataclasses.replace(GRIDS[grid], between=ENFORCED[enforce]),
        "progress": progress,
    }
    # Traced numbers do not tell whether there is anything left to try.
    known = is_concrete(eqx.filter((mission, starts), eqx.is_array))
    at_once = throw and not known
    solution = solve_problem(mission.problem(), starts, throw=at_once, **settings)
    if not known:
        return solution
    steps = guess is None and mission.data_required is not None
    if steps and not bool(solution.converged):
        solution = _with_rising_data(mission, starts[0].fractions, solution, settings)
    if throw and not bool(solution.converged):
        raise SolveError(solution)
    return solution


def guesses(
    mission: Mission, nodes: int | ArrayLike = 100, *, grid: str = "uniform"
) -> tuple[Trajectory, ...]:
    """Where [`solve`][] starts on a grid, shortest route first.

    **Raises:** `ValueError` for an unknown grid.
    """
    check_settings(grid=grid)
    if grid == "free" and mission.plan.transit_share is None:
        mission = eqx.tree_at(
            lambda mission: mission.plan.transit_share,
            mission,
            jnp.asarray(_FREE_TRANSIT_SHARE),
            is_leaf=lambda leaf: leaf is None,
        )
    return mission.guesses(nodes)


def check_settings(enforce: str = "between", grid: str = "uniform") -> None:
    """**Raises:** `ValueError` for another `enforce` or `grid` than [`solve`][] knows."""
    for name, value, known in (("enforce", enforce, ENFORCED), ("grid", grid, GRIDS)):
        if value not in known:
            raise ValueError(f"{name}={value!r}: choose {' or '.join(map(repr, known))}.")


def paths(mission: Mission) -> tuple[str, ...]:
    """Dotted paths of everything that can be replaced in a mission."""
    return tuple(path for path in flat(to_dict(mission)) if path not in _LABELS)


def replace(mission: Mission, path: str, value: Any) -> Mission:
    """The mission with one number, or list of numbers, changed.

    **Arguments:**

    - `path`: one of [`paths`][], such as `vehicle.mass`.
    - `value`: of the same shape. `obstacles.centers` and `obstacles.safe_distances`
        may change their length, which takes [`replace_many`][]; `data_required`,
        `altitude_floor` and `plan.transit_share` may be None.

    **Raises:** `ValueError` on a path that does not exist, listing those that do, and
    on a value of the wrong type, shape or range.
    """
    return replace_many(mission, {path: value})


def replace_many(mission: Mission, changes: Mapping[str, Any]) -> Mission:
    """The mission with several entries changed together, as in [`replace`][].

    Whether they agree with each other is checked once all are in place.
    """
    entries = to_dict(mission)
    labels = {label: entries.pop(label) for label in _LABELS}
    return from_dict(Mission, with_entries(entries, changes) | labels)


def _with_rising_data(
    mission: Mission, fractions: Array, before: Solution, settings: dict[str, Any]
) -> Solution:
    """What asking for the data in steps leads to or, if nothing, the solution before."""
    required = jnp.asarray(mission.data_required)
    line = [
        eqx.tree_at(lambda mission: mission.data_required, mission, share * required)
        for share in _DATA_STEPS
    ]
    problems = [each.problem() for each in line]
    *_, last = continuation(problems, line[0].guess(fractions), throw=False, **settings)
    better, worse = (last, before) if bool(last.converged) else (before, last)
    nobody = jnp.asarray(False)
    passed = tuple(dataclasses.replace(each, chosen=nobody) for each in worse.attempts)
    every = passed + last.attempts if bool(last.converged) else before.attempts + passed
    return dataclasses.replace(better, attempts=every)


def _buildings() -> Cylinders:
    """Both buildings of the paper's Section V-B."""
    return Cylinders([(190.0, 200.0), (420.0, 400.0)], [40.0, 40.0])


def _plan(megabytes: int | None, snr_constant: float) -> GuessPlan:
    """With b = 60 the rate is worth having only as close as allowed, for minutes."""
    if megabytes is None or snr_constant == _SNR_60_DB:
        return GuessPlan()
    return GuessPlan(loiter_height=10.0)


def _summary(urban: bool, megabytes: int | None, snr_constant: float) -> str:
    where = "past two buildings" if urban else "in free space"
    if megabytes is None:
        return f"least energy {where}, no data"
    return f"least energy {where}, {megabytes:g} MB to send, b = {snr_constant:g}"
