"""The flow of all intervals at once, and its Jacobians."""

import enum

import equinox as eqx
import jax
import jax.flatten_util
import jax.numpy as jnp
import numpy as np

from ._hold import AbstractHold, ZeroOrderHold
from ._problem import OptimalControlProblem
from ._types import Array, Float, Scalar

# The classical Runge-Kutta method: each stage starts from the one before it.
RK4_NODES = np.array([0.0, 0.5, 0.5, 1.0])
RK4_WEIGHTS = np.array([1.0, 2.0, 2.0, 1.0]) / 6.0


class Quadrature(enum.Enum):
    """How costs and integral constraints are accumulated.

    `FLOW` integrates them with the same Runge-Kutta steps as the states. `TRAPEZOID` is
    the paper's eq. 20, a rule on nodal values: the last node then has a control that
    counts in the cost and moves nothing, which an optimizer exploits.
    """

    FLOW = "flow"
    TRAPEZOID = "trapezoid"


class Discretization(eqx.Module):
    """How continuous time becomes nodes and intervals.

    **Arguments:**

    - `hold`: [`ZeroOrderHold`][] or [`FirstOrderHold`][].
    - `quadrature`: [`Quadrature`][] of costs and integral constraints.
    - `tolerance`: error allowed in the states over one interval, and in the integrals
        over all of them, relative to each quantity's scale. The number of Runge-Kutta
        substeps, the same in all intervals, follows the error that comparing with half
        as many tells.
    - `min_substeps`, `max_substeps`: limits of that number.
    """

    hold: AbstractHold = ZeroOrderHold()
    quadrature: Quadrature = eqx.field(static=True, default=Quadrature.FLOW)
    tolerance: float = eqx.field(static=True, default=3e-5)
    min_substeps: int = eqx.field(static=True, default=2)
    max_substeps: int = eqx.field(static=True, default=256)

    def __check_init__(self):
        if not self.tolerance > 0:
            raise ValueError(f"tolerance={self.tolerance}: give a positive number.")
        if not 1 <= self.min_substeps <= self.max_substeps:
            raise ValueError(
                f"min_substeps={self.min_substeps}, max_substeps={self.max_substeps}: "
                "need 1 <= min_substeps <= max_substeps."
            )

    def control_nodes(self, nodes: int) -> int:
        """How many nodes have a control of their own."""
        if self.quadrature is Quadrature.TRAPEZOID:
            return nodes
        return self.hold.control_nodes(nodes)


class Jacobian(eqx.Module):
    """Derivatives of `r` quantities of each interval by what they depend on.

    `None` stands for a block that is zero by structure.
    """

    left_state: Float[Array, "I r n"]
    left_control: Float[Array, "I r m"]
    time: Float[Array, "I r"]
    right_state: Float[Array, "I r n"] | None = None
    right_control: Float[Array, "I r m"] | None = None


class Intervals(eqx.Module):
    """What happens along each interval.

    - `next_state`: the state the flow carries to the interval's right end.
    - `increments`: growth of every integral, in the problem's order, and of the running
        cost (last column).
    """

    next_state: Float[Array, "I n"]
    increments: Float[Array, "I r"]


class IntervalJacobians(eqx.Module):
    """Derivatives of [`Intervals`][]."""

    next_state: Jacobian
    increments: Jacobian


def integrand_rates(
    problem: OptimalControlProblem, t: Scalar, x: Float[Array, " n"], u: Array
) -> Float[Array, " r"]:
    """Integrands of all integrals and the running cost, at one moment."""
    rates = [integral.integrand(t, x, u) for integral in problem.integrals.values()]
    return jnp.stack(
        [jnp.reshape(r, ()) for r in [*rates, problem.running_cost(t, x, u)]]
    )


def moment(
    discretization: Discretization,
    span: tuple[Scalar, Scalar],
    fraction: Scalar,
    left: Float[Array, " m"],
    right: Float[Array, " m"],
    final_time: Scalar,
) -> tuple[Scalar, Float[Array, " m"]]:
    """Time and control at a fraction of one interval."""
    start, width = span
    t = final_time * (start + width * fraction)
    return t, discretization.hold.interpolate(left, right, fraction)


def propagate(
    problem: OptimalControlProblem,
    discretization: Discretization,
    substeps: Array | int,
    grid: tuple[Float[Array, " I"], Float[Array, " I"]],
    states: Float[Array, "N n"],
    controls: Float[Array, "N m"],
    final_time: Scalar,
) -> Intervals:
    """Every interval's flow from its own left node.

    **Arguments:**

    - `substeps`: Runge-Kutta steps an interval; may be traced.
    - `grid`: normalized start and width of each interval.
    """
    flow = eqx.Partial(_flow, problem, discretization, substeps)
    ends = jax.vmap(flow, in_axes=(0, 0, 0, 0, None))(
        grid, states[:-1], controls[:-1], controls[1:], final_time
    )
    size = problem.state_size
    if discretization.quadrature is Quadrature.FLOW:
        return Intervals(ends[:, :size], ends[:, size:])
    rates = _nodal_rates(problem, grid, states, controls, final_time)
    half = 0.5 * final_time * grid[1][:, None]
    return Intervals(ends[:, :size], half * (rates[:-1] + rates[1:]))


