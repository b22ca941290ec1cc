"""`Attempt`: how the solve from one of several guesses ended."""

import equinox as eqx

from ._status import Status, has_converged, name_of
from ._types import Array, Scalar


class Attempt(eqx.Module):
    """How the solve from one guess ended, in a line: print it.

    - `objective`: cost of its last iterate, in its own unit.
    - `violation`: how far the constraint missed most is from being met there, relative
        to its scale.
    - `status`: as in [`Solution`][].
    - `verified`: whether [`verify`][] found limits and dynamics met; None where it was
        not asked.
    - `chosen`: whether this is the one that was returned.
    """

    objective: Scalar
    violation: Scalar
    status: Status
    verified: bool | None
    chosen: Array

    @property
    def converged(self) -> Array:
        """As in [`Solution`][]."""
        return has_converged(self.status)

    def __str__(self) -> str:
        judged = {None: "", True: ", verified", False: ", not verified"}[self.verified]
        missed = f", misses a limit by {float(self.violation):.1e}"
        return (
            f"{float(self.objective):,.2f}, {name_of(self.status)}"
            f"{'' if bool(self.converged) else missed}{judged}"
            f"{', chosen' if bool(self.chosen) else ''}"
        )
