"""`linearize`: the flow along a trajectory and its Jacobians, by themselves."""

import jax.numpy as jnp

from ._compiler import compiled
from ._discretization import Discretization
from ._intervals import IntervalJacobians, Intervals, linearize as of_intervals
from ._problem import OptimalControlProblem
from ._trajectory import Trajectory
from ._transcription import Transcription
from ._tree import as_parameters
from ._types import Array, is_concrete
from ._validation import check_guess, check_precision, check_problem


def linearize(
    problem: OptimalControlProblem,
    trajectory: Trajectory,
    discretization: Discretization = Discretization(),  # noqa: B008  (immutable)
    *,
    substeps: int = 4,
) -> tuple[Intervals, IntervalJacobians]:
    """Where every interval leads from its left node, and the derivatives of that.

    What [`solve`][] asks for in each iteration, for those who need it alone: a controller
    along a trajectory, a solver of one's own. The paper's A_k, B_k and F_k (Section III,
    "Discretization") are `left_state`, `left_control` and `time` of the second result's
    `next_state`. All is in the problem's own units. Works under `jax.jit` and `jax.vmap`,
    and can be differentiated forward.

    **Arguments:**

    - `trajectory`: its nodes need not be met by the flow: each interval starts anew.
    - `discretization`: hold, quadrature, and the parts of intervals that are watched.
        Free intervals are those of the trajectory.
    - `substeps`: Runge-Kutta steps an interval. Another number compiles nothing.

    **Raises:** `RuntimeError` if JAX is not in 64-bit mode, `ValueError` for a problem or
    trajectory that makes no sense, or for too few substeps.
    """
    check_precision()
    problem, trajectory = as_parameters((problem, trajectory))
    check_problem(problem)
    check_guess(problem, trajectory, "trajectory")
    least = max(1, discretization.watching_substeps)
    if is_concrete(substeps) and substeps < least:
        raise ValueError(f"substeps={substeps}: give {least} or more.")
    transcription = Transcription(problem, discretization, trajectory.fractions)
    return _linearized(transcription, trajectory, jnp.asarray(substeps))


@compiled
def _linearized(
    transcription: Transcription, trajectory: Trajectory, substeps: Array
) -> tuple[Intervals, IntervalJacobians]:
    return of_intervals(
        transcription.flow(substeps),
        transcription.grid,
        trajectory.states,
        trajectory.controls,
        trajectory.final_time,
    )
