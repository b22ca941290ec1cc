"""`Solution`: what a solve returns."""

import math

import equinox as eqx
import jax
import jax.numpy as jnp

from ._attempt import Attempt
from ._diagnosis import Violations, explain
from ._discretization import Discretization
from ._flow import Flow
from ._kkt import Optimum
from ._packed import Packed
from ._problem import OptimalControlProblem
from ._state import History
from ._status import Status, has_converged
from ._step import Span
from ._trajectory import Trajectory
from ._transcription import Transcription
from ._tree import as_floats
from ._types import Array, ArrayLike, Float, Scalar, is_concrete


class Multipliers(eqx.Module):
    """Multipliers of the discrete problem, in units of the objective per constraint unit.

    - `dynamics`: costates: what the optimal objective changes by when the state is pushed
        by one unit at the end of an interval.
    - `path_constraints`: of g <= 0 at each node; never negative.
    - `integrals`: of the integrals' limits; positive at an upper one, negative at a
        lower one. Raising the active limit by one unit changes the objective by minus
        that number.
    - `state`, `control`, `final_time`: of the limits, and of values fixed at one end,
        with the same signs.
    - `state_between`, `path_between`: of state limits and path constraints within each
        interval; zero where they are not enforced there.
    """

    dynamics: Float[Array, "I n"]
    path_constraints: dict[str, Float[Array, "N _"]]
    integrals: dict[str, Scalar]
    state: Float[Array, "N n"]
    control: Float[Array, "N m"]
    final_time: Scalar
    state_between: Float[Array, "I n"]
    path_between: dict[str, Float[Array, "I _"]]


class Statistics(eqx.Module):
    """What a solve took.

    - `iterations`: as the method counts them. `polish_iterations`: those beside them that
        were steps of Newton's method. `subproblems`: QPs solved, corrections and
        relaxations included. `qp_iterations`: interior-point iterations in all of them.
    - `substeps`: Runge-Kutta steps an interval at the end. `integration_error`: the
        error they leave, relative to the scales.
    - `qp_seconds`: time inside PIQP. `seconds`: the whole call, compilation included;
        NaN under `jax.jit`, which knows no clock.
    """

    iterations: Array
    polish_iterations: Array
    subproblems: Array
    qp_iterations: Array
    substeps: Array
    integration_error: Scalar
    qp_seconds: Scalar
    seconds: Scalar


class Solution(eqx.Module):
    """The last iterate of a solve, converged or not.

    - `problem`, `discretization`: what was solved, and how it was made discrete.
    - `trajectory`: nodal states and controls, and the flight time.
    - `objective`: cost, in its own unit. `integrals`: total of each integral.
    - `multipliers`: named, in physical units.
    - `status`: how the solve ended; `message` says it with names and numbers.
    - `optimality`: scaled residual of the optimality conditions at the last iterate that
        was linearized; infinite for methods that do not compute it.
    - `history`: one record for each subproblem. `statistics`: what it took.
    - `attempts`: how the solve from each guess ended, in their order; this solution is
        the one chosen. `print(*solution.attempts, sep="\n")` shows them.
    - `optimum`: the same point, scaled, with its active constraints: what derivatives
        start from.

    Trajectory, objective, integrals and multipliers, and the problem itself, can be
    differentiated by every inexact leaf of the problem that was solved: [`solve`][]. All
    else is cut off: its derivatives are zero.
    """

    packed_problem: Packed
    discretization: Discretization
    trajectory: Trajectory
    objective: Scalar
    integrals: dict[str, Scalar]
    multipliers: Multipliers
    violations: Violations
    status: Status
    optimality: Scalar
    history: History
    statistics: Statistics
    attempts: tuple[Attempt, ...]
    packed_transcription: Packed
    optimum: Optimum

    @property
    def transcription(self) -> Transcription:
        """The discrete problem: with free intervals, of the problem with its clock."""
        return self.packed_transcription.unpack()

    @property
    def problem(self) -> OptimalControlProblem:
        """What was solved."""
        return self.packed_problem.unpack()

    @property
    def converged(self) -> Array:
        """Whether the solve ended at a feasible stationary point."""
        return has_converged(self.status)

    @property
    def polished(self) -> Array:
        """Whether the optimality conditions hold to the method's tolerance."""
        return self.status == Status.converged

    @property
    def message(self) -> str:
        """How the solve ended: names, nodes, times and amounts in physical units."""
        return explain(self.problem, self.trajectory, self.violations, self.status)

    def sample(self, times: ArrayLike) -> Trajectory:
        """States and controls at any times of the flight, with the hold that was used.

        States flow from the node before, controls follow the hold.

        **Arguments:**

        - `times`: moments [s], shape (k,), from 0 to the flight time.

        **Raises:** `ValueError` if a moment lies outside the flight.
        """
        moments = as_floats(times)
        fractions = moments / self.trajectory.final_time
        if is_concrete(fractions) and fractions.size:
            first, last = float(jnp.min(fractions)), float(jnp.max(fractions))
            if first < -1e-9 or last > 1.0 + 1e-9:
                end = float(self.trajectory.final_time)
                raise ValueError(
                    f"times from {first * end:g} to {last * end:g} s: the flight lasts "
                    f"from 0 to {end:g} s."
                )
        return _sampled(self, jnp.clip(fractions, 0.0, 1.0))


def check_polished(solution: Solution) -> None:
    """**Raises:** `ValueError` if a solution is not good enough for derivatives."""
    if bool(solution.polished):
        return
    residual = float(solution.optimality)
    met = f"have a residual of {residual:.1e}" if residual < math.inf else "are not known"
    raise ValueError(
        "derivatives need a solution of ProximalSCP, polished to its tolerance; the "
        f"optimality conditions of this one {met}. {solution.message}"
    )


@eqx.filter_jit
def _sampled(solution: Solution, fractions: Float[Array, " k"]) -> Trajectory:
    nodes = solution.trajectory
    last = nodes.nodes - 2
    # A node's own time belongs to the interval behind it, also after rounding.
    after = jnp.searchsorted(nodes.fractions, fractions + 1e-12, "right")
    index = jnp.clip(after - 1, 0, last)
    starts, widths = nodes.fractions[:-1], jnp.diff(nodes.fractions)
    left, right = nodes.controls[index], nodes.controls[index + 1]
    within = jnp.maximum(fractions - starts[index], 0.0) / widths[index]
    substeps, time = solution.statistics.substeps, nodes.final_time
    flow = Flow(solution.problem, solution.discretization, substeps)

    def reached(start, width, x, left, right, reach):
        return flow.along(Span(start, width, left, right, time), x, reach)

    states = jax.vmap(reached)(
        starts[index], widths[index], nodes.states[index], left, right, within
    )
    controls = jax.vmap(solution.discretization.hold.interpolate)(left, right, within)
    return Trajectory(fractions, states, controls, time)
