"""`PerLimit`: one number for each limit of the variables and each inequality."""

import equinox as eqx

from ._subproblem import SubproblemSolution
from ._transcription import Variables
from ._types import Array, Float


class PerLimit(eqx.Module):
    """One number for each limit of the step and each inequality.

    As multipliers: upper ones positive, lower ones negative.
    """

    variables: Variables
    path: Float[Array, "N p"]
    between: Float[Array, "I b"]
    integral: Float[Array, " q"]

    @classmethod
    def multipliers(cls, solution: SubproblemSolution) -> "PerLimit":
        own = solution.multipliers
        return cls(
            Variables(solution.state, solution.control, solution.final_time),
            own.path,
            own.between,
            own.integral,
        )
