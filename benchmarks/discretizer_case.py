"""What is discretized, and what a discretizer makes of it.

The Jacobian's columns are state (12), control (4) and flight time; its rows the state
and, if integrals are gathered, the data sent and the running cost. A state of the others
is one with the integrals as further entries.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from jaxscp import OptimalControlProblem

from .second_model import dynamics, integrands

CONTROLS, COLUMNS = 4, 17


class Case(NamedTuple):
    """What is discretized, in numbers, and for jaxscp as a problem.

    - `mission`: as its JSON. `gathers`: whether integrals are.
    - `states` (N, 12), `controls` (N, 4), `final_time` [s]; nodes at even distances.
    """

    problem: OptimalControlProblem
    mission: dict
    gathers: bool
    states: np.ndarray
    controls: np.ndarray
    final_time: float

    @property
    def intervals(self) -> int:
        return len(self.states) - 1

    def rates(self, module, y, u) -> list:
        """Of the state and, if they are gathered, of the integrals."""
        sums = integrands(module, self.mission, y, u) if self.gathers else []
        return dynamics(module, self.mission["vehicle"], y, u) + sums

    @property
    def size(self) -> int:
        """Entries of the state with the integrals."""
        sums = 1 + (self.mission["data_required"] is not None)
        return 12 + (sums if self.gathers else 0)

    @property
    def starts(self) -> np.ndarray:
        """The state at every left node, (I, size): integrals begin at zero."""
        return np.pad(self.states[:-1], ((0, 0), (0, self.size - 12)))


class Prepared(NamedTuple):
    """A call that discretizes, and what makes `(values, Jacobian)` of its result, shapes
    (I, size) and (I, size, 17). `seconds`: to compile.
    """

    call: Callable[[], Any]
    arranged: Callable[[Any], tuple[np.ndarray, np.ndarray]]
    seconds: float
