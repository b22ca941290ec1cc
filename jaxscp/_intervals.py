"""The flow of all intervals at once, and its Jacobians."""

import dataclasses

import equinox as eqx
import jax
import jax.flatten_util
import jax.numpy as jnp

from ._flow import Course, Flow
from ._loop import over_all
from ._step import Span
from ._types import Array, Float, Scalar


class Jacobian(eqx.Module):
    """Derivatives of `r` quantities of each interval by what they depend on.

    `None` stands for a block that is zero by structure.
    """

    left_state: Float[Array, "I r n"]
    left_control: Float[Array, "I r m"]
    time: Float[Array, "I r"]
    right_state: Float[Array, "I r n"] | None = None
    right_control: Float[Array, "I r m"] | None = None

    def __getitem__(self, rows: slice) -> "Jacobian":
        """That of some of the quantities."""
        return jax.tree.map(lambda block: block[:, rows], self)

    def apply(
        self, states: Float[Array, "N n"], controls: Float[Array, "N m"], time: Scalar
    ) -> Float[Array, "I r"]:
        """Change of each interval's quantities by a change of the variables."""
        change = jnp.einsum("krn,kn->kr", self.left_state, states[:-1])
        change += jnp.einsum("krm,km->kr", self.left_control, controls[:-1])
        change += self.time * time
        if self.right_state is not None:
            change += jnp.einsum("krn,kn->kr", self.right_state, states[1:])
        if self.right_control is not None:
            change += jnp.einsum("krm,km->kr", self.right_control, controls[1:])
        return change


class Intervals(eqx.Module):
    """What happens along each interval.

    - `next_state`: the state the flow carries to the interval's right end.
    - `increments`: growth of every integral, in the problem's order, and of the running
        cost (last column).
    - `between`: largest values of the watched quantities, part by part (`_peaks`).
    """

    next_state: Float[Array, "I n"]
    increments: Float[Array, "I r"]
    between: Float[Array, "I b"]


class IntervalJacobians(eqx.Module):
    """Derivatives of [`Intervals`][]."""

    next_state: Jacobian
    increments: Jacobian
    between: Jacobian


def propagate(
    flow: Flow,
    grid: tuple[Float[Array, " I"], Float[Array, " I"]],
    states: Float[Array, "N n"],
    controls: Float[Array, "N m"],
    final_time: Scalar,
) -> Intervals:
    """Every interval's flow from its own left node.

    **Arguments:**

    - `grid`: normalized start and width of each interval.
    """

    def interval(start, width, x, left, right) -> Course:
        return flow.over(Span(start, width, left, right, final_time), x)

    course = jax.vmap(interval)(*grid, states[:-1], controls[:-1], controls[1:])
    between = course.peaks.values.reshape(course.ending.shape[0], -1)
    if flow.gathers:
        return Intervals(course.ending, course.growth, between)
    rates = _nodal_rates(flow, grid, states, controls, final_time)
    half = 0.5 * final_time * grid[1][:, None]
    return Intervals(course.ending, half * (rates[:-1] + rates[1:]), between)


def linearize(
    flow: Flow,
    grid: tuple[Float[Array, " I"], Float[Array, " I"]],
    states: Float[Array, "N n"],
    controls: Float[Array, "N m"],
    final_time: Scalar,
) -> tuple[Intervals, IntervalJacobians]:
    """Values and Jacobians of [`propagate`][] in one sweep of forward tangents."""
    flow = dataclasses.replace(flow, unrolled=True)
    two_sided = flow.discretization.holds_right

    def interval(start, width, x, left, right):
        def ends(x, time, *held):
            ends = held[1] if two_sided else right
            course = flow.over(Span(start, width, held[0], ends, time), x)
            values = (course.ending, course.growth, course.peaks.values.ravel())
            # XLA aborts where an empty part is taken of what an empty one was joined to.
            return jnp.concatenate([value for value in values if value.size])

        held = (left, right) if two_sided else (left,)
        return _value_and_jacobian(ends, (x, final_time, *held))

    ends, (by_state, by_time, by_left, *by_right) = over_all(
        interval, *grid, states[:-1], controls[:-1], controls[1:]
    )
    whole = Jacobian(
        left_state=by_state,
        left_control=by_left,
        time=by_time[:, :, 0],
        right_control=by_right[0] if by_right else None,
    )
    n = states.shape[1]
    grown = n + flow.sums
    parts = (slice(None, n), slice(n, grown), slice(grown, None))
    values, jacobians = [ends[:, part] for part in parts], [whole[part] for part in parts]
    if not flow.gathers:
        rule = _trapezoid(flow, grid, states, controls, final_time)
        values[1], jacobians[1] = rule
    return Intervals(*values), IntervalJacobians(*jacobians)


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


def node_fractions(
    grid: tuple[Float[Array, " I"], Float[Array, " I"]],
) -> Float[Array, " N"]:
    """The nodes' times in shares of the flight."""
    starts, widths = grid
    return jnp.concatenate([starts, starts[-1:] + widths[-1:]])


def _nodal_rates(flow, grid, states, controls, final_time):
    times = final_time * node_fractions(grid)
    return jax.vmap(flow.problem.rates)(times, states, controls)


def _trapezoid(flow, grid, states, controls, final_time):
    """Increments of the paper's eq. 20 and their Jacobian, from nodal rates."""

    def node(fraction, x, u):
        return _value_and_jacobian(
            lambda x, u, time: flow.problem.rates(time * fraction, x, u),
            (x, u, final_time),
        )

    rates, (by_state, by_control, by_time) = jax.vmap(node)(
        node_fractions(grid), states, controls
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
