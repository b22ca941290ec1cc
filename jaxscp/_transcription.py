"""The discrete problem: objective, defects and constraints of nodal variables.

The convex subproblem, the penalized cost and the convergence test all take their
formulas from here.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ._compiler import traced_once
from ._discretization import Discretization
from ._flow import Flow
from ._intervals import IntervalJacobians, Intervals, linearize, propagate
from ._peaks import Watch
from ._per_constraint import PerConstraint
from ._problem import OptimalControlProblem
from ._trajectory import Trajectory
from ._types import Array, Float, Scalar


class Variables(eqx.Module):
    """Decision variables: nodal states, the `M` free nodal controls, the flight time."""

    states: Float[Array, "N n"]
    controls: Float[Array, "M m"]
    final_time: Scalar


class Residuals(eqx.Module):
    """Objective and constraint functions at one point.

    - `objective`: cost, in its own unit.
    - `defects`: next node minus the flow's end, state units.
    - `path`: all path constraints one after the other, g <= 0.
    - `between`: peaks of limits and path constraints in each interval, likewise.
    - `increments`: growth of each integral and of the running cost in each interval.
    """

    objective: Scalar
    defects: Float[Array, "I n"]
    path: Float[Array, "N p"]
    between: Float[Array, "I b"]
    increments: Float[Array, "I r"]

    @property
    def totals(self) -> Float[Array, " q"]:
        """The integrals over the whole flight."""
        return jnp.sum(self.increments[:, :-1], axis=0)


class NodeDerivatives(eqx.Module):
    """First derivatives of what depends on one node alone.

    - `path_state`, `path_control`, `path_time`: of the path constraints.
    - `terminal_state`, `terminal_time`: of the terminal cost.
    """

    path_state: Float[Array, "N p n"]
    path_control: Float[Array, "N p m"]
    path_time: Float[Array, "N p"]
    terminal_state: Float[Array, " n"]
    terminal_time: Scalar


class Derivatives(eqx.Module):
    """First derivatives of [`Residuals`][]."""

    intervals: IntervalJacobians
    nodes: NodeDerivatives


def held(controls: Float[Array, "M m"], nodes: int) -> Float[Array, "N m"]:
    """One control a node: the last one repeats where nodes have none of their own."""
    missing = nodes - controls.shape[0]
    return jnp.concatenate([controls, jnp.repeat(controls[-1:], missing, axis=0)])


class Transcription(eqx.Module):
    """A problem on a grid of `N` nodes."""

    problem: OptimalControlProblem
    discretization: Discretization
    fractions: Float[Array, " N"]

    @property
    def nodes(self) -> int:
        return self.fractions.shape[0]

    @property
    def control_nodes(self) -> int:
        return self.discretization.control_nodes(self.nodes)

    @property
    def borrows_control(self) -> bool:
        """Whether the last node has no control of its own, but that of the one before."""
        return self.control_nodes < self.nodes

    @property
    def grid(self) -> tuple[Float[Array, " I"], Float[Array, " I"]]:
        """Normalized start and width of each interval."""
        return self.fractions[:-1], jnp.diff(self.fractions)

    @property
    def watch(self) -> Watch:
        """What is enforced between the nodes, if anything is."""
        return Watch.of(self.problem)

    @property
    def no_multipliers(self) -> PerConstraint:
        """Zero for each constraint."""
        intervals, watch = self.nodes - 1, self.watch
        return PerConstraint(
            dynamics=jnp.zeros((intervals, self.problem.state_size)),
            path=jnp.zeros((self.nodes, watch.path)),
            between=jnp.zeros((intervals, self.discretization.between * watch.size)),
            integral=jnp.zeros(len(self.problem.integrals)),
        )

    def flow(self, substeps: Array | int, *, reversible: bool = False) -> Flow:
        """What carries the state through an interval."""
        return Flow(self.problem, self.discretization, substeps, reversible)

    def variables(self, guess: Trajectory) -> Variables:
        """The guess with every limit and fixed boundary entry met."""
        problem = self.problem
        states = jnp.clip(guess.states, *self.state_limits)
        controls = problem.control.clip(guess.controls[: self.control_nodes])
        return Variables(states, controls, problem.final_time.clip(guess.final_time))

    def trajectory(self, variables: Variables) -> Trajectory:
        return Trajectory(
            fractions=self.fractions,
            states=variables.states,
            controls=self.nodal_controls(variables),
            final_time=variables.final_time,
        )

    def nodal_controls(self, variables: Variables) -> Float[Array, "N m"]:
        """A control for every node: the last free one is held to the end."""
        return held(variables.controls, self.nodes)

    @property
    def fixed_states(self) -> np.ndarray:
        """Static mask (N, n) of the nodal states that are fixed."""
        problem = self.problem
        mask = np.tile(problem.state.is_fixed, (self.nodes, 1))
        mask[0] |= problem.initial_state.is_fixed
        mask[-1] |= problem.final_state.is_fixed
        return mask

    @property
    def state_limits(self) -> tuple[Float[Array, "N n"], Float[Array, "N n"]]:
        """Lower and upper limits of every nodal state; equal where it is fixed."""
        problem = self.problem
        shape = (self.nodes, problem.state_size)
        lower = jnp.broadcast_to(problem.state.lower, shape)
        upper = jnp.broadcast_to(problem.state.upper, shape)
        for node, bounds in ((0, problem.initial_state), (-1, problem.final_state)):
            own = bounds.prevails(problem.state)
            low, high = map(jnp.where, own, bounds.ends, (lower[node], upper[node]))
            lower, upper = lower.at[node].set(low), upper.at[node].set(high)
        return lower, upper

    @traced_once
    def evaluate(
        self, variables: Variables, substeps: Array | int, *, reversible: bool = False
    ) -> Residuals:
        """All functions at a point.

        **Arguments:**

        - `reversible`: as in `Flow`.
        """
        flow = self.flow(substeps, reversible=reversible)
        intervals = propagate(flow, *self._arguments(variables))
        return self._residuals(variables, intervals)

    @traced_once
    def linearize(
        self, variables: Variables, substeps: Array | int
    ) -> tuple[Residuals, Derivatives]:
        """Values and first derivatives, all intervals and nodes at once."""
        intervals, jacobians = linearize(self.flow(substeps), *self._arguments(variables))
        derivatives = Derivatives(jacobians, self.linearize_nodes(variables))
        return self._residuals(variables, intervals), derivatives

    def linearize_nodes(self, variables: Variables) -> NodeDerivatives:
        """Derivatives of path constraints and terminal cost."""

        def at_node(fraction, x, u):
            def path(x, u, time):
                return self.problem.path(time * fraction, x, u)

            return jax.jacfwd(path, argnums=(0, 1, 2))(x, u, variables.final_time)

        path = jax.vmap(at_node)(
            self.fractions, variables.states, self.nodal_controls(variables)
        )
        terminal = jax.grad(self.problem.terminal_cost, argnums=(1, 0))(
            variables.final_time, variables.states[-1]
        )
        return NodeDerivatives(*path, *terminal)

    def rough_totals(self, variables: Variables) -> Float[Array, " r"]:
        """Integrals and the cost from nodal values alone: good enough for scales."""
        times = variables.final_time * self.fractions
        rates = jax.vmap(self.problem.rates)(
            times, variables.states, self.nodal_controls(variables)
        )
        totals = 0.5 * jnp.diff(times) @ (rates[:-1] + rates[1:])
        terminal = self.problem.terminal_cost(variables.final_time, variables.states[-1])
        return totals.at[-1].add(terminal)

    def _arguments(self, variables: Variables):
        return (
            self.grid,
            variables.states,
            self.nodal_controls(variables),
            variables.final_time,
        )

    def _residuals(self, variables: Variables, intervals: Intervals) -> Residuals:
        states, final_time = variables.states, variables.final_time
        path = jax.vmap(self.problem.path)(
            final_time * self.fractions, states, self.nodal_controls(variables)
        )
        terminal = self.problem.terminal_cost(final_time, states[-1])
        return Residuals(
            objective=jnp.sum(intervals.increments[:, -1]) + terminal,
            defects=states[1:] - intervals.next_state,
            path=path,
            between=intervals.between,
            increments=intervals.increments,
        )