def linearize(
    problem: OptimalControlProblem,
    discretization: Discretization,
    substeps: Array | int,
    grid: tuple[Float[Array, " I"], Float[Array, " I"]],
    states: Float[Array, "N n"],
    controls: Float[Array, "N m"],
    final_time: Scalar,
) -> tuple[Intervals, IntervalJacobians]:
    """Values and Jacobians of [`propagate`][] in one sweep of forward tangents."""
    size = problem.state_size
    holds_right = discretization.hold.control_nodes(2) == 2
    flow = eqx.Partial(_flow, problem, discretization, substeps)

    def interval(span, x, left, right):
        if holds_right:
            return _value_and_jacobian(
                lambda x, left, right, time: flow(span, x, left, right, time),
                (x, left, right, final_time),
            )
        return _value_and_jacobian(
            lambda x, left, time: flow(span, x, left, right, time),
            (x, left, final_time),
        )

    ends, columns = jax.vmap(interval)(grid, states[:-1], controls[:-1], controls[1:])
    by_state, by_left, *by_right, by_time = columns

    def rows(part: slice) -> Jacobian:
        return Jacobian(
            left_state=by_state[:, part],
            left_control=by_left[:, part],
            time=by_time[:, part, 0],
            right_control=by_right[0][:, part] if by_right else None,
        )

    dynamics = rows(slice(None, size))
    if discretization.quadrature is Quadrature.FLOW:
        intervals = Intervals(ends[:, :size], ends[:, size:])
        return intervals, IntervalJacobians(dynamics, rows(slice(size, None)))
    increments, jacobian = _trapezoid(problem, grid, states, controls, final_time)
    return Intervals(ends, increments), IntervalJacobians(dynamics, jacobian)


def flow_within(
    problem: OptimalControlProblem,
    discretization: Discretization,
    substeps: Array | int,
    span: tuple[Scalar, Scalar],
    x: Float[Array, " n"],
    controls: tuple[Float[Array, " m"], Float[Array, " m"]],
    final_time: Scalar,
    reach: Scalar,
) -> Float[Array, " n"]:
    """The state a share `reach` (0 to 1) of one interval behind its left node."""
    arguments = (problem, discretization, substeps, span, x, *controls, final_time)
    return _flow(*arguments, reach)[: problem.state_size]


def _flow(problem, discretization, substeps, span, x, left, right, final_time, reach=1.0):
    """State, and integrals under `FLOW`, at the end of one interval (classical RK4)."""
    size = problem.state_size
    along_flow = discretization.quadrature is Quadrature.FLOW

    def rate(fraction, y):
        t, u = moment(discretization, span, fraction, left, right, final_time)
        x = y[:size]
        dynamics = problem.dynamics(t, x, u)
        if not along_flow:
            return dynamics
        return jnp.concatenate([dynamics, integrand_rates(problem, t, x, u)])

    step = reach / substeps
    seconds = final_time * span[1] * step
    nodes, weights = jnp.asarray(RK4_NODES), jnp.asarray(RK4_WEIGHTS)

    def stage(index, carry):
        # One stage a pass, so that the dynamics are compiled once instead of four times.
        y, slope, growth = carry
        which = index % 4
        fraction = (index // 4 + nodes[which]) * step
        slope = rate(fraction, y + nodes[which] * seconds * slope)
        growth = growth + weights[which] * slope
        last = which == 3
        y = jnp.where(last, y + seconds * growth, y)
        return y, slope, jnp.where(last, 0.0, growth)

    totals = jnp.zeros(len(problem.integrals) + 1, x.dtype) if along_flow else x[:0]
    first = jnp.concatenate([x, totals])
    nothing = jnp.zeros_like(first)
    y, *_ = jax.lax.fori_loop(0, 4 * substeps, stage, (first, nothing, nothing))
    return y


def _value_and_jacobian(function, arguments):
    """Value and the Jacobian by each argument, from one vectorized `jvp`."""
    flat, unravel = jax.flatten_util.ravel_pytree(arguments)
    value, columns = jax.vmap(
        lambda tangent: jax.jvp(lambda v: function(*unravel(v)), (flat,), (tangent,)),
        out_axes=(None, -1),
    )(jnp.eye(flat.size, dtype=flat.dtype))
    sizes = [jnp.size(argument) for argument in arguments]
    ends = [sum(sizes[: index + 1]) for index in range(len(sizes) - 1)]
    return value, jnp.split(columns, ends, axis=-1)


def _node_fractions(grid):
    starts, widths = grid
    return jnp.concatenate([starts, starts[-1:] + widths[-1:]])


def _nodal_rates(problem, grid, states, controls, final_time):
    times = final_time * _node_fractions(grid)
    rates = eqx.Partial(integrand_rates, problem)
    return jax.vmap(rates)(times, states, controls)


def _trapezoid(problem, grid, states, controls, final_time):
    """Increments of the paper's eq. 20 and their Jacobian, from nodal rates."""

    def node(fraction, x, u):
        return _value_and_jacobian(
            lambda x, u, time: integrand_rates(problem, time * fraction, x, u),
            (x, u, final_time),
        )

    rates, (by_state, by_control, by_time) = jax.vmap(node)(
        _node_fractions(grid), states, controls
    )
    half = 0.5 * final_time * grid[1]
    sums = rates[:-1] + rates[1:]
    weigh = half[:, None, None]
    return half[:, None] * sums, Jacobian(
        left_state=weigh * by_state[:-1],
        left_control=weigh * by_control[:-1],
        right_state=weigh * by_state[1:],
        right_control=weigh * by_control[1:],
        time=0.5 * grid[1][:, None] * sums
        + half[:, None] * (by_time[:-1, :, 0] + by_time[1:, :, 0]),
    )
