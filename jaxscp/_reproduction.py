"""`reproduce`: what the paper reports, with verified flights beside it."""

import dataclasses
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from . import missions
from ._mission import Mission
from ._proximal import ProximalSCP
from ._records import flat, to_dict
from ._scp import AbstractSCP
from ._sweep import Sweep, sweep
from ._trajectory import Trajectory
from ._types import Float

# Mission times of the paper's Section V [s], by the data to send and what is in the way.
PUBLISHED = {
    "free-space-30MB": 502.0,
    "free-space-50MB": 615.0,
    "free-space-70MB": 825.0,
    "urban-30MB": 722.0,
}
# How the paper's b = 60 may be read, and how the missions are called that read it so.
READINGS = {"b = 60": "", "b = 60 dB": "-60dB"}
NAMES = tuple(f"{name}{ending}" for ending in READINGS.values() for name in PUBLISHED)


@dataclasses.dataclass(frozen=True, eq=False)
class Reproduction:
    """The paper's missions, solved in both readings of b.

    - `sweep`: its points in the order of `names`.
    """

    sweep: Sweep

    @property
    def names(self) -> tuple[str, ...]:
        """What the missions are called, in the sweep's order."""
        return NAMES

    @property
    def succeeded(self) -> bool:
        """Whether all converged and were verified."""
        return bool(self.sweep.succeeded.all())

    def confirmed(self, name: str) -> bool:
        """Whether a mission converged and was verified."""
        return bool(self.sweep.succeeded[NAMES.index(name)])

    def row(self, name: str) -> np.void:
        """Of the sweep's table, that of a mission."""
        return self.sweep.table[NAMES.index(name)]

    def flight(self, name: str) -> Trajectory | None:
        """The trajectory of a mission, None where its solve raised an error."""
        return self.sweep.trajectories[NAMES.index(name)]


def reproduce(
    method: AbstractSCP = ProximalSCP(),  # noqa: B008  (immutable)
    *,
    nodes: int = 100,
    enforce: str = "between",
    workers: int | None = None,
    folder: str | Path | None = None,
    progress: bool | None = None,
) -> Reproduction:
    """Solve the missions of the paper's Section V in both readings of b.

    **Arguments:** as in [`jaxscp.sweep`][].
    """
    base = missions.get(NAMES[0])
    targets = [flat(to_dict(missions.get(name))) for name in NAMES]
    # A sweep's points all change the same paths.
    differing = [
        path
        for path in missions.paths(base)
        if any(target[path] != targets[0][path] for target in targets)
    ]
    return Reproduction(
        sweep(
            base,
            [{path: target[path] for path in differing} for target in targets],
            # More data from the flight with less: alone, 70 MB in the literal reading
            # take ten times as long, or lead nowhere until they rise in steps.
            along="data_required",
            method=method,
            nodes=nodes,
            enforce=enforce,
            workers=workers,
            folder=folder,
            progress=progress,
        )
    )


def least_energy(mission: Mission, seconds: float) -> float:
    """Below the control energy of any flight from rest to rest of that duration [N^2 s].

    Over the flight the thrust's vertical part gives the weight's impulse, m g T: the
    integral of the thrust is no less, and by Cauchy and Schwarz its square's is at least
    (m g)^2 T.
    """
    weight = float(mission.vehicle.mass * mission.vehicle.gravity)
    return weight**2 * seconds


def least_time(mission: Mission) -> float:
    """Below the duration of any flight that sends the data required [s].

    The rate is highest straight above the station, as low as is allowed.
    """
    assert mission.data_required is not None
    x, y, z = mission.channel.ground_station
    floor = -jnp.inf if mission.altitude_floor is None else mission.altitude_floor
    best = mission.channel.rate(jnp.stack([x, y, jnp.maximum(z, floor)]))
    return float(mission.data_required / best)


def detour(mission: Mission, states: Float[np.ndarray, "N n"]) -> float:
    """A route's largest horizontal distance from the straight line to the goal [m]."""
    start, goal = (np.asarray(end)[:2] for end in (mission.start, mission.goal))
    along = (goal - start) / np.linalg.norm(goal - start)
    return float(np.max(np.abs((states[:, :2] - start) @ [-along[1], along[0]])))
