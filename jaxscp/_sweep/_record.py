"""`Record`: how the solve of one point ended, in plain data."""

import dataclasses
import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float

from .._trajectory import Trajectory
from .._tree import as_floats

# What stands for the status of a point that has none: its solve raised an error.
RAISED = "raised"


@dataclasses.dataclass(frozen=True)
class Record:
    """A row of the table, and the flight: NumPy's arrays and Python's numbers.

    - `status`: name of the [`Status`][], or "raised".
    - `converged`, `polished`, `verified`: as of [`Solution`][] and [`verify`][].
    - `objective`: in its own unit. `final_time` [s]. `data`: transferred [bit].
    - `iterations`: convex subproblems. `polish_iterations`: steps of Newton's method.
    - `seconds`: wall-clock, of solve and verification, compilation included.
    - `error`: why it is not converged and verified; empty if it is.
    - `fractions` (N,), `states` (N, n), `controls` (N, m): the last iterate, as in
        [`Trajectory`][]; N is 0 where there is none.
    """

    status: str
    converged: bool
    polished: bool
    verified: bool
    objective: float
    final_time: float
    data: float
    iterations: int
    polish_iterations: int
    seconds: float
    error: str
    fractions: Float[np.ndarray, " N"]
    states: Float[np.ndarray, "N n"]
    controls: Float[np.ndarray, "N m"]

    @classmethod
    def failed(cls, error: Exception, seconds: float = 0.0) -> "Record":
        """Of a point whose solve, or whose mission, raised an error."""
        text = " ".join(str(error).split())
        if not isinstance(error, ValueError):
            text = f"{type(error).__name__}: {text}"
        nan, nowhere = math.nan, (np.zeros(0), np.zeros((0, 0)), np.zeros((0, 0)))
        ended = (RAISED, False, False, False, nan, nan, nan, 0, 0)
        return cls(*ended, seconds, text, *nowhere)

    @classmethod
    def of_entries(cls, entries: Mapping[str, Any]) -> "Record":
        """From arrays that hold a value each, as npz files have them."""
        numbers = {name: kind(entries[name]) for name, kind in COLUMNS.items()}
        return cls(**numbers, **{name: entries[name] for name in FLIGHT})

    @property
    def trajectory(self) -> Trajectory | None:
        """The last iterate, None where there is none."""
        if not self.fractions.size:
            return None
        arrays = (self.fractions, self.states, self.controls, self.final_time)
        return Trajectory(*(as_floats(array) for array in arrays))


# Names and types of what the table shows: all but the flight.
COLUMNS: dict[str, Any] = {
    field.name: field.type
    for field in dataclasses.fields(Record)
    if field.type in (str, bool, int, float)
}
FLIGHT = tuple(
    field.name for field in dataclasses.fields(Record) if field.name not in COLUMNS
)
